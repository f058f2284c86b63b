"""Reports as positions with covariances in the tracker's plane."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

from saltus.errors import DataError
from saltus.geo import (
    Plane,
    PlanePositions,
    Site,
    Sites,
    circular_mean,
    circular_median,
    ecef_to_geodetic,
    geodetic_to_ecef,
    geodetic_to_plane,
    local_basis,
    local_to_plane,
    polar_to_plane,
    spherical_to_plane,
    wrap,
)
from saltus.records import Kind, Plots, Source

__all__ = ["Measurements", "Noise", "default_noise", "make_plane", "place_plots"]

_Array = npt.NDArray[np.float64]

# Where nothing is configured and nothing could be estimated: a monopulse secondary radar, an airport
# multilateration, ADS-B with good satellite navigation, heights in steps of 100 ft.
_RANGE, _AZIMUTH, _ELEVATION, _XY, _ALTITUDE = 50.0, np.radians(0.08), np.radians(0.3), 20.0, 10.0
_RANGE_RATE = 3.0
_GROUND_RELIEF = 20.0  # m
_SMALLEST_AREA = 1e6  # m^2
_HULL, _RESOLUTION = 75.0, 15.0  # m, and in standard deviations: how far two plots of one target differ
_SAME_HEIGHT = 60.0  # m: reports of one target in one scan differ by less


@dataclass(frozen=True, slots=True)
class Noise:
    """Standard deviations of one source's measurements: m, rad, m/s and s, each report's error by itself.

    `time` is that of the time stamps: a position is where the target was a little sooner or later.
    `lasting` is that of errors that last from report to report, correlated as exp(-|s| / lasting_time): of the azimuth
    of a radar or camera, rad, else of a position, each axis, m; at a distance d from the sensor it is
    sqrt(1 + (d / lasting_distance)^2) times as large.
    """

    range: float = _RANGE
    azimuth: float = float(_AZIMUTH)
    elevation: float = float(_ELEVATION)
    xy: float = _XY
    altitude: float = _ALTITUDE
    range_rate: float = _RANGE_RATE
    time: float = 0.0
    lasting: float = 0.0
    lasting_time: float = 60.0
    lasting_distance: float = float("inf")


def default_noise(source: Source) -> Noise:
    """Return the noise to start from, never below the source's quantisation, LSB / sqrt(12)."""
    step = np.sqrt(12.0)
    return replace(
        Noise(),
        range=max(_RANGE, source.range_lsb / step),
        azimuth=float(max(_AZIMUTH, source.azimuth_lsb / step)),
        elevation=float(max(_ELEVATION, source.elevation_lsb / step)),
        xy=max(_XY, source.xy_lsb / step),
        altitude=max(_ALTITUDE, source.altitude_lsb / step),
        range_rate=max(_RANGE_RATE, source.range_rate_lsb / step),
        time=max(source.traits.sigma_time, source.time_lsb / step),
    )


