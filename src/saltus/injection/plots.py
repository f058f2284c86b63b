"""Seeded faults of radar plots."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import DataError
from saltus.records import Kind, Plots

__all__ = ["AZIMUTH", "RANGE", "Injected", "inject"]

AZIMUTH, RANGE = 1, 2
SIZE_AZIMUTH, SIZE_RANGE = np.radians(1.0), 0.5 * 1852.0  # rad, m


class Injected(NamedTuple):
    """Reports with faults in them."""

    plots: Plots
    fault: npt.NDArray[np.int8]  # (N,): 0 none, AZIMUTH, RANGE


def inject(plots: Plots, share: float, rng: np.random.Generator) -> Injected:
    """Turn some usable radar plots by a degree to either side, or move them by half a nautical mile in or out.

    Args:
        plots: reports.
        share: probability that a plot is given a fault; azimuth and range are equally likely, and so are the signs.
        rng: source of randomness.

    Raises:
        DataError: there is no radar plot.
    """
    radar = (plots.kind == Kind.POLAR) & (plots.reason == 0)
    if not radar.any():
        raise DataError(
            "the recording holds no usable radar plot (range and azimuth), and faults of azimuth and range need some."
        )
    hit = radar & (rng.uniform(size=len(plots)) < share)
    sign = rng.choice([-1.0, 1.0], len(plots))
    turned = hit & ((rng.uniform(size=len(plots)) < 0.5) | (plots.range < 2.0 * SIZE_RANGE))
    moved = hit & ~turned
    azimuth = np.where(turned, (plots.azimuth + sign * SIZE_AZIMUTH) % (2.0 * np.pi), plots.azimuth)
    slant = np.where(moved, plots.range + sign * SIZE_RANGE, plots.range)
    fault = np.where(turned, AZIMUTH, np.where(moved, RANGE, 0)).astype(np.int8)
    return Injected(replace(plots, azimuth=azimuth, range=slant), fault)
