"""Many objects: association, lifecycle, the tracker's loop, estimation of the sensors' noise."""
