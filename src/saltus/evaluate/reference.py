"""Where targets truly were: one table of fixes, and its interpolation."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.geo import ecef_to_geodetic, geodetic_to_ecef, local_basis
from saltus.shapes import Bool, Float, Int

__all__ = ["Around", "Known", "Reference", "around", "each_time_once", "make_reference"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.intp]

_LONGEST_GAP = 10.0  # s: between two fixes further apart a target's place is unknown
_EARTH = 6371e3  # m


class Around(NamedTuple):
    """The rows about each wanted time: values there are (1 - share) x[before] + share x[after]."""

    before: Int[np.ndarray, " k"]
    after: Int[np.ndarray, " k"]
    share: Float[np.ndarray, " k"]  # of the interval gone
    inside: Bool[np.ndarray, " k"]  # whether the time lies between them, and they near enough in time


def around(
    label: Int[np.ndarray, " n"],
    time: Float[np.ndarray, " n"],
    wanted: Int[np.ndarray, " k"],
    at: Float[np.ndarray, " k"],
    longest: float = np.inf,
) -> Around:
    """Find the two rows of a label about each wanted time.

    Args:
        label: of each row, sorted.
        time: of each row, ascending within a label, s.
        wanted: label asked for.
        at: time asked for, s.
        longest: s between two rows, from which nothing is known between them; at their own times it is.
    """
    before, share, inside = np.zeros(len(at), np.intp), np.ones(len(at)), np.zeros(len(at), bool)
    after = before.copy()
    for name in np.unique(wanted):
        a, b = np.searchsorted(label, name), np.searchsorted(label, name, side="right")
        mine = np.flatnonzero(wanted == name)
        if a == b:
            continue
        t = at[mine]
        after[mine] = np.clip(np.searchsorted(time[a:b], t), 0, b - a - 1) + a
        before[mine] = np.maximum(after[mine] - 1, a)
        gap = time[after[mine]] - time[before[mine]]
        share[mine] = np.where(gap > 0, (t - time[before[mine]]) / np.where(gap > 0, gap, 1.0), 1.0)
        inside[mine] = (t >= time[a]) & (t <= time[b - 1]) & ((gap <= longest) | (share[mine] == 1.0))
    return Around(before, after, share, inside)


class Known(NamedTuple):
    """Targets at wanted times; NaN where nothing is known."""

    place: Float[np.ndarray, "k 3"]  # earth-centred, m, at height 0
    velocity: Float[np.ndarray, "k 2"]  # to true east and north, m/s


class Reference(NamedTuple):
    """True places: one row a fix, sorted by target, then by time, each time of a target once."""

    names: tuple[str, ...]
    target: Int[np.ndarray, " n"]  # index into names
    time: Float[np.ndarray, " n"]  # s, UTC
    place: Float[np.ndarray, "n 3"]  # earth-centred, m, at height 0
    altitude: Float[np.ndarray, " n"]  # m; NaN where not told
    velocity: Float[np.ndarray, "n 2"]  # to true east and north, m/s; NaN where not told
    turning: Bool[np.ndarray, " n"]  # whether it is told to manoeuvre

    def at(self, target: Int[np.ndarray, " k"], time: Float[np.ndarray, " k"], longest: float = _LONGEST_GAP) -> Known:
        """Return where targets were at times between their fixes.

        With u the share of the interval T gone: x = (1 - u) x_0 + u x_1 where no velocity is told, else the cubic that
        has the places and the velocities v of both fixes,

            x = (1 - 3u^2 + 2u^3) x_0 + (3u^2 - 2u^3) x_1 + T u (1 - u)^2 v_0 - T u^2 (1 - u) v_1.

        Velocities are interpolated linearly.

        Args:
            target: index into `names`, -1 for none.
            time: s.
            longest: s between two fixes from which nothing is known between them.

        Source: cubic Hermite interpolation.
        """
        a, b, u, inside = around(self.target, self.time, target, time, longest)
        place, velocity = np.full((len(time), 3), np.nan), np.full((len(time), 2), np.nan)
        a, b, u = a[inside], b[inside], u[inside, None]
        x = (1.0 - u) * self.place[a] + u * self.place[b]
        bent = x + (self._motion(a, b, u) if len(u) else 0.0)
        place[inside] = np.where(np.isfinite(bent), bent, x)
        velocity[inside] = (1.0 - u) * self.velocity[a] + u * self.velocity[b]
        velocity[np.flatnonzero(inside)[u[:, 0] == 1.0]] = self.velocity[b[u[:, 0] == 1.0]]
        return Known(place, velocity)

    def _motion(self, a: _Index, b: _Index, u: _Array) -> _Array:
        """What the cubic adds to the straight line."""
        T = (self.time[b] - self.time[a])[:, None]
        chord = self.place[b] - self.place[a]
        v0, v1 = self._earth_velocity(a), self._earth_velocity(b)
        moved = (3.0 * u**2 - 2.0 * u**3 - u) * chord + T * u * (1.0 - u) ** 2 * v0 - T * u**2 * (1.0 - u) * v1
        return np.asarray(np.where(T > 0.0, moved, 0.0))

    def _earth_velocity(self, rows: _Index) -> _Array:
        """Velocity at height 0: what moves at a height moves slower over the ground below."""
        latitude, longitude, _ = ecef_to_geodetic(self.place[rows])
        down = _EARTH / (_EARTH + np.nan_to_num(self.altitude[rows]))
        return np.asarray(np.einsum("k,ki,kij->kj", down, self.velocity[rows], local_basis(latitude, longitude)[:, :2]))

    def turned(
        self, target: Int[np.ndarray, " k"], time: Float[np.ndarray, " k"], within: float = 0.0
    ) -> Bool[np.ndarray, " k"]:
        """Say which targets manoeuvre at a time, by the nearest fix, or did less than `within` seconds before it.

        Args:
            target: index into `names`.
            time: s.
            within: s.
        """
        before, after, share, _ = around(self.target, self.time, target, time)
        nearest = np.where(share < 0.5, before, after)
        first = around(self.target, self.time, target, time - within).after
        count = np.append(0, np.cumsum(self.turning))
        known = np.isin(target, self.target)
        return np.asarray(known & (count[nearest + 1] > count[np.minimum(first, nearest)]))


def make_reference(
    label: npt.ArrayLike,
    time: npt.ArrayLike,
    latitude: npt.ArrayLike,
    longitude: npt.ArrayLike,
    *,
    velocity: npt.ArrayLike | None = None,
    altitude: npt.ArrayLike | None = None,
    turning: npt.ArrayLike | None = None,
) -> Reference:
    """Make a reference of fixes in any order; of two fixes of one target and time the last counts.

    Args:
        label: name of each fix's target.
        time: s, UTC.
        latitude: rad.
        longitude: rad.
        velocity: to true east and north, (N, 2), m/s.
        altitude: m, at which the velocities hold; taken for 0 where not given.
        turning: whether the target manoeuvres.
    """
    when = np.asarray(time, np.float64)
    names, target = np.unique(np.asarray(label).astype(str), return_inverse=True)
    keep = each_time_once(target, when)
    place = geodetic_to_ecef(np.asarray(latitude, float)[keep], np.asarray(longitude, float)[keep], 0.0)
    height = np.full(len(when), np.nan) if altitude is None else np.asarray(altitude, np.float64)
    v = np.full((len(when), 2), np.nan) if velocity is None else np.asarray(velocity, np.float64)
    turns = np.zeros(len(when), bool) if turning is None else np.asarray(turning, bool)
    rows = target[keep].astype(np.intp)
    return Reference(tuple(names.tolist()), rows, when[keep], place, height[keep], v[keep], turns[keep])


def each_time_once(label: npt.NDArray[np.integer], time: _Array) -> _Index:
    """Order by label and time; of rows of one label and time the last is kept."""
    order: _Index = np.lexsort((time, label))
    again = (np.diff(label[order]) == 0) & (np.diff(time[order]) == 0)
    return np.asarray(order[np.append(~again, np.ones(min(1, len(order)), bool))])