@dataclass(frozen=True, slots=True, eq=False)
class Measurements:
    """Usable reports in time order; `plot` is the number of each in the order in which all reports came."""

    plot: npt.NDArray[np.intp]  # (N,)
    time: _Array  # (N,), s
    source: npt.NDArray[np.int32]  # (N,)
    position: _Array  # (N, 3): plane x, y and altitude, m; altitude NaN where unknown
    cov: _Array  # (N, 3, 3), m^2, of all errors; row and column of an unknown altitude are those of the unit matrix
    icao24: npt.NDArray[np.int32]
    mode3a: npt.NDArray[np.int16]
    callsign: npt.NDArray[Any]  # "" none
    polar: _Array  # (N, 2): slant range (m) and azimuth (rad) where the source measures them, else NaN
    elevation: _Array  # (N,): rad where the height comes from one, else NaN
    range_rate: _Array  # (N,): m/s, positive going away; NaN where it is not measured
    sigma_range_rate: _Array  # (N,): m/s
    ray: _Array  # (N, 2): from the site to the position in the plane, m; NaN where the source is not polar
    lever: _Array  # (N, 2): change of plane position per metre of height error, 0 where none
    origin: _Array  # (N, 2): plane x, y of the observer of a bearing, m; NaN where there is a position instead
    bearing: _Array  # (N,): rad from the plane's y axis, clockwise; NaN likewise
    sigma_bearing: _Array  # (N,): of all errors, rad; NaN likewise
    jitter: _Array  # (N,): standard deviation of the time stamp, s
    lasting: _Array  # (N, 2, 2): errors that last are L u in the plane, var u = I, m; of a bearing L[0, 0] u_0, rad
    lasting_time: _Array  # (N,): correlation time of u, s

    def __len__(self) -> int:
        """Number of measurements."""
        return len(self.time)

    def take(self, index: npt.NDArray[np.intp]) -> "Measurements":
        """Return the measurements selected."""
        return replace(self, **{f.name: getattr(self, f.name)[index] for f in fields(self)})

    def columns(self) -> dict[str, npt.NDArray[Any]]:
        """Return the columns by name."""
        return {f.name: getattr(self, f.name) for f in fields(self)}

    @classmethod
    def join(cls, parts: Sequence["Measurements"]) -> "Measurements":
        """Join measurements one behind the other."""
        return cls(**{f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)})

    def density(self, source: int, period: float) -> float:
        """Return the reports of a source per m^2 and scan, over the circle of two deviations of its longer axis."""
        own = np.flatnonzero((self.source == source) & np.isfinite(self.position[:, 0]))
        if len(own) < 2:
            return 1.0 / _SMALLEST_AREA
        scans = max(1.0, float(np.ptp(self.time[own])) / period)
        variance = float(np.linalg.eigvalsh(np.cov(self.position[own, :2].T))[-1])
        return len(own) / scans / max(4.0 * np.pi * variance, _SMALLEST_AREA)

    def with_height(self, index: npt.NDArray[np.intp], prior: tuple[float, float]) -> tuple[_Array, _Array]:
        """Return positions (k, 3) and covariances, heights unknown replaced by their prior (mean, sd)."""
        position, cov = self.position[index].copy(), self.cov[index].copy()
        unknown = np.isnan(position[:, 2])
        position[unknown, 2], cov[unknown, 2, 2] = prior[0], prior[1] ** 2
        return position, cov

    def stamped(self, index: npt.NDArray[np.intp], velocity: _Array) -> _Array:
        """Return what errors of time stamps add to covariances, sigma^2 v v' (k, 3, 3), of velocities (k, 2), m/s."""
        out = np.zeros((len(index), 3, 3))
        way = self.jitter[index, None] * velocity
        out[:, :2, :2] = way[:, :, None] * way[:, None, :]
        return out

    def split_from(
        self,
        left: npt.NDArray[np.intp],
        used: npt.NDArray[np.intp],
        speed: _Array,
        max_range: float,
        max_azimuth: float,
    ) -> npt.NDArray[np.bool_]:
        """Say which plots left over are second plots of a target seen in the same scan.

        What a source resolves goes with its errors: two plots of one target that it measures to a metre differ by the
        target's length, and by what it flew between them.

        Args:
            left: plots without a track, (k,).
            used: plots of the same source and scan that updated a confirmed track, (l,).
            speed: of those tracks, (l,), m/s.
            max_range: m, also the distance for sources that do not measure range.
            max_azimuth: rad.
        """
        a, b = left[:, None], used[None, :]
        flown = speed * np.abs(self.time[a] - self.time[b])
        reach = np.minimum(max_range, _HULL + _RESOLUTION * self._deviation(left)[:, None] + flown)
        d_range, d_azimuth = np.moveaxis(self.polar[a] - self.polar[b], -1, 0)
        d_range, d_azimuth = np.abs(d_range), np.abs(wrap(d_azimuth))
        distance = np.linalg.norm(self.position[a, :2] - self.position[b, :2], axis=-1)
        near = np.where(np.isnan(d_range), distance < reach, (d_range < reach) & (d_azimuth < max_azimuth))
        apart = np.abs(self.position[a, 2] - self.position[b, 2]) > _SAME_HEIGHT
        for codes in (self.icao24, self.mode3a):
            apart |= (codes[a] >= 0) & (codes[b] >= 0) & (codes[a] != codes[b])
        return np.asarray((near & ~apart).any(axis=1))

    def _deviation(self, index: npt.NDArray[np.intp]) -> _Array:
        """Standard deviation along the ray (k,), m; of either axis where there is none."""
        R = self.cov[index, :2, :2]
        along = self.ray[index] / np.maximum(np.linalg.norm(self.ray[index], axis=-1, keepdims=True), 1e-9)
        variance = np.einsum("ni,nij,nj->n", along, R, along)
        return np.asarray(np.sqrt(np.where(np.isnan(variance), 0.5 * np.trace(R, axis1=-2, axis2=-1), variance)))


