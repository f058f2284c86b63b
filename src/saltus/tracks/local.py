"""The local tracks of each system, as registration and identification see them."""

from collections.abc import Sequence
from itertools import accumulate
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from saltus.geo import Plane
from saltus.identify import LocalTracks
from saltus.shapes import Int
from saltus.tracks.colour import inflation
from saltus.tracks.encounters import SystemTracks
from saltus.tracks.measurements import Measurements
from saltus.tracks.rows import Assignments, Rows

__all__ = ["LocalSystem", "Misfit", "Party", "Stated", "foreign_systems", "group_sources", "local_system"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.int64]

_SHARE, _CUT = 0.1, 2000.0  # of the latest in a running mean of d2, and where d2 is cut
_ACCEL = 3.0  # m/s^2: what bends the way between reports without being an error
_PAUSE = 60.0  # s: a track number silent for longer is given to another object


class LocalSystem(NamedTuple):
    """The confirmed local tracks of one system."""

    name: str
    view: SystemTracks
    mode3a: Int[np.ndarray, " k"]  # code of each track, -1 none
    local_id: tuple[str, ...]  # the system's own number or address of each track, "" none
    ready: npt.NDArray[np.float64]  # (K,): when each was confirmed, s
    ids: Int[np.ndarray, " k"]  # the local tracker's number of each track
    measurement: Int[np.ndarray, " n"]  # of each row; -1 where the system gives tracks only
    noise: float  # median stated standard deviation of a report, each axis, m
    known: npt.NDArray[np.float64]  # (n,): when each row was known, s
    codes: Int[np.ndarray, "n 2"]  # address and Mode 3/A code of each row, -1 none

    @property
    def own(self) -> bool:
        """Whether there are measurements, and not another centre's tracks alone."""
        return bool(len(self.measurement) == 0 or self.measurement[0] >= 0)


class Party(NamedTuple):
    """Sources whose reports make common local tracks."""

    name: str
    sources: tuple[int, ...]


def group_sources(names: Sequence[str], pooled: Sequence[bool], told: Sequence[str]) -> list[Party]:
    """Return the systems: each ASTERIX source one, all sources of tables together, unless the configuration says.

    Args:
        names: designation of each source, `CAT048:20/129` or the name for tables.
        pooled: whether each makes common local tracks with others (`Traits.pooled`).
        told: system of each as configured, "" where it is not.
    """
    groups: dict[str, list[int]] = {}
    tables = [s for s, common in enumerate(pooled) if common and not told[s]]
    shared = names[tables[0]] if len(tables) == 1 else "table"
    for s, name in enumerate(names):
        groups.setdefault(told[s] or (shared if pooled[s] else name), []).append(s)
    return [Party(name, tuple(sources)) for name, sources in groups.items()]


def local_system(
    name: str, m: Measurements, found: Assignments, rows: Rows, numbers: npt.NDArray[np.integer], *, use_identity: bool
) -> LocalSystem:
    """Gather what a tracker of one system found.

    Args:
        name: of the system.
        m: its measurements.
        found: what became of them.
        rows: everything published.
        numbers: the system's own track number of each measurement, -1 none, (N,).
        use_identity: whether addresses and codes may be looked at.
    """
    update = np.flatnonzero(rows.measurement >= 0)
    velocity = np.zeros((len(m), 2))
    velocity[rows.measurement[update]] = rows.moments.mean[update][:, [1, 3]]
    at = np.flatnonzero(np.isin(found.track_id, found.confirmed) & np.isfinite(m.position[:, 0]))
    at = at[np.lexsort((m.time[at], found.track_id[at]))]
    ids, track = np.unique(found.track_id[at], return_inverse=True)
    sure = rows.status == 2
    ready = np.full(len(ids), np.inf)
    place = np.minimum(np.searchsorted(ids, rows.track_id), max(len(ids) - 1, 0))
    sure &= ids[place] == rows.track_id if len(ids) else False
    np.minimum.at(ready, place[sure], rows.time_known[sure])
    known = np.full(len(m), np.nan)
    known[rows.measurement[update]] = rows.time_known[update]
    known = np.where(np.isnan(known[at]), ready[track], known[at])  # a track's first plots, told with a later one
    R = Stated().covariance(m, at, velocity[at], track)
    noise = float(np.sqrt(np.median(np.trace(R, axis1=-2, axis2=-1)) / 2.0)) if len(at) else np.inf
    R = R * Misfit().factor(track, m.time[at], m.position[at, :2], R)[:, None, None]
    icao24 = np.array([_commonest(m.icao24[at], track, k) for k in range(len(ids))], np.int64)
    own = np.array([_commonest(np.asarray(numbers)[at], track, k) for k in range(len(ids))], np.int64)
    mode3a = np.array([_commonest(m.mode3a[at], track, k) for k in range(len(ids))], np.int64)
    label = tuple(f"{c:06X}" if c >= 0 else str(n) if n >= 0 else "" for c, n in zip(icao24, own, strict=True))
    hidden = np.full(len(ids), -1)
    view = SystemTracks(
        LocalTracks(track, m.time[at], m.position[at, :2], R),
        velocity[at],
        m.ray[at],
        icao24 if use_identity else hidden,
    )
    codes = np.column_stack([m.icao24[at], m.mode3a[at]]).astype(np.int64)
    codes = codes if use_identity else np.full_like(codes, -1)
    return LocalSystem(name, view, mode3a if use_identity else hidden, label, ready, ids, at, noise, known, codes)


