r"""The adjoint smoother: the best estimate of every row from all rows, in the filter's own time and form.

Beside the filter's Gaussian (x, R) of a mode, called the reference, the future z_{k+1}..z_K is one message in adjoint
form: with Z(m) = ∫ N(x; m, R) p(z_{k+1}..z_K | x) dx,

    c = log Z(x),   a = grad log Z(x),   B = -hess log Z(x):    x_s = x + R a,   R_s = R - R B R.

No covariance is inverted, so singular Q, R and priors need nothing. After a switch the mixture of messages is replaced
by the one with the same c, a and B. That is exact for one mode, for chains that cannot switch, and for the first step
back from a row at which the filter is exact.

Source: smoothing notes, sections 2 and 9; the adjoint of one mode is that of de Jong (1989), Biometrika 76.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.filters import steps
from saltus.filters.align import Aligned
from saltus.filters.refusals import NotPositive, check_evidence, place
from saltus.linalg import gaussian_terms, logsumexp, normalised, symmetric

__all__ = ["Message", "Passed", "Smoothed", "forward", "smooth", "smooth_lag"]

_Array = npt.NDArray[np.float64]
_Rows = int | npt.NDArray[np.intp]

_DEPENDENT = 1e-13  # of the largest eigenvalue of a curvature: what is smaller is not there


class Message(NamedTuple):
    """What later measurements say of the state in each mode, at a reference."""

    c: _Array  # (*lead, M1, ..., MC)
    a: _Array  # (*lead, M1, ..., MC, n)
    B: _Array  # (*lead, M1, ..., MC, n, n), guarded
    curvature: _Array  # likewise, as it is: what covariances are made of


class Passed(NamedTuple):
    """What the filter leaves for the way back; the first axis of every array is the row."""

    stages: tuple[steps.Belief, ...]  # before each row: its predecessor's belief, then after each chain's mixing
    posterior: steps.Belief
    trans: tuple[_Array | None, ...]  # (T, *batch|1, Mc, Mc)
    score: _Array  # (HF)'S^-1 nu, (T, *batch, M1, ..., MC, n)
    information: _Array  # (HF)'S^-1 (HF), (..., n, n)
    through: _Array  # Psi = F - K (HF), (..., n, n)
    loglik: _Array  # of each mode, (T, *batch, M1, ..., MC)
    log_f: _Array  # (T, *batch)
    nis: _Array  # (T, *batch)

    @property
    def n_chains(self) -> int:
        """Number of chains."""
        return len(self.trans)


class Smoothed(NamedTuple):
    """Smoothed rows; the first axis is the row."""

    log_probs: _Array  # (T, *batch, M1, ..., MC)
    means: _Array  # (..., n)
    covs: _Array  # (..., n, n)
    pairs: tuple[_Array | None, ...]  # (T, *batch, Mc, Mc); None for a chain that cannot switch


def forward(model: Aligned) -> Passed:
    """Filter, and keep what the way back needs.

    Raises:
        NumericalError: an innovation covariance is not positive definite.
    """
    n_chains, batch, n = len(model.trans), model.z.shape[:-2], model.cov0.shape[-1]
    lead = (*batch, *model.sizes)
    belief = steps.Belief(
        np.broadcast_to(model.log_probs0, lead),
        np.broadcast_to(model.mean0, (*lead, n)),
        np.broadcast_to(model.cov0, (*lead, n, n)),
    )
    rows = []
    for k in range(model.z.shape[-2]):
        row = _row(model, belief, k, n_chains)
        belief = row.posterior
        rows.append(row)
    return Passed(
        tuple(_beliefs([row.stages[c] for row in rows]) for c in range(n_chains + 1)),
        _beliefs([row.posterior for row in rows]),
        tuple(_stacked([row.trans[c] for row in rows]) for c in range(n_chains)),
        *(np.stack([getattr(row, name) for row in rows]) for name in Passed._fields[3:]),
    )


def _beliefs(rows: Sequence[steps.Belief]) -> steps.Belief:
    return steps.Belief(*(np.stack(part) for part in zip(*rows, strict=True)))


def _stacked(rows: Sequence[_Array | None]) -> _Array | None:
    return None if rows[0] is None else np.stack([row for row in rows if row is not None])


def _row(model: Aligned, before: steps.Belief, k: int, n_chains: int) -> Passed:
    """One row of the filter, without the axis of rows."""

    def at(a: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return np.asarray(np.take(a, k if a.shape[model.z.ndim - 2] > 1 else 0, axis=model.z.ndim - 2))

    trans = [None if t is None else at(t) for t in model.trans]
    stages = [before]
    for c in range(n_chains):
        stages.append(steps.mix(*stages[-1], [t if i == c else None for i, t in enumerate(trans)]))
    log_probs, means, covs = stages[-1]
    F, H, R = at(model.F), at(model.H), at(model.R)
    means, covs = steps.propagate(means, covs, F, None if model.b is None else at(model.b), at(model.Q))
    prediction = steps.measure(means, covs, H, None if model.d is None else at(model.d), R)
    z, seen = at(model.z), at(model.seen)
    per_mode = z.shape[:-1] + (1,) * n_chains + z.shape[-1:]
    done = steps.condition(
        prediction, z.reshape(per_mode), seen.reshape(per_mode), n_runs=log_probs.ndim - n_chains, row=k
    )
    d2 = steps.mixture_nis(log_probs, prediction, z, seen, n_chains)
    posterior_log, log_f = steps.reweigh(log_probs, done.loglik, n_chains)
    check_evidence(log_f, prediction.y, prediction.Y, z, seen, k)
    lead, n = log_probs.shape, means.shape[-1]
    score, information, through = _adjoint(prediction, z.reshape(per_mode), seen.reshape(per_mode), F, H)
    return Passed(
        tuple(stages),
        steps.Belief(posterior_log, done.mean, done.cov),
        tuple(trans),
        np.broadcast_to(score, (*lead, n)),
        np.broadcast_to(information, (*lead, n, n)),
        np.broadcast_to(through, (*lead, n, n)),
        np.broadcast_to(done.loglik, lead),
        log_f,
        d2,
    )


def _adjoint(
    prediction: steps.Joint, z: _Array, seen: npt.NDArray[np.bool_], F: _Array, H: _Array
) -> tuple[_Array, _Array, _Array]:
    """Return (HF)'S^-1 nu, (HF)'S^-1(HF) and F - K(HF), the row's measurement and interval in one.

    Taken one after the other, F'(L'BL)F cancels under a wide prior.
    """
    on = seen.astype(float)
    nu = np.where(seen, z - prediction.y, 0.0)
    S = prediction.S * (on[..., :, None] * on[..., None, :]) + np.eye(z.shape[-1]) * (1.0 - on)[..., None]
    try:
        _, _, L_inv = gaussian_terms(nu, S)
    except np.linalg.LinAlgError as error:
        raise NotPositive(place()) from error
    HF = (H @ F) * on[..., None]
    white = L_inv @ HF
    gain = (prediction.U * on[..., None, :]) @ L_inv.swapaxes(-1, -2) @ L_inv
    score = (white.swapaxes(-1, -2) @ (L_inv @ nu[..., None]))[..., 0]
    return np.asarray(score), symmetric(white.swapaxes(-1, -2) @ white), F - gain @ HF


def smooth(passed: Passed, *, floor: float) -> Smoothed:
    """Return what all measurements say of every row.

    Args:
        passed: of `forward`.
        floor: share f of the mean curvature A that a message keeps at least, f A <= B <= A, in (0, 1].
    """
    n_rows = len(passed.log_f)
    message, rows = _nothing(passed, n_rows - 1), []
    pairs: list[list[_Array | None]] = []
    for k in range(n_rows - 1, -1, -1):
        rows.append(_output(passed, k, message))
        message, joint = _back(passed, k, message, floor)
        pairs.append(joint)
    return _joined(rows[::-1], pairs[::-1])


def smooth_lag(passed: Passed, lag: int, *, floor: float) -> Smoothed:
    """Return what measurements up to `lag` rows later say of every row; the last rows get what there is.

    All windows go back side by side: lag + 1 steps, whatever the number of rows.

    Args:
        passed: of `forward`.
        lag: rows, >= 0.
        floor: as in `smooth`.
    """
    n_rows = len(passed.log_f)
    ends = np.arange(n_rows)
    message = _nothing(passed, ends)
    rows: dict[int, tuple[steps.Belief, list[_Array | None]]] = {}
    for step in range(min(lag, n_rows - 1) + 1):
        at = ends - step
        inside = at >= 0
        at, ends, message = at[inside], ends[inside], Message(*(part[inside] for part in message))
        out = _output(passed, at, message)
        message, joint = _back(passed, at, message, floor)
        for window in np.flatnonzero((ends - at == lag) | (ends == n_rows - 1)).tolist():
            mine = steps.Belief(*(part[window] for part in out))
            rows[int(at[window])] = mine, [None if pair is None else pair[window] for pair in joint]
    return _joined([rows[k][0] for k in range(n_rows)], [rows[k][1] for k in range(n_rows)])


def _joined(rows: list[steps.Belief], pairs: list[list[_Array | None]]) -> Smoothed:
    return Smoothed(*_beliefs(rows), tuple(_stacked(part) for part in zip(*pairs, strict=True)))


def _nothing(passed: Passed, row: _Rows) -> Message:
    """The message of no measurement."""
    x, R = passed.posterior.means[row], passed.posterior.covs[row]
    return Message(np.zeros(x.shape[:-1]), np.zeros_like(x), np.zeros_like(R), np.zeros_like(R))


def _output(passed: Passed, row: _Rows, message: Message) -> steps.Belief:
    """Return log P + c normalised, x + R a, R - R B R."""
    log_p, x, R = (part[row] for part in passed.posterior)
    total = log_p + message.c
    axes = tuple(range(total.ndim - passed.n_chains, total.ndim))
    covs = R - R @ message.curvature @ R
    return steps.Belief(normalised(total, axes)[0], x + (R @ message.a[..., None])[..., 0], symmetric(covs))


def _back(passed: Passed, row: _Rows, message: Message, floor: float) -> tuple[Message, list[_Array | None]]:
    """Take a message from the posterior of a row to that of the row before, and give the pairs of each chain."""
    through = passed.through[row]
    back = through.swapaxes(-1, -2)
    c = message.c + passed.loglik[row]
    a = passed.score[row] + (back @ message.a[..., None])[..., 0]
    B = passed.information[row] + symmetric(back @ message.B @ through)
    message = Message(c, a, B, B)
    pairs: list[_Array | None] = [None] * passed.n_chains
    for axis in range(passed.n_chains - 1, -1, -1):
        trans = passed.trans[axis]
        if trans is not None:
            before, after = (steps.Belief(*(p[row] for p in passed.stages[axis + k])) for k in (0, 1))
            message, pairs[axis] = _unmix(message, before, after, trans[row], axis, passed.n_chains, floor)
    axes = tuple(range(c.ndim - passed.n_chains, c.ndim))
    return message._replace(c=message.c - message.c.max(axis=axes, keepdims=True)), pairs


def _unmix(
    message: Message,
    before: steps.Belief,
    after: steps.Belief,
    trans: _Array,
    axis: int,
    n_chains: int,
    floor: float,
) -> tuple[Message, _Array]:
    """Take a message back over the mixing of one chain; return also P(i, j | everything) of its two states.

    A message re-referenced from (x_j, R_j) to (x_i, R_i), with delta = x_i - x_j, D = R_i - R_j, G = I + B_j D and
    e = a_j - B_j delta, is

        a_ij = G^-1 e,   B_ij = G^-1 B_j,   log z_ij = (a_j - B_j delta / 2)'delta - log det G / 2 + e'D a_ij / 2,

    and with w_ij = log pi_ij + c_j + log z_ij, u_ij = exp(w_ij - c_i), c_i = log sum_j exp w_ij,

        a_i = sum_j u_ij a_ij,   A = sum_j u_ij B_ij,   V = sum_j u_ij (a_ij - a_i)(a_ij - a_i)',   B_i = A - V guarded.

    Source: smoothing notes, section 2, step 4.
    """
    place = before.log_probs.ndim - n_chains + axis
    lp, x_i, R_i = np.moveaxis(before.log_probs, place, -1), *_last(before, place)
    x_j, R_j = _last(after, place)
    c, a, B = np.moveaxis(message.c, place, -1), *_last(message, place, 1)
    t = trans.reshape(trans.shape[:-2] + (1,) * (n_chains - 1) + trans.shape[-2:])
    delta, D = x_i[..., :, None, :] - x_j[..., None, :, :], R_i[..., :, None, :, :] - R_j[..., None, :, :, :]
    B_j, a_j = B[..., None, :, :, :], a[..., None, :, :]
    e = a_j - (B_j @ delta[..., None])[..., 0]
    G = np.eye(a.shape[-1]) + B_j @ D
    sign, log_det = np.linalg.slogdet(G)
    G = np.where((sign > 0)[..., None, None], G, np.eye(a.shape[-1]))
    both = np.linalg.solve(G, np.concatenate([e[..., None], np.broadcast_to(B_j, G.shape)], axis=-1))
    a_ij, B_ij = both[..., 0], symmetric(both[..., 1:])
    log_z = ((0.5 * (a_j + e)) * delta).sum(-1) - 0.5 * log_det + 0.5 * (e * (D @ a_ij[..., None])[..., 0]).sum(-1)
    with np.errstate(divide="ignore"):
        w = np.where(sign > 0, np.log(t) + c[..., None, :] + log_z, -np.inf)
    log_u, c_i = normalised(w, (w.ndim - 1,))
    u = np.exp(log_u)
    a_i = (u[..., None] * a_ij).sum(-2)
    A = (u[..., None, None] * B_ij).sum(-3)
    apart = a_ij - a_i[..., None, :]
    V = (u[..., None] * apart).swapaxes(-1, -2) @ apart
    curvature = A - V
    guarded = A if floor == 1.0 else _guarded(A, V, _scale(R_i, n_chains), floor)
    joint = lp[..., None] + w
    spectators = tuple(range(joint.ndim - 1 - n_chains, joint.ndim - 2))
    pairs = np.squeeze(logsumexp(joint, spectators), spectators) if spectators else joint
    pairs = np.exp(normalised(pairs, (pairs.ndim - 2, pairs.ndim - 1))[0])
    put = (np.moveaxis(v, -1 - k, place) for k, v in ((0, c_i[..., 0]), (1, a_i), (2, guarded), (2, curvature)))
    return Message(*put), pairs


def _last(parts: "steps.Belief | Message", place: int, first: int = 1) -> tuple[_Array, _Array]:
    """Vectors and matrices with the axis `place` of the modes moved last among the modes."""
    return np.moveaxis(parts[first], place, -2), np.moveaxis(parts[first + 1], place, -3)


def _scale(covs: _Array, n_chains: int) -> _Array:
    """Largest standard deviation of each state over the modes, 1 where that is 0."""
    largest = np.diagonal(covs, axis1=-2, axis2=-1).max(axis=tuple(range(-1 - n_chains, -1)), keepdims=True)
    return np.asarray(np.sqrt(np.where(largest > 0.0, largest, 1.0)))


def _guarded(A: _Array, V: _Array, scale: _Array, floor: float) -> _Array:
    """Return A - V where it is at least `floor` times A, else what of it is.

    With A = U L U' in units of `scale`, V likewise, and I - L^-1/2 U'V U L^-1/2 = E w E':
    B = U L^1/2 E max(w, f) E' L^1/2 U'. Without it the smoother diverges: the message of two separated futures is not
    log-concave, which is harmless at its own reference and not at a wider one.
    """
    unit = scale[..., :, None] * scale[..., None, :]
    scaled_A, scaled_V = np.broadcast_arrays(A * unit, V * unit)
    out = scaled_A - scaled_V
    doubtful = ~(np.linalg.eigvalsh((1.0 - floor) * scaled_A - scaled_V)[..., 0] >= 0.0)
    if doubtful.any():
        out = out.copy()
        out[doubtful] = _kept(scaled_A[doubtful], scaled_V[doubtful], floor)
    return np.asarray(out / unit)


def _kept(A: _Array, V: _Array, floor: float) -> _Array:
    value, U = np.linalg.eigh(A)
    there = value > _DEPENDENT * value[..., -1:]
    root = np.sqrt(np.where(there, value, 0.0))
    inverse = np.where(there, 1.0 / np.where(there, root, 1.0), 0.0)
    T = U * inverse[..., None, :]
    w, E = np.linalg.eigh(symmetric(np.eye(A.shape[-1]) - T.swapaxes(-1, -2) @ V @ T))
    half = (U * root[..., None, :]) @ E
    whole = symmetric((half * np.maximum(w, floor)[..., None, :]) @ half.swapaxes(-1, -2))
    return np.where((w[..., :1] < floor)[..., None], whole, A - V)
