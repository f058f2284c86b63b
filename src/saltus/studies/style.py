"""One look for all pictures of the studies: white, thin, few colours, units on every axis."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from saltus.io.write import blamed

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["BLUE", "GREY", "INK", "LIGHT", "ORANGE", "TEAL", "new_figure", "save", "shade"]

# Distinguishable for colour-blind readers and in grey print (blue and orange of Okabe and Ito, darkened).
BLUE, ORANGE, TEAL = "#1f5fa8", "#d1600a", "#2a9182"
INK, GREY, LIGHT = "#1c2430", "#7b8490", "#eceef1"

_RC: dict[Any, object] = {  # the keys are literals to matplotlib's types
    "axes.axisbelow": True,
    "axes.edgecolor": GREY,
    "axes.grid": True,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.8,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 11,
    "axes.titleweight": "bold",
    "figure.titlesize": 13,
    "font.family": "DejaVu Sans",
    "font.size": 10,
    "grid.color": "#e2e5e9",
    "grid.linewidth": 0.7,
    "legend.frameon": False,
    "legend.fontsize": 9.5,
    "lines.linewidth": 1.7,
    "lines.solid_capstyle": "round",
    "text.color": INK,
    "xtick.color": GREY,
    "xtick.labelcolor": INK,
    "ytick.color": GREY,
    "ytick.labelcolor": INK,
}


@contextmanager
def new_figure(height: float, title: str) -> "Iterator[Figure]":
    """Give an empty figure 8 inches wide, `height` inches high, in the house style, while the block lasts.

    No pyplot: figures belong to nobody else and are drawn by the Agg canvas wherever there is no screen.
    """
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(_RC):
        figure = Figure(figsize=(8.0, height), dpi=150, layout="constrained")
        figure.suptitle(title, x=0.012, ha="left", fontweight="bold")
        yield figure


def save(figure: "Figure", path: Path) -> None:
    """Write the figure as PNG, 1200 pixels wide; equal figures give equal bytes."""
    with blamed(path):
        figure.savefig(path, format="png", metadata={"Software": None})


def shade(axes: "Axes", time: npt.ArrayLike, flags: npt.ArrayLike, label: str | None = None) -> None:
    """Shade the intervals that end at the flagged times, behind everything else."""
    t, on = np.asarray(time, np.float64), np.asarray(flags, np.bool_)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], on.astype(int), [0]])))
    for start, stop in edges.reshape(-1, 2):
        axes.axvspan(t[max(start - 1, 0)], t[stop - 1], color=LIGHT, lw=0, zorder=0, label=label)
        label = None
