"""What the radar experiment showed: errors, gates, decisions and the cost of decomposition, as a tree of numbers."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt

from saltus.evaluate.estimation import Interval, mean_over_runs, rmse
from saltus.geo import spherical_to_cartesian
from saltus.shapes import Bool
from saltus.studies.radar import FILTERS, SIGMA, Scene, Trial, run_radar, scene
from saltus.studies.radar_figures import draw_radar

__all__ = ["radar_metrics", "radar_study", "steady"]

_RUNS = 200
_AXES = ("x", "y", "z")
_SETTLED = 6  # scans without manoeuvre, and scans after the filters' start, before flight counts as steady
_NEAR = 60e3  # m: where the neglected correlations with height are largest

_Mask = npt.NDArray[np.bool_]
_Array = npt.NDArray[np.float64]


def radar_study(
    folder: Path, runs: int | None, seed: int, progress: Callable[[int, int], None] | None
) -> dict[str, object]:
    """Run the radar experiment, draw its six figures into `folder` and return its metrics."""
    truth, trial = scene(), run_radar(_RUNS if runs is None else runs, seed, progress)
    draw_radar(folder, truth, trial)
    return radar_metrics(truth, trial)


def steady(manoeuvring: Bool[np.ndarray, " t"]) -> Bool[np.ndarray, " t"]:
    """Tell the scans without manoeuvre in the last six, six scans or more after the filters' start."""
    out = np.zeros(len(manoeuvring), np.bool_)
    for k in range(_SETTLED, len(manoeuvring)):
        out[k] = not manoeuvring[k - _SETTLED + 1 : k + 1].any()
    return out


def radar_metrics(truth: Scene, trial: Trial) -> dict[str, object]:
    """Summarise the runs.

    Every figure has value, standard error and 95 % interval over the runs. RMSE and standard deviations in m,
    pooled (mean square) over scans: `steady` without manoeuvre in the last six scans, `manoeuvre` inside
    manoeuvre intervals; x and y go by turns, z by vertical manoeuvres.
    """
    parts = _parts(truth)
    named = [(name, i) for i, name in enumerate(FILTERS) if name != "joint"]
    rms = {
        "measurement": _by_part(trial.measurement - truth.position, parts),
        "estimate": {name: _by_part(trial.estimate[:, i] - truth.position, parts) for name, i in named},
        "prediction": {name: _by_part(trial.prediction[:, i] - truth.position, parts) for name, i in named},
    }
    return {
        "runs": len(trial.measurement),
        "scans": {"first": int(truth.scan[0]), "last": int(truth.scan[-1])},
        "units": "m, scans, shares of 1",
        "rmse": rms,
        "prediction_sd": {name: _by_part(trial.prediction_sd[:, i], parts) for name, i in named},
        "gates": {name: _gates(truth, trial, i) for name, i in named},
        "lags": {
            "horizontal": _decisions(truth.turning, trial.prob_manoeuvre[..., 0]),
            "vertical": _decisions(truth.climbing, trial.prob_manoeuvre[..., 1]),
        },
        "decomposition": _decomposition(truth, trial),
        "conversion": _conversion(),
    }


def _parts(truth: Scene) -> dict[str, _Mask]:
    """Masks (T, 3): which scans count for which axis."""
    flags = np.stack([truth.turning, truth.turning, truth.climbing], axis=-1)
    return {"steady": np.stack([steady(f) for f in flags.T], axis=-1), "manoeuvre": flags}


def _by_part(errors: _Array, parts: dict[str, _Mask]) -> dict[str, object]:
    return {name: _by_axis(rmse(errors, pool=(1,), where=mask)) for name, mask in parts.items()}


def _by_axis(interval: Interval) -> dict[str, object]:
    return {axis: _number(interval, i) for i, axis in enumerate(_AXES)}


def _number(interval: Interval, index: int | tuple[()] = ()) -> dict[str, float]:
    names = ("value", "standard_error", "low", "high")
    return {name: float(getattr(interval, name)[index]) for name in names}


def _gates(truth: Scene, trial: Trial, i: int) -> dict[str, object]:
    """Shares of measurements inside three sigmas of their prediction, per axis."""
    noise = np.diagonal(trial.noise_cov, axis1=-2, axis2=-1)
    sd = np.sqrt(np.square(trial.prediction_sd[:, i]) + noise)
    inside = np.abs(trial.measurement - trial.prediction[:, i]) <= 3 * sd
    masks = {"all": np.ones(len(truth.scan), np.bool_), "turns": truth.turning, "vertical": truth.climbing}
    return {k: _by_axis(_share(inside, m[:, None])) for k, m in masks.items()}


