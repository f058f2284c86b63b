"""One system through the tracker: the noise nobody configured is estimated first."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from saltus.config import Config
from saltus.geo import Plane
from saltus.progress import Progress
from saltus.records import Plots
from saltus.summary import Sensors, Tracked, sigmas
from saltus.tracks.measurements import Measurements, default_noise, place_plots
from saltus.tracks.noise import NoiseEstimate, apply_estimate, estimate_noise, widened
from saltus.tracks.rows import Assignments, Rows, assignments, join_fates, join_rows
from saltus.tracks.settings import TrackerSettings
from saltus.tracks.sources import learn_setup
from saltus.tracks.tracker import Tracker

__all__ = ["track_system"]

_Array = npt.NDArray[np.float64]

_AT_ONCE = 5_000  # measurements fed between two looks at the progress
_NOISE_PLOTS = 5_000  # reports of each source that the noise is estimated from before tracking


def track_system(
    plots: Plots, plane: Plane, sensors: Sensors, config: Config, bar: Progress, *, use_identity: bool
) -> Tracked:
    """Estimate the noise nobody configured on a first stretch, then track everything usable.

    Args:
        plots: reports in time order; those of other systems carry a reason.
        plane: the plane of all systems.
        sensors: what is known of the sources.
        config: settings.
        bar: shows progress.
        use_identity: whether addresses and codes count.
    """
    sources = range(len(plots.sources))
    noise = {s: replace(default_noise(plots.sources[s]), **sensors.configured[s]) for s in sources}

    def run(
        part: Plots, label: str, settings: TrackerSettings
    ) -> tuple[list[Rows], Measurements, Assignments, dict[int, NoiseEstimate]]:
        m = place_plots(part, plane, sensors.sites, noise, settings.height_prior)
        setup = learn_setup(m, sensors.periods, sensors.waits, settings.clutter_density)
        tracker = Tracker(settings, config.filter, setup, use_identity=use_identity)
        rows, fates, confirmed = [], [], []
        for begin in range(0, len(m), _AT_ONCE):
            end = min(begin + _AT_ONCE, len(m))
            fed = tracker.feed(m.take(np.arange(begin, end)), last=end == len(m))
            rows.append(fed.rows._replace(measurement=_places(m, fed.rows.measurement)))
            fates.append(fed.fates)
            confirmed.append(fed.confirmed)
            bar.working(label, end / len(m))
        found = assignments(m.plot, join_fates(fates), confirmed, tracker.conditions)
        kept = np.where(np.isin(found.track_id, found.confirmed), found.track_id, 0)
        return rows, m, found, {s: estimate_noise(m, kept, s) for s in sources}

    used = np.unique(plots.source[plots.reason == 0])
    if any(not _configured(plots, s, sensors.configured[s]) for s in sources if s in used):
        stretch = _first_stretch(plots)
        well = replace(config.tracker, degraded_noise=1.0)  # larger errors are the noise sought, no condition
        _, m, first, estimates = run(stretch, "estimating noise", well)
        before, begun = _tracked(m, first, len(plots.sources)), dict(noise)
        for s in sources:
            estimated = apply_estimate(noise[s], estimates[s], plots.sources[s])
            noise[s] = replace(estimated, **sensors.configured[s])
        rows, m, again, _ = run(stretch, "checking noise", well)
        after = _tracked(m, again, len(plots.sources))
        for s in sources:
            if 2 * after[s] < before[s]:  # with its estimate it loses its tracks: they scatter less than they differ
                noise[s] = begun[s]
                continue
            noise[s] = replace(widened(noise[s], _steady_d2(rows, m, s)), **sensors.configured[s])
    rows, m, found, estimates = run(plots, "tracking", config.tracker)
    return Tracked(rows, m, found, plane, noise, estimates)


def _tracked(m: Measurements, found: Assignments, n: int) -> npt.NDArray[np.int64]:
    """Count the measurements of each source on confirmed tracks, (n,)."""
    return np.bincount(m.source[np.isin(found.track_id, found.confirmed)], minlength=n)


def _places(m: Measurements, plots: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return the place of each plot, by its number, among the measurements; -1 stays."""
    return np.where(plots >= 0, np.searchsorted(m.plot, plots), -1)


def _steady_d2(rows: Sequence[Rows], m: Measurements, s: int) -> _Array:
    """Return the innovations of one source's updates in steady motion, as squared Mahalanobis distances."""
    all_rows = join_rows(rows)
    at = (all_rows.measurement >= 0) & (m.source[all_rows.measurement] == s)
    return np.asarray(all_rows.d2[at & (all_rows.moments.p_manoeuvre_h < 0.5) & np.isfinite(all_rows.d2)])


def _configured(plots: Plots, s: int, given: dict[str, float]) -> bool:
    """Say whether the configuration gives every standard deviation that the source's reports need."""
    return {field for _, field, _ in sigmas(plots, s)} <= set(given)


def _first_stretch(plots: Plots) -> Plots:
    """Return the reports up to the time by which every source gave enough to estimate its noise from."""
    last = 0
    for s in range(len(plots.sources)):
        own = np.flatnonzero((plots.source == s) & (plots.reason == 0))
        last = max(last, int(own[min(len(own), _NOISE_PLOTS) - 1]) if len(own) else 0)
    return plots.take(slice(0, last + 1))
