"""The timeline of each sensor: share of its plots found faulty, and the probability that it was degraded."""

from collections.abc import Sequence
from datetime import UTC, datetime
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.report.tables import show
from saltus.tracks.health import Health

__all__ = ["SensorRow", "sensor_rows"]

_BINS = 160
WIDTH, HEIGHT = 960.0, 44.0  # of a panel, in the picture's units
_LONG = 7200.0  # s: over a longer time ticks are told to the nearest minute
_LEAST_SCALE = 0.05  # share of faulty plots at the top of the panel, at least

_Array = npt.NDArray[np.float64]


class Series(NamedTuple):
    """One component: its colour, its bars as one path, its probability as another."""

    name: str
    colour: str
    bars: str
    line: str


class SensorRow(NamedTuple):
    """What the page shows of one sensor."""

    name: str
    figures: tuple[tuple[str, str], ...]
    series: tuple[Series, ...]
    scale: str  # share at the top of the upper panel
    intervals: tuple[str, ...]
    ticks: tuple[str, ...]  # times at equal distances


def sensor_rows(sensors: Sequence[Health], span: tuple[float, float] | None) -> list[SensorRow]:
    """Lay out every sensor that had a plot on a track; times run over the span of the page."""
    if span is None or span[1] <= span[0]:
        return []
    return [_row(sensor, *span) for sensor in sensors if len(sensor.time)]


def _row(sensor: Health, begin: float, end: float) -> SensorRow:
    edges = np.linspace(begin, end, _BINS + 1)
    count = np.histogram(sensor.time, edges)[0]
    shares = np.array(
        [
            np.histogram(sensor.time[sensor.fault == 1 + c], edges)[0] / np.maximum(count, 1)
            for c in range(len(sensor.components))
        ]
    )
    top = max(_LEAST_SCALE, float(shares.sum(axis=0).max()))
    foot, series = np.zeros(_BINS), []
    for c, name in enumerate(sensor.components):
        colour = ("h", "v")[c]
        bars = _bars(foot / top, (foot + shares[c]) / top)
        series.append(Series(name, colour, bars, _line(sensor.scans, sensor.p_degraded[:, c], begin, end)))
        foot = foot + shares[c]
    n, flagged = len(sensor.time), int((sensor.fault > 0).sum())
    figures = [("plots judged", show(n)), ("faulty", f"{show(flagged)} ({flagged / n:.2%})")]
    for c, name in enumerate(sensor.components):
        figures.append((f"in {name}", show(int((sensor.fault == 1 + c).sum()))))
    told = tuple(
        f"{_clock(d.time_from)} – {_clock(d.time_to)}: {d.condition}, P {d.probability:.2f}" for d in sensor.intervals
    )
    places = np.linspace(begin, end, 7)
    ticks = tuple(_clock(float(t)) if end - begin < _LONG else _clock(float(t) + 30.0)[:5] for t in places)
    return SensorRow(sensor.name, tuple(figures), tuple(series), f"{top:.0%}", told, ticks)


def _bars(low: _Array, high: _Array) -> str:
    step = WIDTH / _BINS
    return "".join(
        f"M{k * step:.1f} {HEIGHT * (1 - a):.1f}V{HEIGHT * (1 - b):.1f}h{step - 0.8:.1f}V{HEIGHT * (1 - a):.1f}z"
        for k, (a, b) in enumerate(zip(low.tolist(), high.tolist(), strict=True))
        if b > a
    )


def _line(time: _Array, p: _Array, begin: float, end: float) -> str:
    """The largest probability in each of twice as many bins, as steps."""
    if not len(time):
        return ""
    n = 2 * _BINS
    bin_ = np.clip(((time - begin) / (end - begin) * n).astype(int), 0, n - 1)
    largest = np.full(n, -1.0)
    np.maximum.at(largest, bin_, p)
    known = np.flatnonzero(largest >= 0.0)
    points = [f"{(k + 0.5) * WIDTH / n:.1f} {HEIGHT * (1 - largest[k]):.1f}" for k in known.tolist()]
    return "M" + "L".join(points)


def _clock(seconds: float) -> str:
    return f"{datetime.fromtimestamp(seconds, UTC):%H:%M:%S}"
