"""The exact likelihood of first-order noise plus white noise on irregular times, for many parameters at once.

    r_k = bias + w(t_k) + v_k,   E w(t) w(t+s) = sigma^2 exp(-|s|/tau),   cov v = white^2

as residuals, or as r_k = x(t_k) + w(t_k) + v_k with a position x of white acceleration of density q. Series are
independent; a Kalman filter gives the innovations, candidates and series are array axes.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.shapes import Float

__all__ = ["Series", "Sums", "innovations", "log_likelihood", "pack", "sums"]

_Array = npt.NDArray[np.float64]
_SKIPPED = 3  # rows of a track that only start its position and velocity


class Series(NamedTuple):
    """Independent series, the longest first, side by side: NaN beyond each one's end."""

    t: _Array  # (S, K), s
    r: _Array  # (S, K)
    lengths: npt.NDArray[np.int64]  # (S,)


class Sums(NamedTuple):
    """What the likelihood of P candidates is made of; z stands for the data, 1 for a constant."""

    log_s: Float[np.ndarray, " p"]  # sum log S
    zz: Float[np.ndarray, " p"]  # sum nu_z^2 / S
    z1: Float[np.ndarray, " p"]
    one: Float[np.ndarray, " p"]
    n: int

    @property
    def bias(self) -> Float[np.ndarray, " p"]:
        """Generalised least squares estimate of the common bias; 0 for tracks."""
        return np.asarray(np.divide(self.z1, self.one, out=np.zeros_like(self.z1), where=self.one > 0))

    @property
    def quadratic(self) -> Float[np.ndarray, " p"]:
        """Sum nu^2 / S with the bias removed."""
        return np.asarray(self.zz - self.bias * self.z1)


def pack(times: npt.ArrayLike, values: npt.ArrayLike, labels: npt.ArrayLike) -> Series:
    """Lay values (N,) out by label and time."""
    t, r, label = np.asarray(times, np.float64), np.asarray(values, np.float64), np.asarray(labels)
    _, which = np.unique(label, return_inverse=True)
    counts = np.bincount(which)
    rank = np.empty(len(counts), np.int64)
    rank[np.argsort(-counts, kind="stable")] = np.arange(len(counts))
    order = np.lexsort((t, rank[which]))
    row = rank[which][order]
    lengths = np.sort(counts)[::-1]
    column = np.arange(len(t)) - np.concatenate([[0], np.cumsum(lengths)])[row]
    out_t, out_r = np.full((2, len(counts), int(lengths[0])), np.nan)
    out_t[row, column], out_r[row, column] = t[order], r[order]
    return Series(out_t, out_r, lengths)


def log_likelihood(s: Sums) -> Float[np.ndarray, " p"]:
    """Return log f of the data, with the bias at its best value."""
    return np.asarray(-0.5 * (s.n * np.log(2 * np.pi) + s.log_s + s.quadratic))


def sums(series: Series, theta: npt.ArrayLike) -> Sums:
    """Filter all series under all candidates.

    Args:
        series: the data.
        theta: (P, 3) variances and times tau, sigma^2, white^2 of residuals; (P, 4) with q appended, of positions.
    """
    p = np.asarray(theta, np.float64)
    log_s, zz, z1, one = np.zeros((4, len(p)))
    n = 0
    for k, (nu, S) in enumerate(innovations(series, p)):
        if p.shape[1] == 4 and k < _SKIPPED:
            continue
        log_s += np.log(S).sum(-1)
        zz += (nu[0] ** 2 / S).sum(-1)
        z1 += (nu[0] * nu[1] / S).sum(-1)
        one += (nu[1] ** 2 / S).sum(-1)
        n += S.shape[-1]
    return Sums(log_s, zz, z1, one, n)


def innovations(series: Series, theta: npt.ArrayLike) -> list[tuple[_Array, _Array]]:
    """Return, for each row of the series, innovations of data and constant (2, P, s) and their variances (P, s).

    s is the number of series that reach that row.
    """
    p = np.asarray(theta, np.float64)
    return _of_residuals(series, p) if p.shape[1] == 3 else _of_tracks(series, p)


def _of_residuals(series: Series, p: _Array) -> list[tuple[_Array, _Array]]:
    tau, var, white = (a[:, None] for a in p.T)
    n_series, n_rows = series.r.shape
    mean, cov = np.zeros((2, len(p), n_series)), np.broadcast_to(var, (len(p), n_series))
    out = []
    for k in range(n_rows):
        s = int((series.lengths > k).sum())
        if k > 0:
            phi = np.exp(-(series.t[:s, k] - series.t[:s, k - 1]) / tau)
            mean, cov = phi * mean[..., :s], phi**2 * cov[:, :s] + var * (1 - phi**2)
        S = cov + white
        nu = np.stack([series.r[:s, k] - mean[0], 1.0 - mean[1]])
        gain = cov / S
        mean, cov = mean + gain * nu, cov * white / S
        out.append((nu, S))
    return out


def _of_tracks(series: Series, p: _Array) -> list[tuple[_Array, _Array]]:
    """State (x, v, w); the first sample fixes x + w + v, velocity starts unknown."""
    tau, var, white, q = (a[:, None] for a in p.T)
    shape = (len(p), len(series.r))
    x = np.zeros((*shape, 3))
    x[..., 0] = series.r[:, 0]
    P = np.zeros((*shape, 3, 3))
    P[..., 0, 0], P[..., 2, 2] = var + white, var
    P[..., 0, 2] = P[..., 2, 0] = -np.broadcast_to(var, shape)
    P[..., 1, 1] = 1e6 * (var + white)
    out = [(np.zeros((2, *shape)), np.ones(shape))]
    for k in range(1, series.r.shape[1]):
        s = int((series.lengths > k).sum())
        dt = series.t[:s, k] - series.t[:s, k - 1]
        x, P = _predict(x[:, :s], P[:, :s], dt, np.exp(-dt / tau), var, q)
        U = P[..., 0] + P[..., 2]
        S = U[..., 0] + U[..., 2] + white
        nu = series.r[:s, k] - x[..., 0] - x[..., 2]
        K = U / S[..., None]
        x = x + K * nu[..., None]
        P = P - K[..., :, None] * U[..., None, :]
        out.append((np.stack([nu, np.zeros_like(nu)]), S))
    return out


def _predict(x: _Array, P: _Array, dt: _Array, phi: _Array, var: _Array, q: _Array) -> tuple[_Array, _Array]:
    F = np.zeros((*phi.shape, 3, 3))
    F[..., 0, 0] = F[..., 1, 1] = 1.0
    F[..., 0, 1], F[..., 2, 2] = dt, phi
    P = F @ P @ F.swapaxes(-1, -2)
    P[..., 0, 0] += q * dt**3 / 3
    P[..., 0, 1] += q * dt**2 / 2
    P[..., 1, 0] += q * dt**2 / 2
    P[..., 1, 1] += q * dt
    P[..., 2, 2] += var * (1 - phi**2)
    return (F @ x[..., None])[..., 0], P
