"""What the codes that plots carry say about association."""

import numpy as np
import numpy.typing as npt

__all__ = ["conflicting", "identity_gain"]

_Array = npt.NDArray[np.float64]
_Codes = npt.NDArray[np.integer]

# Shared by many aircraft at once: conspicuity, VFR and emergency codes support nothing.
_COMMON_CODES = np.array([0o0000, 0o1000, 0o1200, 0o2000, 0o7000, 0o7500, 0o7600, 0o7700])
_SAME_ADDRESS = 12.0  # nats; an address is unique among 2^24
_ADDRESS_MISSING = -1.0  # a Mode S target is seldom seen without its address
_SAME_CODE = 3.0
_OTHER_CODE = -4.0  # codes change in flight and are garbled: less likely, never impossible


def conflicting(track_icao24: _Codes, plot_icao24: _Codes) -> npt.NDArray[np.bool_]:
    """Say where two known Mode S addresses differ: one plot cannot be the other's aircraft."""
    return np.asarray((track_icao24 >= 0) & (plot_icao24 >= 0) & (track_icao24 != plot_icao24))


def identity_gain(track_icao24: _Codes, plot_icao24: _Codes, track_mode3a: _Codes, plot_mode3a: _Codes) -> _Array:
    """Return the log-likelihood ratio that codes add to a pair, nats; negative codes are unknown.

    An equal Mode S address settles the matter among rivals in the gate; Mode 3/A supports association and never
    decides it, since codes are shared, changed and garbled.
    """
    both = (track_icao24 >= 0) & (plot_icao24 >= 0)
    one = (track_icao24 >= 0) != (plot_icao24 >= 0)
    gain = np.where(both & (track_icao24 == plot_icao24), _SAME_ADDRESS, 0.0) + np.where(one, _ADDRESS_MISSING, 0.0)
    known = (track_mode3a >= 0) & (plot_mode3a >= 0)
    same = track_mode3a == plot_mode3a
    common = np.isin(plot_mode3a, _COMMON_CODES)
    return np.asarray(
        gain + np.where(known & same & ~common, _SAME_CODE, 0.0) + np.where(known & ~same, _OTHER_CODE, 0.0)
    )