def make_plane(plots: Plots, sites: Sequence[Site | None]) -> Plane:
    """Return the plane centred among the sites, else among the reports, else where moving observers were.

    Raises:
        DataError: there is neither a site nor a geodetic position nor an observer's.
    """
    known = [s for s in sites if s is not None]
    if known:
        return Plane(float(np.mean([s.latitude for s in known])), circular_mean([s.longitude for s in known]))
    at = (plots.kind == Kind.GEODETIC) & (plots.reason == 0)
    moved = np.isfinite(plots.observer_latitude) & (plots.reason == 0)
    if not at.any() and moved.any():
        return _about(plots.observer_latitude[moved], plots.observer_longitude[moved])
    if not at.any():
        raise DataError(
            "no report can be placed on the map: no source has a site position and none gives latitude and longitude. "
            "Give each radar's site as [[sensor]] sac, sic, latitude, longitude, height in the configuration."
        )
    return _about(plots.latitude[at], plots.longitude[at])


def _about(latitude: _Array, longitude: _Array) -> Plane:
    return Plane(float(np.median(latitude)), circular_median(longitude))


def place_plots(
    plots: Plots,
    plane: Plane,
    sites: Sequence[Site | None],
    noise: Mapping[int, Noise],
    height_prior: tuple[float, float],
) -> Measurements:
    """Turn usable reports (reason 0) into plane positions with covariances.

    Args:
        plots: reports in time order.
        plane: the tracker's plane.
        sites: site per source, of the reports that tell no observer; those of a source without a needed site must
            carry a reason already.
        noise: per source index.
        height_prior: mean and standard deviation of unknown heights, m; on an airport's surface, the ground.
    """
    usable = np.flatnonzero(plots.reason == 0)
    n = len(usable)
    position, cov = np.full((n, 3), np.nan), np.zeros((n, 3, 3))
    lever, ray = np.zeros((n, 2)), np.full((n, 2), np.nan)
    sights, lasting = np.full((n, 4), np.nan), np.zeros((n, 2, 2))
    moved = np.isfinite(plots.observer_latitude[usable])
    kinds = (Kind.POLAR, Kind.PLANE, Kind.GEODETIC, Kind.BEARING)
    for s, kind, moves in product(range(len(plots.sources)), kinds, (False, True)):
        at = np.flatnonzero((plots.source[usable] == s) & (plots.kind[usable] == kind) & (moved == moves))
        if not len(at):
            continue
        own = plots.take(usable[at])
        if kind == Kind.BEARING:
            sights[at] = _sights(own, plane, sites[s], noise[s])
            lasting[at, 0, 0] = noise[s].lasting
        else:
            prior = _height_prior(plots.sources[s], sites[s], height_prior)
            placed = _place(own, kind, plane, sites[s], noise[s], prior)
            _fill(position, cov, lever, at, placed)
            site = _site(own, sites[s])
            seen = placed.xy if site is None else placed.xy - plane.forward(site.latitude, site.longitude)
            if kind == Kind.POLAR and site is not None:
                ray[at] = seen
            lasting[at] = _lasting(seen, noise[s], polar=kind == Kind.POLAR)
    sights[:, 3] = np.hypot(sights[:, 3], lasting[:, 0, 0])
    cov[:, :2, :2] += lasting @ lasting.swapaxes(1, 2)
    return Measurements(
        plot=usable,
        time=plots.time[usable],
        source=plots.source[usable],
        position=position,
        cov=cov,
        icao24=plots.icao24[usable],
        mode3a=plots.mode3a[usable],
        callsign=plots.callsign[usable].astype("U8"),
        polar=np.stack([plots.range[usable], plots.azimuth[usable]], axis=-1),
        elevation=np.where(plots.kind[usable] == Kind.POLAR, plots.elevation[usable], np.nan),
        range_rate=np.where(np.isnan(ray[:, 0]), np.nan, plots.range_rate[usable]),
        sigma_range_rate=_of_sources(plots.source[usable], noise, "range_rate"),
        ray=ray,
        lever=lever,
        origin=sights[:, :2],
        bearing=sights[:, 2],
        sigma_bearing=sights[:, 3],
        jitter=np.where(np.isnan(ray[:, 0]), _of_sources(plots.source[usable], noise, "time"), 0.0),
        lasting=lasting,
        lasting_time=_of_sources(plots.source[usable], noise, "lasting_time"),
    )


