"""The picture of a noise diagnosis: residuals in time, and their autocovariance with the fit through it."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from saltus.diagnose.fit import NoiseFit
from saltus.diagnose.likelihood import Series, pack
from saltus.diagnose.residuals import Residuals
from saltus.shapes import Float
from saltus.studies.style import BLUE, GREY, INK, ORANGE, TEAL, new_figure, save

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["autocovariance", "draw_noise"]

_SHOWN = 3  # series drawn against time
_BINS = 40


def draw_noise(path: Path, found: Residuals, fits: Mapping[str, NoiseFit]) -> None:
    """Draw one row of panels for each component."""
    unit = f", {found.unit}" if found.unit else ""
    with new_figure(1.2 + 2.9 * len(fits), "Errors of the sensor, and what was fitted to them") as figure:
        panels = figure.subplots(len(fits), 2, squeeze=False, width_ratios=[1.25, 1.0])
        for row, (name, fit) in enumerate(fits.items()):
            there = np.isfinite(found.values[:, row])
            data = pack(found.times[there], found.values[there, row], found.labels[there])
            left, right = panels[row]
            span = 6 * np.hypot(fit.sigma.value, fit.white.value)
            _draw_series(left, data, fit.bias, span)
            left.set_ylabel(f"{name}{unit}")
            lags, cov = autocovariance(data, fit.bias, min(5 * fit.tau.value, 400 * fit.interval), span)
            right.plot(lags, cov, "o", ms=3.4, color=INK, label="data")
            curve = np.linspace(0.0, lags[-1], 200)
            right.plot(curve, fit.sigma.value**2 * np.exp(-curve / fit.tau.value), color=BLUE, label="coloured part")
            right.plot([0, 0], [fit.sigma.value**2, fit.sigma.value**2 + fit.white.value**2], color=ORANGE, lw=3,
                       label="white part")  # fmt: skip
            right.axhline(0.0, color=GREY, lw=1)
            right.set_ylabel(f"autocovariance{unit + '²' if unit else ''}")
        longest = f"the {min(_SHOWN, fit.n_series)} longest series" if fit.n_series > 1 else "the series"
        panels[0, 0].set_title(longest, fontsize=10, fontweight="normal")
        panels[0, 1].set_title("all series", fontsize=10, fontweight="normal")
        panels[-1, 0].set_xlabel("time since the first report, s")
        panels[-1, 1].set_xlabel("lag, s")
        figure.legend(*panels[0, 1].get_legend_handles_labels(), loc="outside lower left", ncols=3)
        save(figure, path)


def _draw_series(axes: "Axes", data: Series, bias: float, span: float) -> None:
    """Draw the longest series against time; what lies further than `span` from the bias as triangles at the edge."""
    beyond = 0
    for k, colour in zip(range(min(_SHOWN, len(data.r))), (BLUE, ORANGE, TEAL), strict=False):
        t, off = data.t[k] - data.t[k, 0], data.r[k] - bias
        inside = np.abs(off) <= span
        axes.plot(t[inside], bias + off[inside], ".", ms=2.2, color=colour)
        for mark, far, edge in (("^", off > span, span), ("v", off < -span, -span)):
            axes.plot(t[far], np.full(np.count_nonzero(far), bias + edge), mark, ms=4, color=colour)
            beyond += int(np.count_nonzero(far))
    axes.axhline(bias, color=GREY, lw=1)
    axes.set_ylim(bias - 1.06 * span, bias + 1.06 * span)
    if beyond:
        words = f"▲▼ beyond 6σ: {beyond}"
        axes.set_title(words, loc="right", fontsize=8.5, fontweight="normal", color=GREY)


def autocovariance(
    data: Series, mean: float, longest: float, limit: float = np.inf
) -> tuple[Float[np.ndarray, " b"], Float[np.ndarray, " b"]]:
    """Average products of residuals less than `longest` apart, in bins of the lag; the first is lag 0.

    Args:
        data: irregular series.
        mean: subtracted from all.
        longest: largest lag, s.
        limit: residuals further from the mean are left out.
    """
    r = np.where(np.abs(data.r - mean) <= limit, data.r - mean, np.nan)
    edges = np.linspace(0.0, longest, _BINS + 1)
    total, count, lag_sum = np.zeros((3, _BINS))
    for shift in range(1, r.shape[1]):
        lag = data.t[:, shift:] - data.t[:, :-shift]
        good = np.isfinite(lag) & (lag < longest)
        if not good.any():
            break
        product = r[:, shift:] * r[:, :-shift]
        good &= np.isfinite(product)
        which = np.digitize(lag[good], edges) - 1
        total += np.bincount(which, product[good], _BINS)
        lag_sum += np.bincount(which, lag[good], _BINS)
        count += np.bincount(which, minlength=_BINS)
    full: npt.NDArray[np.bool_] = count > 0
    lags = np.concatenate([[0.0], lag_sum[full] / count[full]])
    return lags, np.concatenate([[np.nanmean(r**2)], total[full] / count[full]])
