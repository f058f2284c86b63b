"""The first setup, learnt from a stretch of reports; and later versions, when a source appears."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from saltus.config import Config
from saltus.engine.setup import SensorSetup, Setup, given_noise, site_of
from saltus.geo import Site
from saltus.io.part import revisit
from saltus.progress import Progress
from saltus.records import Kind, Plots, Source
from saltus.tracks.background import flat, learn_background
from saltus.tracks.lasting import estimate_lasting, straight_pieces
from saltus.tracks.measurements import Measurements, default_noise, make_plane, place_plots
from saltus.tracks.noise import NoiseEstimate, apply_estimate, estimate_noise, widened, with_lasting
from saltus.tracks.periods import learn_period
from saltus.tracks.rows import Rows, assignments
from saltus.tracks.settings import TrackerSettings
from saltus.tracks.tracker import Tracker

__all__ = ["first_setup", "sigmas", "usable", "with_new_sources"]

_Array = npt.NDArray[np.float64]

NO_PERIOD = 4.0  # s: update period where nothing tells
_NO_DENSITY = 1e-9  # new targets and clutter per m^2 and scan of a source that is not known yet
_UNKNOWN = NoiseEstimate(np.nan, np.nan, np.nan, np.nan, 0)
SIGMAS = {  # by what a source reports: label, field of Noise, unit
    Kind.POLAR: (("sigma_range_m", "range", 1.0), ("sigma_azimuth_deg", "azimuth", 180.0 / np.pi)),
    Kind.PLANE: (("sigma_xy_m", "xy", 1.0), ("sigma_time_s", "time", 1.0)),
    Kind.BEARING: (("sigma_azimuth_deg", "azimuth", 180.0 / np.pi),),
}


def sigmas(sensor: SensorSetup) -> tuple[tuple[str, str, float], ...]:
    """Return the standard deviations that say how good the reports of a source are: label, field of Noise, unit."""
    others = {"sigma_elevation_deg": ("elevation", 180.0 / np.pi), "sigma_range_rate_mps": ("range_rate", 1.0)}
    measured = (sensor.elevations, sensor.range_rates) if sensor.kind == Kind.POLAR else (False, False)
    return SIGMAS[sensor.kind] + tuple(
        (k, *v) for (k, v), is_told in zip(others.items(), measured, strict=True) if is_told
    )


def usable(plots: Plots, sites: Sequence[Site | None]) -> npt.NDArray[np.bool_]:
    """Say which reports can be placed: of those relative to a site, only where that is known."""
    known = np.array([s is not None for s in sites] or [False])[np.maximum(plots.source, 0)]
    relative = np.isin(plots.kind, (Kind.POLAR, Kind.PLANE, Kind.BEARING)) & np.isnan(plots.observer_latitude)
    return np.asarray((plots.reason == 0) & (known | ~relative))


def first_setup(plots: Plots, config: Config, told: Mapping[str, float], bar: Progress, *, use_identity: bool) -> Setup:
    """Learn a setup from a stretch of reports: periods, noise that nobody configured, backgrounds, the plane.

    Args:
        plots: reports in time order, all usable or marked.
        config: what is configured.
        told: update period of each system that the readers tell, by its designation, s.
        bar: shows progress.
        use_identity: whether addresses and codes count.
    """
    sites = [site_of(config.site_for(s.system)) for s in plots.sources]
    used = plots.take(usable(plots, sites))
    plane = make_plane(used, sites)
    noise = {s: default_noise(source) for s, source in enumerate(plots.sources)}
    m = place_plots(used, plane, sites, noise, config.tracker.height_prior)
    sensors = [_sensor(s, source, used, m, config, told) for s, source in enumerate(plots.sources)]
    setup = Setup(config, use_identity, float(used.time[0]), plane, tuple(sensors))
    for party in setup.parties():
        own = np.flatnonzero(np.isin(used.source, party.sources))
        if len(own):
            setup = _with_noise(setup, used.take(own), party.sources, bar)
    return _with_backgrounds(setup, setup.placed(used, np.arange(len(used))))


def with_new_sources(setup: Setup, sources: Sequence[Source], time: float, told: Mapping[str, float]) -> Setup:
    """Return a setup in which further sources have what configuration and traits say; none of them is heard."""
    none = Plots.build(0, tuple(sources), (), {})
    noise = {s: default_noise(source) for s, source in enumerate(sources)}
    m = place_plots(none, setup.plane, [None] * len(sources), noise, setup.config.tracker.height_prior)
    new = [_sensor(s, sources[s], none, m, setup.config, told) for s in range(len(setup.sensors), len(sources))]
    return replace(setup, time=time, sensors=(*setup.sensors, *new))


def _sensor(
    s: int, source: Source, plots: Plots, m: Measurements, config: Config, told: Mapping[str, float]
) -> SensorSetup:
    sensor = config.site_for(source.system)
    own, at = plots.take(plots.source == s), np.flatnonzero(m.source == s)
    period = sensor.period if sensor is not None and sensor.period else _period(source, own, m, at, config, told)
    used = NO_PERIOD if np.isnan(period) else period
    kind = _kind(source, own.kind)
    given = given_noise(sensor, source, kind, config.lasting.own_share)
    density = config.tracker.clutter_density
    return SensorSetup(
        source=source,
        name=sensor.name if sensor is not None and sensor.name else str(source.system),
        system="" if sensor is None else sensor.system,
        site=site_of(sensor),
        given=given,
        told_period=period,
        period=used,
        wait=max(used, source.traits.rest_period),
        kind=kind,
        elevations=bool(np.isfinite(own.elevation[own.kind == Kind.POLAR]).any()),
        range_rates=bool(np.isfinite(own.range_rate[own.kind == Kind.POLAR]).any()),
        heard=len(own) > 0,
        noise=replace(default_noise(source), **given),
        estimate=_UNKNOWN,
        background=flat(_NO_DENSITY if density is None else density),
    )


def _period(
    source: Source, own: Plots, m: Measurements, at: npt.NDArray[np.intp], config: Config, told: Mapping[str, float]
) -> float:
    """What the reader tells, else the returns of one identity, else those of whatever flies on."""
    period = told.get(str(source.system), np.nan)
    if np.isnan(period):
        period = revisit(own.time, own.icao24, own.mode3a, own.local_id)
    at = at[np.isfinite(m.position[at, 0])]
    if np.isnan(period) and len(at):
        sigma = np.sqrt(0.5 * (m.cov[at, 0, 0] + m.cov[at, 1, 1]))
        period = learn_period(m.time[at], m.position[at, :2], sigma, config.tracker.max_speed, config.periods)
    return float(period) if period > 0 else float("nan")


def _kind(source: Source, kinds: npt.NDArray[np.int8]) -> int:
    """What a source reports: polar where it turns round and measures so, bearings where there is nothing else."""
    kinds = kinds[kinds != Kind.NONE]
    if source.traits.rotating and (len(kinds) == 0 or (kinds == Kind.POLAR).all()):
        return Kind.POLAR
    return Kind.BEARING if len(kinds) and (kinds == Kind.BEARING).all() else Kind.PLANE


def _with_noise(setup: Setup, plots: Plots, own: Sequence[int], bar: Progress) -> Setup:
    """Estimate the noise of one system's sources from its own tracks, and widen it to what innovations say.

    What lasts of the errors is estimated twice where there is any: tracks made with it tell manoeuvres from errors.
    """
    if all(_configured(setup.sensors[s]) for s in own):
        return setup  # `finish` estimates it from the tracks that it has
    m, rows, found = _tracked(setup, plots, own, bar, "estimating noise")
    before = _counted(m, found, len(setup.sensors))
    estimates = {s: estimate_noise(m, found, s) for s in own}
    estimated = _estimated(setup, estimates, m, rows)
    m, rows, found = _tracked(estimated, plots, own, bar, "checking noise")
    if any(estimated.sensors[s].noise.lasting and "lasting" not in estimated.sensors[s].given for s in own):
        estimated = _estimated(setup, estimates, m, rows)
        m, rows, found = _tracked(estimated, plots, own, bar, "checking noise")
    after, sensors = _counted(m, found, len(setup.sensors)), list(estimated.sensors)
    for s in own:
        if 2 * after[s] < before[s]:  # with its estimate it loses its tracks: they scatter less than they differ
            noise = setup.sensors[s].noise
        else:
            noise = replace(widened(sensors[s].noise, _steady_d2(rows, s)), **sensors[s].given)
        sensors[s] = replace(sensors[s], noise=noise)
    return replace(setup, sensors=tuple(sensors))


def _estimated(setup: Setup, estimates: Mapping[int, NoiseEstimate], m: Measurements, rows: Rows) -> Setup:
    """Give sources the noise estimated, and what lasts of it, where nothing is configured."""
    sensors, settings = list(setup.sensors), setup.config.lasting
    for s, estimate in estimates.items():
        sensor, source = sensors[s], sensors[s].source
        noise = apply_estimate(sensor.noise, estimate, source)
        white = noise.azimuth if sensor.kind == Kind.POLAR else noise.xy
        if sensor.may_last:
            stands = None
            if sensor.site is not None:
                stands = np.asarray(setup.plane.forward(sensor.site.latitude, sensor.site.longitude), np.float64)
            pieces = straight_pieces(m, rows, s, sensor.period, settings, stands)
            told = sensor.given.get("lasting_time")
            found = estimate_lasting(pieces, white, setup.config.filter.steady_density, settings, told)
            estimate, noise = with_lasting(estimate, noise, found, source, polar=sensor.kind == Kind.POLAR)
        sensors[s] = replace(sensor, noise=replace(noise, **sensor.given), estimate=estimate)
    return replace(setup, sensors=tuple(sensors))


def _counted(m: Measurements, track: npt.NDArray[np.int64], sources: int) -> npt.NDArray[np.int64]:
    """Count the measurements of each source on confirmed tracks, (sources,)."""
    return np.bincount(m.source[track > 0], minlength=sources)


def _tracked(
    setup: Setup, plots: Plots, own: Sequence[int], bar: Progress, label: str
) -> tuple[Measurements, Rows, npt.NDArray[np.int64]]:
    """Track a stretch of one system; return its measurements, rows, and the confirmed track of each, 0 none."""
    m = setup.placed(plots, np.arange(len(plots)))
    setup = _with_backgrounds(setup, m)
    well: TrackerSettings = replace(setup.config.tracker, degraded_noise=1.0)  # larger errors are the noise sought
    party = next(p for p in setup.parties() if own[0] in p.sources)
    tracker = Tracker(well, setup.config.filter, setup.tracker(party), use_identity=setup.use_identity)
    bar.working(label, 0.0)
    fed = tracker.feed(m, until=np.inf)
    bar.working(label, 1.0)
    found = assignments(m.plot, fed.fates, [fed.confirmed], tracker.conditions)
    return m, fed.rows, np.where(np.isin(found.track_id, found.confirmed), found.track_id, 0)


def _with_backgrounds(setup: Setup, m: Measurements) -> Setup:
    if setup.config.tracker.clutter_density is not None:
        return setup
    sensors = [
        replace(sensor, background=learn_background(m, s, sensor.period, polar=sensor.kind == Kind.POLAR))
        if (m.source == s).any()
        else sensor
        for s, sensor in enumerate(setup.sensors)
    ]
    return replace(setup, sensors=tuple(sensors))


def _configured(sensor: SensorSetup) -> bool:
    """Say whether the configuration gives every standard deviation that the source's reports need."""
    return {field for _, field, _ in sigmas(sensor)} <= set(sensor.given)


def _steady_d2(rows: Rows, s: int) -> _Array:
    """Return the innovations of one source's updates in steady motion, as squared Mahalanobis distances."""
    steady = (rows.source == s) & (rows.moments.p_manoeuvre_h < 0.5) & np.isfinite(rows.d2)
    return np.asarray(rows.d2[steady])