def _lasting(seen: _Array, noise: Noise, *, polar: bool) -> _Array:
    """Return L of positions (k, 2, 2): across the ray where the source is polar, else along both axes.

    Args:
        seen: positions from the site, (k, 2), m; without a site from the middle of the plane.
        noise: of the source.
        polar: whether it measures an azimuth.
    """
    scale = noise.lasting * np.sqrt(1.0 + np.square(seen).sum(axis=1) / noise.lasting_distance**2)
    out = np.zeros((len(seen), 2, 2))
    if polar:
        out[:, 0, 0], out[:, 1, 0] = -seen[:, 1] * scale, seen[:, 0] * scale
    else:
        out[:, 0, 0] = out[:, 1, 1] = scale
    return out


def _of_sources(source: npt.NDArray[np.int32], noise: Mapping[int, Noise], name: str) -> _Array:
    """A deviation of the source of each report."""
    return np.array([getattr(noise[s], name) for s in range(len(noise))])[source]


def _site(plots: Plots, site: Site | None) -> Site | Sites | None:
    """Where reports of one source were seen from; all of them tell an observer, or none does."""
    if len(plots) and np.isfinite(plots.observer_latitude[0]):
        return Sites(plots.observer_latitude, plots.observer_longitude, plots.observer_height)
    return site


def _height_prior(source: Source, site: Site | None, height_prior: tuple[float, float]) -> tuple[float, float]:
    """Heights that reports do not tell: what a surface movement sensor sees stands on the ground."""
    if source.traits.surface and site is not None:
        return site.height, _GROUND_RELIEF
    return height_prior


def _place(
    plots: Plots, kind: int, plane: Plane, fixed: Site | None, noise: Noise, height_prior: tuple[float, float]
) -> PlanePositions:
    if kind == Kind.GEODETIC:
        return geodetic_to_plane(plots.latitude, plots.longitude, plots.altitude, plane, noise.xy, noise.altitude)
    site = _site(plots, fixed)
    if site is None:
        raise DataError("internal: a report relative to an unknown site reached the tracker")
    if kind == Kind.PLANE:
        altitude = np.where(np.isnan(plots.altitude), _height(plots, site), plots.altitude)
        return local_to_plane(plots.x, plots.y, altitude, site, plane, noise.xy, noise.altitude)
    flat = polar_to_plane(
        plots.range,
        plots.azimuth,
        plots.altitude,
        site,
        plane,
        sigma_range=noise.range,
        sigma_azimuth=noise.azimuth,
        sigma_altitude=noise.altitude,
        height_prior=height_prior,
    )
    measured = np.isfinite(plots.elevation)
    if not measured.any():
        return flat
    solid = spherical_to_plane(
        plots.range[measured],
        plots.azimuth[measured],
        plots.elevation[measured],
        _site(plots.take(measured), fixed) or site,
        plane,
        sigma_range=noise.range,
        sigma_azimuth=noise.azimuth,
        sigma_elevation=noise.elevation,
    )
    for column, values in zip(flat, solid, strict=True):
        column[measured] = values
    return flat


def _sights(plots: Plots, plane: Plane, fixed: Site | None, noise: Noise) -> _Array:
    """Where bearings were taken from (plane x, y), their directions in the plane and deviations, (k, 4)."""
    site = _site(plots, fixed)
    if site is None:
        raise DataError("internal: a bearing from an unknown site reached the tracker")
    convergence, _ = plane.factors_at(site.latitude, site.longitude)
    origin = np.broadcast_to(plane.forward(site.latitude, site.longitude), (len(plots), 2))
    return np.column_stack([origin, plots.azimuth - convergence, np.full(len(plots), noise.azimuth)])


def _height(plots: Plots, site: Site | Sites) -> _Array:
    """Height above the ellipsoid of reports that give x, y and z; NaN without z."""
    local = np.stack([plots.x, plots.y, plots.z], axis=-1)[:, None, :] @ local_basis(site.latitude, site.longitude)
    return ecef_to_geodetic(geodetic_to_ecef(site.latitude, site.longitude, site.height) + local[:, 0])[2]


def _fill(position: _Array, cov: _Array, lever: _Array, at: npt.NDArray[np.intp], placed: PlanePositions) -> None:
    """Write one source's positions into the columns of all."""
    known = np.isfinite(placed.altitude)
    position[at, :2], position[at, 2] = placed.xy, np.where(known, placed.altitude, np.nan)
    cov[at, :2, :2] = placed.cov
    cov[at, 2, 2] = np.where(known, placed.altitude_var, 1.0)
    cross = np.where(known[:, None], placed.cross, 0.0)
    cov[at, :2, 2] = cov[at, 2, :2] = cross
    lever[at] = np.where(known[:, None], cross / np.maximum(cov[at, 2, 2], 1e-12)[:, None], 0.0)