def _decisions(manoeuvring: _Mask, prob: _Array) -> dict[str, object]:
    """Judge the decision `prob > 0.5`, (B, T), against the manoeuvres: lags in scans, alarms, mean probability.

    A lag is 0 when the first scan of a manoeuvre (or the first after it) is already decided right; a manoeuvre
    decided nowhere inside it is missed and has no lags.
    """
    decided = prob > 0.5
    edges = np.flatnonzero(np.diff(np.concatenate([[0], manoeuvring.astype(int), [0]])))
    found: list[_Mask] = []
    lags: list[_Array] = []
    returns: list[_Array] = []
    for start, stop in edges.reshape(-1, 2):
        inside, after = decided[:, start:stop], ~decided[:, stop:]
        hit = np.flatnonzero(inside.any(1))
        found.append(np.asarray(inside.any(1, keepdims=True)))
        lags.append(inside[hit].argmax(1).astype(float))
        returns.append(after[hit].argmax(1).astype(float))
    lag, back = np.concatenate(lags), np.concatenate(returns)
    return {
        "detected": [_number(_share(f)) for f in found],
        "detection": _quantiles(lag),
        "return": _quantiles(back),
        "false_alarms": _number(_share(decided, steady(manoeuvring))),
        "mean_probability": [round(float(p), 4) for p in prob.mean(0)],
    }


def _share(hits: _Mask, where: _Mask | None = None) -> Interval:
    """Share of True over runs and scans (axis 1); its interval cannot leave [0, 1]."""
    share = mean_over_runs(hits.astype(float), pool=(1,), where=where)
    return share._replace(low=np.maximum(share.low, 0.0), high=np.minimum(share.high, 1.0))


def _quantiles(lags: _Array) -> dict[str, float | None]:
    if len(lags) == 0:
        return {"median": None, "quantile_90": None, "mean": None}
    return {
        "median": float(np.quantile(lags, 0.5, method="inverted_cdf")),
        "quantile_90": float(np.quantile(lags, 0.9, method="inverted_cdf")),
        "mean": float(lags.mean()),
    }


def _decomposition(truth: Scene, trial: Trial) -> dict[str, object]:
    """Compare the two filters side by side with the joint filter, over all scans and at short range."""
    near = np.linalg.norm(truth.position, axis=1) < _NEAR
    masks = {"all": np.ones(len(near), np.bool_), "near": near}
    pairs = [(label, FILTERS.index(name)) for label, name in (("decomposed", "adaptive"), ("joint", "joint"))]
    out: dict[str, object] = {"near_range_m": _NEAR}
    for what, positions in (("estimate", trial.estimate), ("prediction", trial.prediction)):
        out[what] = {
            part: {
                label: _by_axis(rmse(positions[:, i] - truth.position, pool=(1,), where=mask[:, None]))
                for label, i in pairs
            }
            for part, mask in masks.items()
        }
    return out


def _conversion() -> dict[str, object]:
    """Tabulate standard deviations (m) and correlations of converted measurements at three ranges."""
    azimuths, elevations = [0.0, 30.0, 45.0, 60.0], [0.0, 2.0, 5.0, 10.0, 30.0, 60.0, 90.0]
    out: dict[str, object] = {
        "azimuth_deg": azimuths,
        "elevation_deg": elevations,
        "azimuth_of_elevation_table_deg": 60.0,
    }
    for r in (250e3, 140e3, 30e3):
        flat = spherical_to_cartesian(r, np.radians(azimuths), 0.0, *SIGMA)[1]
        high = spherical_to_cartesian(r, np.radians(60.0), np.radians(elevations), *SIGMA)[1]
        out[f"{r / 1e3:.0f}_km"] = {
            "sigma_x": np.sqrt(flat[:, 0, 0]).tolist(),
            "sigma_y": np.sqrt(flat[:, 1, 1]).tolist(),
            "correlation_xy": _correlation(flat, 0, 1).tolist(),
            "sigma_z": np.sqrt(high[:, 2, 2]).tolist(),
            "correlation_xz": _correlation(high, 0, 2).tolist(),
            "correlation_yz": _correlation(high, 1, 2).tolist(),
        }
    return out


def _correlation(cov: _Array, i: int, j: int) -> _Array:
    return np.asarray(cov[..., i, j] / np.sqrt(cov[..., i, i] * cov[..., j, j]))
