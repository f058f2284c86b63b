"""What is fixed before reports are tracked: the plane, and of every source its place, noise, period and background."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from saltus.config import Config, SensorConfig
from saltus.geo import Plane, Site
from saltus.records import Kind, Plots, Source
from saltus.tracks.background import Background
from saltus.tracks.colour import Colour, inflation
from saltus.tracks.local import Party, group_sources
from saltus.tracks.measurements import Measurements, Noise, place_plots
from saltus.tracks.noise import NoiseEstimate
from saltus.tracks.slices import slice_width
from saltus.tracks.sources import SourceSetup, TrackerSetup

__all__ = ["SensorSetup", "Setup", "given_noise", "site_of"]

_STATES = {Kind.PLANE: 2, Kind.POLAR: 1, Kind.BEARING: 0}  # for lasting errors; one angle alone tells none of its own
_UNKNOWN_HEIGHT = (300.0, 300.0)  # m: mean and standard deviation of a site's height where none is given


@dataclass(frozen=True, slots=True, eq=False)
class SensorSetup:
    """One source."""

    source: Source
    name: str  # what people read
    system: str  # as configured, "" where it is not
    site: Site | None
    given: Mapping[str, float]  # fields of `Noise` that the configuration gives
    told_period: float  # as configured, told by the reader or learnt, s; NaN where nothing tells
    period: float  # used
    wait: float  # s without a report after which a target counts as missed
    kind: int  # what it reports: `Kind.POLAR`, `Kind.PLANE` (any position) or `Kind.BEARING`
    elevations: bool  # whether it measures these, too
    range_rates: bool  # and these
    heard: bool  # whether it gave a usable report in what the setup was learnt from
    noise: Noise  # used
    estimate: NoiseEstimate  # found in the first stretch
    background: Background
    appeared: float = float("nan")  # s: when it first reported, where that was after the setup was learnt

    def of_tracker(self) -> SourceSetup:
        """What a tracker is told of it."""
        return SourceSetup(self.period, self.wait, self.kind, self.background, self.colour)

    @property
    def may_last(self) -> bool:
        """Whether lasting errors are looked for.

        They are where one instrument gives azimuths or positions and no deviation of these is configured. Where targets
        tell their positions themselves each errs by its own means, and a source tells nothing of another target's.
        """
        given = {"lasting", "azimuth" if self.kind == Kind.POLAR else "xy"}
        return self.kind != Kind.BEARING and not self.source.traits.self_reporting and not given & set(self.given)

    @property
    def colour(self) -> Colour:
        """Its errors that last."""
        noise = self.noise
        if not noise.lasting:
            return Colour()
        return Colour(_STATES[self.kind], noise.lasting_time, float(inflation(self.period, noise.lasting_time)))


@dataclass(frozen=True, slots=True, eq=False)
class Setup:
    """Everything that holds from a time on until the next version; versions only add sources or renew estimates."""

    config: Config
    use_identity: bool
    time: float  # from when on it holds, s
    plane: Plane
    sensors: tuple[SensorSetup, ...]
    order: tuple[str, ...] = ()  # systems, the reference first, the most trusted next; later ones come behind them

    def parties(self) -> list[Party]:
        """Return the systems: sources whose reports make common local tracks."""
        names, pooled = [str(s.source.system) for s in self.sensors], [s.source.traits.pooled for s in self.sensors]
        return group_sources(names, pooled, [s.system for s in self.sensors])

    def tracker(self, party: Party) -> TrackerSetup:
        """Return what the tracker of one system is told."""
        own = [self.sensors[s] for s in party.sources if self.sensors[s].heard]
        width = slice_width([s.period for s in own], [s.kind == Kind.POLAR for s in own])
        return TrackerSetup(tuple(s.of_tracker() for s in self.sensors), width)

    def placed(self, plots: Plots, number: npt.NDArray[np.int64]) -> Measurements:
        """Put usable reports in the plane.

        Args:
            plots: reports whose sources are those of the setup, in its order.
            number: of each report.
        """
        sites, noise = [s.site for s in self.sensors], {k: s.noise for k, s in enumerate(self.sensors)}
        m = place_plots(plots, self.plane, sites, noise, self.config.tracker.height_prior)
        return replace(m, plot=number[m.plot])


def site_of(sensor: SensorConfig | None) -> Site | None:
    """Return the site that the configuration gives a sensor."""
    if sensor is None or sensor.latitude is None or sensor.longitude is None:
        return None
    latitude, longitude = np.radians([sensor.latitude, sensor.longitude])
    height, sigma = _UNKNOWN_HEIGHT if sensor.height is None else (sensor.height, 0.0)
    return Site(float(latitude), float(longitude), height, sigma)


def given_noise(sensor: SensorConfig | None, source: Source, kind: int, own_share: float) -> dict[str, float]:
    """Return the fields of Noise that a configuration gives.

    Where it gives a `correlation_time` and no `sigma_lasting`, the errors last whose deviation it gives, of azimuth or
    position, but for a share of that deviation, which is each report's own.

    Args:
        sensor: as configured.
        source: its reports.
        kind: what it reports.
        own_share: see `LastingSettings`.
    """
    if sensor is None:
        return {}
    azimuth, elevation = (
        None if sigma is None else float(np.radians(sigma)) for sigma in (sensor.sigma_azimuth, sensor.sigma_elevation)
    )
    given = {
        "range": sensor.sigma_range,
        "azimuth": azimuth,
        "elevation": elevation,
        "range_rate": sensor.sigma_range_rate,
        "xy": sensor.sigma_xy,
        "altitude": sensor.sigma_altitude,
        "time": 0.0 if sensor.sigma_time is None and sensor.sigma_xy is not None else sensor.sigma_time,
        "lasting_time": sensor.correlation_time,
        "lasting_distance": sensor.lasting_scale_distance,
    }
    white, sigma, lsb = ("xy", sensor.sigma_xy, source.xy_lsb)
    if kind != Kind.PLANE:
        white, sigma, lsb = "azimuth", azimuth, source.azimuth_lsb
    if sensor.sigma_lasting is not None:
        given["lasting"] = sensor.sigma_lasting if kind == Kind.PLANE else float(np.radians(sensor.sigma_lasting))
    elif sensor.correlation_time is not None and sigma is not None:
        given["lasting"] = float(np.sqrt(1.0 - own_share**2)) * sigma
        given[white] = max(own_share * sigma, lsb / float(np.sqrt(12.0)))
    return {field: value for field, value in given.items() if value is not None}