class Stated:
    """Covariances of positions by which all reports of a track together tell as much as they do.

    The variance of what lasts counts by its `inflation` in each report but the first of its source.
    """

    def __init__(self) -> None:
        """Begin without reports."""
        self._last: dict[tuple[int, int], float] = {}  # time of the last one by track and source

    def covariance(self, m: Measurements, at: npt.NDArray[np.intp], velocity: _Array, track: _Index) -> _Array:
        """Return those of the next reports, (k, 2, 2), m^2.

        Args:
            m: measurements.
            at: which, time not decreasing within a track, (k,).
            velocity: of their targets, (k, 2), m/s.
            track: of each, (k,).
        """
        R, lasting = (m.cov[at] + m.stamped(at, velocity))[:, :2, :2], m.lasting[at]
        if not lasting.any():
            return np.asarray(R)
        dt = np.full(len(at), np.inf)
        for k, key in enumerate(zip(track.tolist(), m.source[at].tolist(), strict=True)):
            time = float(m.time[at[k]])
            dt[k] = time - self._last.get(key, -np.inf)
            self._last[key] = time
        dt[dt <= 0.0] = np.inf
        again = inflation(dt, m.lasting_time[at]) - 1.0
        return np.asarray(R + again[:, None, None] * (lasting @ lasting.swapaxes(1, 2)))

    def forget(self, before: float) -> None:
        """Forget reports before a time, s: of tracks that are over."""
        self._last = {key: time for key, time in self._last.items() if time >= before}


class Misfit:
    """Factor of the stated variance that each track's latest reports ask for, at least 1.

    The middle one of three reports lies off the line through the others by its error, theirs in part, and what an
    acceleration does. A running mean of d2 / 2 over some ten of these, each cut at a value that a gross outlier cannot
    exceed, is known one report later.
    """

    def __init__(self) -> None:
        """Begin without reports."""
        self._last: dict[int, _Latest] = {}

    def factor(self, track: _Index, time: _Array, z: _Array, R: _Array) -> _Array:
        """Return the factor of each of the next reports.

        Args:
            track: of each, sorted, (n,).
            time: not decreasing within a track, s.
            z: positions (n, 2), m.
            R: stated covariances (n, 2, 2), m^2.
        """
        if not len(track):
            return np.ones(0)
        edge = np.flatnonzero(np.diff(track, prepend=-1, append=-1))
        before = [self._last.get(int(track[k]), _NEW) for k in edge[:-1].tolist()]
        n = [len(x.time) for x in before]
        put = np.repeat(edge[:-1], n)
        rows = np.full(len(time), True)
        rows = np.insert(rows, put, False)
        time, track = np.insert(time, put, [t for x in before for t in x.time]), np.insert(track, put, track[put])
        z = np.insert(z, put, [row for x in before for row in x.z], axis=0) if len(put) else z
        R = np.insert(R, put, [row for x in before for row in x.R], axis=0) if len(put) else R
        value, out = _offsets(track, time, z, R), np.ones(len(time))
        starts = edge[:-1] + np.cumsum([0, *n[:-1]])
        for first, stop, old in zip(starts.tolist(), [*starts[1:].tolist(), len(time)], before, strict=True):
            known = len(old.time)
            value[first : first + 2] = 1.0
            begin = [old.mean] if known else [float(value[first])]
            out[first + max(known - 1, 0) : stop] = list(
                accumulate([*begin, *value[first + max(known, 1) : stop].tolist()], _running)
            )
            late = slice(max(first, stop - 2), stop)
            self._last[int(track[first])] = _Latest(time[late].tolist(), z[late], R[late], float(out[stop - 1]))
        return np.asarray(np.maximum(out[rows], 1.0))

    def forget(self, before: float) -> None:
        """Forget tracks without a report since a time, s."""
        self._last = {track: x for track, x in self._last.items() if x.time[-1] >= before}


class _Latest(NamedTuple):
    """The last two reports of a track, and its running mean."""

    time: list[float]
    z: _Array
    R: _Array
    mean: float


