"""A drawing of a model and of its filter: which chain acts on what, and what the filter does with it."""

from collections.abc import Iterator, Sequence
from html import escape
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from saltus.models.hybrid import HybridModel
from saltus.models.sensors import BoundSensor

__all__ = ["Dependence", "dependences", "diagram"]

_COLOURS = ("#1f5fa8", "#d1600a", "#2a9182", "#8a4fa3", "#a3893a")
_INK, _GREY, _PALE = "#1c2430", "#7b8490", "#f4f5f7"
_WIDTH, _ROW, _GAP, _TOP = 190, 54, 18, 64  # px
_LEFT, _MIDDLE, _RIGHT = 20, 290, 560  # px: left edges of the three columns


class Dependence(NamedTuple):
    """A part of a model, the motion or a sensor, and the chains its matrices depend on."""

    part: str
    detail: str
    chains: tuple[str, ...]


class _Box(NamedTuple):
    x: float
    y: float
    title: str
    detail: str
    colour: str


def dependences(model: HybridModel) -> list[Dependence]:
    """List the parts of a model, the motion first, and the chains each depends on, read off its arrays."""
    n_chains, names = len(model.chains), [chain.name for chain in model.chains]
    step = model.dynamics.step(np.ones(1), np.zeros(1))
    motion = [a.shape[a.ndim - core - n_chains : a.ndim - core] for a, core in ((step.F, 2), (step.Q, 2))]
    if step.b is not None:
        motion.append(step.b.shape[step.b.ndim - 1 - n_chains : -1])
    out = [Dependence("motion", f"{model.n_state} states", _named(motion, names))]
    mean = np.asarray(model.prior.mean)
    x = mean[(0,) * (mean.ndim - 1)].reshape((1,) * n_chains + mean.shape[-1:])
    for name, sensor in model.sensors.items():
        if isinstance(sensor, BoundSensor):
            now = sensor.at(0.0)
            with np.errstate(invalid="ignore", divide="ignore"):  # a direction at the observer's place
                expected = now.h(x)
            noise = now.noise()
            m = noise.shape[-1]
            shapes = [noise.shape[:-2], expected.shape[:-1]]
            out.append(Dependence(name, f"{m} component{'s' if m > 1 else ''}", _named(shapes, names)))
    return out


def _named(shapes: Sequence[tuple[int, ...]], names: Sequence[str]) -> tuple[str, ...]:
    axes = np.broadcast_shapes(*shapes) if names else ()
    return tuple(name for name, size in zip(names, axes, strict=True) if size > 1)


def diagram(model: HybridModel) -> str:
    """Draw a model and its filter as SVG: chains, what each acts on, and the steps of the recursion.

    Returns:
        The text of a picture; write it to a file that ends in .svg. It has no scripts and needs no network.
    """
    parts = dependences(model)
    colours = {chain.name: _COLOURS[i % len(_COLOURS)] for i, chain in enumerate(model.chains)}
    chains = [
        _Box(_LEFT, _at(i), chain.name, ", ".join(chain.labels), colours[chain.name])
        for i, chain in enumerate(model.chains)
    ]
    middle = [_Box(_MIDDLE, _at(i), part.part, part.detail, _INK) for i, part in enumerate(parts)]
    sizes = " × ".join(str(size) for size in model.sizes) or "1"
    plural = "s" if model.n_modes > 1 else ""
    steps = [
        ("mix", f"{len(chains)} chain{'s' if len(chains) != 1 else ''}, one after the other"),
        (f"predict in {model.n_modes} channel{plural}", f"{sizes}: one per joint mode"),
        ("correct", "by the sensor that measured"),
        ("reweigh the modes", "Bayes' rule, in logs"),
        ("collapse", "mean, covariance, P(modes)"),
    ]
    right = [_Box(_RIGHT, _at(i), title, detail, _GREY) for i, (title, detail) in enumerate(steps)]
    rows = max(len(chains), len(middle), len(right))
    width, height = _RIGHT + 250 + 60, _at(rows) + 6
    body = [*_links(parts, chains, middle, colours), *_flow(middle, right), *_headings()]
    body += [line for box in (*chains, *middle) for line in _drawn(box, _WIDTH)]
    body += [line for box in right for line in _drawn(box, 250)]
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" '
            f'height="{height}" font-family="DejaVu Sans, Helvetica, Arial, sans-serif" role="img">',
            f"<title>Model and filter: {model.n_modes} joint mode{plural}</title>",
            f'<rect width="{width}" height="{height}" fill="white"/>',
            '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" '
            f'orient="auto-start-reverse"><path d="M0,0 L8,4 L0,8 Z" fill="{_GREY}"/></marker></defs>',
            *body,
            "</svg>",
        ]
    )


