"""How far apart two systems see what has one address: a figure for each stretch of time."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from saltus.identify import LocalTracks

__all__ = ["Distances"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.int64]
_Rows = dict[int, tuple[_Array, _Array]]  # times and positions by address


class Distances:
    """Distances between the positions of one address in two systems while both have it."""

    def __init__(self, address: Sequence[_Index]) -> None:
        """Begin with none; `address` are those of each system's tracks, -1 none."""
        self._address = list(address)
        self._common: list[tuple[int, int, set[int]]] = []
        for i, a in enumerate(self._address):
            for j in range(i + 1, len(self._address)):
                common = np.intersect1d(a[a >= 0], self._address[j])
                if len(common):
                    self._common.append((i, j, set(common.tolist())))
        self._wanted = [set[int]().union(*(c for i, j, c in self._common if k in (i, j))) for k in range(len(address))]
        self._medians: dict[tuple[int, int, int], list[float]] = {}

    def add(self, latest: Sequence[LocalTracks]) -> None:
        """Take the next rows of every system, in the order of the systems' addresses."""
        rows = [self._by_address(k, tracks) for k, tracks in enumerate(latest)]
        for i, j, common in self._common:
            for code in common & rows[i].keys() & rows[j].keys():
                (ta, za), (tb, zb) = rows[i][code], rows[j][code]
                inside = (ta >= tb[0]) & (ta <= tb[-1])
                if inside.any():
                    at_b = np.column_stack([np.interp(ta[inside], tb, zb[:, axis]) for axis in (0, 1)])
                    far = float(np.median(np.linalg.norm(za[inside] - at_b, axis=-1)))
                    self._medians.setdefault((i, j, code), []).append(far)

    def medians(self) -> dict[tuple[int, int, int], float]:
        """Return the median over all stretches, by systems and address, m."""
        return {key: float(np.median(values)) for key, values in self._medians.items()}

    def _by_address(self, k: int, tracks: LocalTracks) -> _Rows:
        """Return the rows of each address wanted, in order of time."""
        out: _Rows = {}
        if not self._wanted[k] or not len(tracks.track):
            return out
        address = self._address[k][tracks.track]
        order = np.lexsort((tracks.time, address))
        codes, first = np.unique(address[order], return_index=True)
        for code, at in zip(codes.tolist(), np.split(order, first[1:]), strict=True):
            if code in self._wanted[k]:
                out[code] = tracks.time[at], tracks.z[at]
        return out
