"""What the reports of one system say in a few figures: how many targets, where, how high."""

from collections import Counter

import numpy as np
import numpy.typing as npt

from saltus.records import Kind, Plots

__all__ = ["Figures"]

_FT, _NM = 0.3048, 1852.0  # m
_MANY = 400  # reports from which on single wild ones are left out of an extent
_OUTER = 0.005  # of the reports beyond each end of an extent
_SECTOR, _ALL_ROUND = 10, 34  # degrees, and so many sectors of 36 with reports
_IDENTITIES = ("Mode S address", "Mode 3/A code", "the system's own track numbers")
_Array = npt.NDArray[np.float64]


class Figures:
    """Figures of one system, over one recording or over all pieces of it in turn."""

    def __init__(self) -> None:
        self._n = self._nameless = self._on_ground = self._n_levels = 0
        self._known: tuple[set[int], ...] = (set(), set(), set())  # by what tells them apart best
        self._spans: dict[str, tuple[float, float]] = {}
        self._azimuth: dict[int, npt.NDArray[np.bool_]] = {}  # by kind: which degrees have reports
        self._middle = 0.0  # degrees: longitudes count from here, so that 180 degrees is no border
        self._levels: Counter[int] = Counter()

    def add(self, plots: Plots) -> None:
        """Count reports."""
        self._n += len(plots)
        rest = np.ones(len(plots), np.bool_)
        codes = (np.asarray(v, np.int64) for v in (plots.icao24, plots.mode3a, plots.local_id))
        for known, values in zip(self._known, codes, strict=True):
            told = rest & (values >= 0)
            known.update(np.unique(values[told]).tolist())
            rest &= ~told
        self._nameless += int(np.count_nonzero(rest))
        self._on_ground += int(np.count_nonzero(plots.on_ground == 1))
        high = plots.altitude[np.isfinite(plots.altitude)] / _FT / 100
        self._n_levels += len(high)
        level, counts = np.unique(np.round(high).astype(np.int64), return_counts=True)
        self._levels.update(dict(zip(level.tolist(), counts.tolist(), strict=True)))
        for kind in (Kind.POLAR, Kind.PLANE, Kind.GEODETIC, Kind.BEARING):
            some = plots.take(plots.kind == kind)
            if len(some):
                self._place(kind, some)

    def _place(self, kind: int, some: Plots) -> None:
        if kind in (Kind.POLAR, Kind.BEARING):
            degrees = np.degrees(some.azimuth[np.isfinite(some.azimuth)]) % 360.0
            seen = self._azimuth.setdefault(kind, np.zeros(360, np.bool_))
            seen[degrees.astype(np.int64) % 360] = True
        if kind == Kind.POLAR:
            self._span("range", some.range)
        elif kind == Kind.PLANE:
            self._span("x", some.x)
            self._span("y", some.y)
        elif kind == Kind.GEODETIC:
            longitude = np.degrees(some.longitude)
            if "latitude" not in self._spans:
                known = some.longitude[np.isfinite(some.longitude)]
                self._middle = float(np.degrees(np.angle(np.exp(1j * known).sum())))
            self._span("latitude", np.degrees(some.latitude))
            self._span("longitude", (longitude - self._middle + 180.0) % 360.0 - 180.0)

    def _span(self, name: str, values: _Array) -> None:
        """Widen a span; of many values without the outermost."""
        values = values[np.isfinite(values)]
        if not len(values):
            return
        ends = (values.min(), values.max()) if len(values) < _MANY else np.quantile(values, (_OUTER, 1.0 - _OUTER))
        low, high = self._spans.get(name, (np.inf, -np.inf))
        self._spans[name] = min(low, float(ends[0])), max(high, float(ends[1]))

    def targets(self) -> str:
        """How many targets there are, by what tells them apart best, and how many more by other codes."""
        told = [f"{len(k)} by {words}" for k, words in zip(self._known, _IDENTITIES, strict=True) if k]
        if not told:
            return "cannot be told: no report carries an identity"
        more = "".join(f", {text} of those without" for text in told[1:])
        rest = f"{self._nameless} report{'' if self._nameless == 1 else 's'} without identity"
        return told[0] + more + (f"; {rest}" if self._nameless else "")

    def extents(self) -> list[str]:
        """Where the reports are, for each kind of position there is."""
        said = []
        if "range" in self._spans:
            near, far = self._spans["range"]
            where = f"range {near / _NM:.1f} to {far / _NM:.1f} NM ({near / 1e3:.1f} to {far / 1e3:.1f} km)"
            said.append(f"{where}, {self._sector(Kind.POLAR)}")
        if "x" in self._spans:
            (west, east), (south, north) = ((a / 1e3, b / 1e3) for a, b in (self._spans["x"], self._spans["y"]))
            said.append(
                f"x {west:.1f} to {east:.1f} km east, y {south:.1f} to {north:.1f} km north of its reference point"
            )
        if "longitude" in self._spans:
            south, north = self._spans["latitude"]
            west, east = ((v + self._middle + 180.0) % 360.0 - 180.0 for v in self._spans["longitude"])
            said.append(f"latitude {south:.3f} to {north:.3f}, longitude {west:.3f} to {east:.3f} degrees")
        if Kind.BEARING in self._azimuth:
            said.append(f"bearings, {self._sector(Kind.BEARING)}")
        return said

    def _sector(self, kind: int) -> str:
        """The sector of azimuth without the widest gap."""
        seen = self._azimuth[kind]
        if seen.reshape(-1, _SECTOR).any(axis=1).sum() >= _ALL_ROUND:
            return "all round"
        degrees = np.flatnonzero(seen)
        if not len(degrees):
            return "no azimuth"
        gaps = np.diff(degrees, append=degrees[0] + 360)
        widest = int(np.argmax(gaps))
        return f"azimuth {degrees[(widest + 1) % len(degrees)]} to {degrees[widest]} degrees"

    def levels(self) -> str:
        """Between which pressure altitudes the reports are, and how many are on the ground; empty when none says."""
        said = []
        if self._levels:
            level = np.array(sorted(self._levels))
            share = np.cumsum([self._levels[int(v)] for v in level]) / self._n_levels
            outer = _OUTER if self._n_levels >= _MANY else 0.0
            low, first, third, high = level[np.searchsorted(share, (outer, 0.25, 0.75, 1.0 - outer))]
            said.append(f"FL {low} to {high}, half of them FL {first} to {third}")
            said.append(f"{self._n_levels / self._n:.0%} tell one")
        if self._on_ground:
            said.append(f"{self._on_ground / self._n:.0%} on the ground")
        return "; ".join(said)