def _at(row: int) -> int:
    return _TOP + row * (_ROW + _GAP)


def _headings() -> Iterator[str]:
    for x, words in (
        (_LEFT, "hidden chains"),
        (_MIDDLE, "depend on them"),
        (_RIGHT, "the filter, at each measurement"),
    ):
        yield f'<text x="{x}" y="36" font-size="14" font-weight="bold" fill="{_INK}">{words}</text>'


def _links(
    parts: Sequence[Dependence], chains: Sequence[_Box], middle: Sequence[_Box], colours: dict[str, str]
) -> Iterator[str]:
    """Draw a curve from each chain to what depends on it."""
    start = {box.title: box for box in chains}
    for part, box in zip(parts, middle, strict=True):
        for i, name in enumerate(part.chains):
            y0 = start[name].y + _ROW / 2
            y1 = box.y + _ROW * (i + 1) / (len(part.chains) + 1)
            x0, x1 = _LEFT + _WIDTH, _MIDDLE
            bend = (x0 + x1) / 2
            yield (
                f'<path class="link" d="M{x0},{y0:g} C{bend:g},{y0:g} {bend:g},{y1:g} {x1},{y1:g}" fill="none" '
                f'stroke="{colours[name]}" stroke-width="2.2"/>'
            )


def _flow(middle: Sequence[_Box], right: Sequence[_Box]) -> Iterator[str]:
    """Draw the recursion from box to box and back to its beginning, and where motion and sensors enter."""
    for above, below in pairwise(right):
        yield _arrow(f"M{_RIGHT + 125},{above.y + _ROW} L{_RIGHT + 125},{below.y}")
    side, y0, y1 = _RIGHT + 250, right[3].y + _ROW / 2, right[0].y + _ROW / 2
    yield _arrow(f"M{side},{y0:g} L{side + 30},{y0:g} L{side + 30},{y1:g} L{side},{y1:g}")
    for i, box in enumerate(middle):
        target = right[1] if i == 0 else right[2]
        x0, y0, y1 = _MIDDLE + _WIDTH, box.y + _ROW / 2, target.y + _ROW / 2
        bend = (x0 + _RIGHT) / 2
        yield _arrow(f"M{x0},{y0:g} C{bend:g},{y0:g} {bend:g},{y1:g} {_RIGHT},{y1:g}")


def _arrow(path: str) -> str:
    return f'<path d="{path}" fill="none" stroke="{_GREY}" stroke-width="1.4" marker-end="url(#tip)"/>'


def _drawn(box: _Box, width: int) -> Iterator[str]:
    yield (
        f'<rect x="{box.x:g}" y="{box.y:g}" width="{width}" height="{_ROW}" rx="5" fill="{_PALE}" '
        f'stroke="{box.colour}" stroke-width="1.6"/>'
    )
    for dy, size, weight, colour, words in ((23, 13, "bold", _INK, box.title), (41, 11.5, "normal", _GREY, box.detail)):
        yield (
            f'<text x="{box.x + 12:g}" y="{box.y + dy:g}" font-size="{size}" font-weight="{weight}" '
            f'fill="{colour}">{escape(_short(words, width))}</text>'
        )


def _short(words: str, width: int) -> str:
    """Cut words that are wider than the box, at about 6.9 px a letter."""
    most = int((width - 24) / 6.9)
    return words if len(words) <= most else words[: most - 1] + "…"