_NEW = _Latest([], np.zeros((0, 2)), np.zeros((0, 2, 2)), 1.0)


def _offsets(track: _Index, time: _Array, z: _Array, R: _Array) -> _Array:
    """Half the squared distance of the middle one of each row and the two before it; 1 for the first two of all."""
    if len(time) < 3:
        return np.ones(len(time))
    whole = track[2:] == track[:-2]
    before, after = time[1:-1] - time[:-2], time[2:] - time[1:-1]
    w = np.where(before + after > 0, before / np.maximum(before + after, 1e-9), 0.5)[:, None]
    e = z[1:-1] - (1.0 - w) * z[:-2] - w * z[2:]
    w = w[..., None]
    bent = (0.5 * _ACCEL * before * after)[:, None, None] ** 2 * np.eye(2)
    S = R[1:-1] + (1.0 - w) ** 2 * R[:-2] + w**2 * R[2:] + bent
    d2 = np.where(whole, np.einsum("ni,nij,nj->n", e, np.linalg.inv(S), e), 2.0)
    return np.concatenate([[1.0, 1.0], np.minimum(d2, _CUT) / 2.0])  # row k knows the middle ones up to k - 1


def _running(mean: float, value: float) -> float:
    """Return the running mean after one more value; scipy.signal does the same and takes 0.3 s to import."""
    return (1.0 - _SHARE) * mean + _SHARE * value


def _commonest(codes: npt.NDArray[np.integer], track: _Index, k: int) -> int:
    own = codes[slice(*np.searchsorted(track, [k, k + 1]))]
    own = own[own >= 0]
    if not len(own):
        return -1
    values, count = np.unique(own, return_counts=True)
    return int(values[count.argmax()])


def foreign_systems(tracks: pa.Table, plane: Plane, sigma: float, *, use_identity: bool) -> list[LocalSystem]:
    """Return the systems of another centre's tracks (CAT062), one for each designation in the column `system`.

    Args:
        tracks: of `Recording`.
        plane: to put positions in.
        sigma: standard deviation of a position, each axis, m.
        use_identity: whether addresses and codes may be looked at.
    """
    names = np.array(tracks["system"].to_pylist())
    return [
        _foreign(str(name), tracks.filter(pa.array(names == name)), plane, sigma, use_identity=use_identity)
        for name in dict.fromkeys(names.tolist())
    ]


def _foreign(name: str, tracks: pa.Table, plane: Plane, sigma: float, *, use_identity: bool) -> LocalSystem:
    number, time, lat, lon = (_numbers(tracks, c) for c in ("track_number", "time", "latitude", "longitude"))
    z = plane.forward(np.radians(lat), np.radians(lon))
    coasted = _numbers(tracks, "coasted") > 0
    usable = np.flatnonzero(np.isfinite(z[:, 0]) & np.isfinite(time) & (number >= 0) & ~coasted)
    order = usable[np.lexsort((time[usable], number[usable]))]
    new = np.diff(number[order], prepend=-1.0) != 0
    new |= np.diff(time[order], prepend=-np.inf) > _PAUSE
    fresh = new | (np.diff(time[order], prepend=-np.inf) > 0)  # one state at a time
    track, order = (np.cumsum(new) - 1)[fresh], order[fresh]
    first = np.flatnonzero(np.diff(track, prepend=-1))
    code, address = _codes(tracks, "mode3a", 8)[order], _codes(tracks, "icao24", 16)[order]
    mode3a, icao24 = (np.array([_commonest(c, track, k) for k in range(len(first))], np.int64) for c in (code, address))
    hidden = np.full(len(first), -1)
    view = SystemTracks(
        LocalTracks(track, time[order], z[order], np.broadcast_to(sigma**2 * np.eye(2), (len(track), 2, 2)).copy()),
        np.column_stack([np.nan_to_num(_numbers(tracks, c)[order]) for c in ("vx", "vy")]),
        np.full((len(track), 2), np.nan),
        icao24 if use_identity else hidden,
    )
    label = tuple(str(int(n)) for n in number[order][first])
    none = np.full(len(track), -1)
    codes = mode3a if use_identity else hidden
    told = np.column_stack([address, code]) if use_identity else np.full((len(track), 2), -1)
    when, ids = time[order], np.arange(len(first))
    return LocalSystem(name, view, codes, label, when[first], ids, none, sigma, when, told)


def _numbers(tracks: pa.Table, name: str) -> _Array:
    return np.asarray(tracks[name].to_numpy(zero_copy_only=False), dtype=np.float64)


def _codes(tracks: pa.Table, name: str, base: int) -> _Index:
    return np.array([int(v, base) if v else -1 for v in tracks[name].to_pylist()], np.int64)
