"""Slow answers, written from the definitions and sharing no code with the package.

All take one run of a model spelt out in full (`FlatModel`): every matrix for every row and every joint mode, the
chains merged into one by Kronecker products, modes flattened in C order.
"""

from functools import reduce
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

__all__ = [
    "FlatModel",
    "Run",
    "dense_kalman",
    "enumerate_modes",
    "error",
    "flat_model",
    "is_psd",
    "mix_all_pairs",
    "smooth_enumerated",
    "textbook_imm",
]


class FlatModel(NamedTuple):
    """One run: T rows, M joint modes."""

    z: np.ndarray  # (T, m), NaN = missing
    F: np.ndarray  # (T, M, n, n)
    Q: np.ndarray
    H: np.ndarray  # (T, M, m, n)
    R: np.ndarray  # (T, M, m, m)
    b: np.ndarray  # (T, M, n)
    d: np.ndarray  # (T, M, m)
    trans: np.ndarray  # (T, M, M), from row to column
    mean0: np.ndarray  # (M, n)
    cov0: np.ndarray  # (M, n, n)
    probs0: np.ndarray  # (M,)


class Run(NamedTuple):
    """What a filter says of one run."""

    probs: np.ndarray  # (T, M)
    mean: np.ndarray  # (T, n)
    cov: np.ndarray  # (T, n, n)
    log_likelihood: np.ndarray  # (T,)
    nis: np.ndarray | None = None  # (T,)
    mode_means: np.ndarray | None = None  # (T, M, n)
    mode_covs: np.ndarray | None = None


def error(actual, expected):
    """Largest deviation, relative to max|expected|."""
    actual, expected = np.asarray(actual), np.asarray(expected)
    assert actual.shape == expected.shape, (actual.shape, expected.shape)
    return np.abs(actual - expected).max() / max(np.abs(expected).max(), 1e-300)


def is_psd(covs, tolerance=1e-12):
    """Symmetric to the last bit, and no eigenvalue below -tolerance times the largest."""
    eigenvalues = np.linalg.eigvalsh(covs)
    return bool(
        (covs == covs.swapaxes(-1, -2)).all() and (eigenvalues[..., 0] >= -tolerance * eigenvalues[..., -1]).all()
    )


def flat_model(problem, run=()):
    """Spell out one run of `imm_filter`'s arguments."""
    z = np.asarray(problem["z"], float)
    batch, n_steps, m = z.shape[:-2], z.shape[-2], z.shape[-1]
    n = np.shape(problem["cov0"])[-1]
    sizes = tuple(np.shape(t)[-1] for t in problem["trans"])
    n_modes = int(np.prod(sizes))

    def model(name, *core):
        a = problem.get(name)
        a = np.zeros(core) if a is None else a
        return np.broadcast_to(a, (*batch, n_steps, *sizes, *core))[run].reshape(n_steps, n_modes, *core)

    def prior(name, *core):
        return np.broadcast_to(problem[name], (*batch, *sizes, *core))[run].reshape(n_modes, *core)

    chains = [np.broadcast_to(t, (*batch, n_steps, s, s))[run] for t, s in zip(problem["trans"], sizes, strict=True)]
    trans = np.array([reduce(np.kron, [c[k] for c in chains], np.eye(1)) for k in range(n_steps)])
    return FlatModel(
        z=z[run],
        F=model("F", n, n),
        Q=model("Q", n, n),
        H=model("H", m, n),
        R=model("R", m, m),
        b=model("b", n),
        d=model("d", m),
        trans=trans,
        mean0=prior("mean0", n),
        cov0=prior("cov0", n, n),
        probs0=prior("probs0"),
    )


def dense_kalman(z, F, Q, H, R, b, d, mean0, cov0):
    """Condition the joint Gaussian of all states and measurements, by one solve per row.

    Everything is a linear map of s = (x_0, w_1..w_T, v_1..v_T) with block-diagonal covariance.

    Returns:
        mean (T, n), cov (T, n, n), log f(z_1..z_k) (T,).
    """
    (n_steps, m), n = z.shape, len(mean0)
    s_mean, s_cov = np.concatenate([mean0, b.ravel(), d.ravel()]), block_diag(cov0, *Q, *R)
    x, states, measured = np.eye(n, len(s_mean)), [], []
    for k in range(n_steps):
        x = F[k] @ x
        x[:, n * (k + 1) : n * (k + 2)] += np.eye(n)
        y = H[k] @ x
        y[:, n * (n_steps + 1) + m * k : n * (n_steps + 1) + m * (k + 1)] += np.eye(m)
        states.append(x)
        measured.append(y)
    mean, cov, total = np.empty((n_steps, n)), np.empty((n_steps, n, n)), np.zeros(n_steps)
    for k in range(n_steps):
        seen = ~np.isnan(z[: k + 1]).ravel()
        Y = np.concatenate(measured[: k + 1])[seen]
        nu = z[: k + 1].ravel()[seen] - Y @ s_mean
        S = Y @ s_cov @ Y.T
        U = states[k] @ s_cov @ Y.T
        solved = np.linalg.solve(S, np.column_stack([nu, U.T])) if seen.any() else np.zeros((0, n + 1))
        mean[k] = states[k] @ s_mean + U @ solved[:, 0]
        cov[k] = states[k] @ s_cov @ states[k].T - U @ solved[:, 1:]
        if seen.any():
            total[k] = -0.5 * (nu @ solved[:, 0] + np.linalg.slogdet(S)[1] + len(nu) * np.log(2 * np.pi))
    return mean, cov, total


def enumerate_modes(f):
    """The exact filter: a dense Gaussian for each of the M^(T+1) mode sequences (the prior's mode included)."""
    n_steps, n_modes, n = len(f.z), len(f.probs0), f.mean0.shape[-1]
    weights, ends, means, covs = [], [], [], []
    for sequence in product(range(n_modes), repeat=n_steps + 1):
        first, modes = sequence[0], np.array(sequence[1:])
        prior = f.probs0[first]
        for k in range(n_steps):
            prior = prior * f.trans[k, sequence[k], sequence[k + 1]]
        if prior == 0.0:
            continue
        pick = (np.arange(n_steps), modes)
        mean, cov, total = dense_kalman(
            f.z, f.F[pick], f.Q[pick], f.H[pick], f.R[pick], f.b[pick], f.d[pick], f.mean0[first], f.cov0[first]
        )
        weights.append(np.log(prior) + total)
        ends.append(modes)
        means.append(mean)
        covs.append(cov)
    log_w, end, x, P = np.array(weights), np.array(ends), np.array(means), np.array(covs)
    evidence = logsumexp(log_w, axis=0)
    w = np.exp(log_w - evidence)  # (sequences, T)
    probs = np.stack([(w * (end == j)).sum(0) for j in range(n_modes)], axis=-1)
    mean = np.einsum("sk,skn->kn", w, x)
    spread = x - mean
    cov = np.einsum("sk,sknm->knm", w, P + spread[..., :, None] * spread[..., None, :])
    return Run(probs, mean.reshape(n_steps, n), cov, np.diff(evidence, prepend=0.0))


def smooth_enumerated(f):
    """The exact smoother: of each mode sequence the dense Gaussian of all states given all measurements."""
    n_steps, n_modes = len(f.z), len(f.probs0)
    log_w, sequences, means, covs = [], [], [], []
    for sequence in product(range(n_modes), repeat=n_steps + 1):
        prior = f.probs0[sequence[0]] * np.prod([f.trans[k, sequence[k], sequence[k + 1]] for k in range(n_steps)])
        if prior == 0.0:
            continue
        pick = (np.arange(n_steps), np.array(sequence[1:]))
        mean, cov, total = _dense_smoother(
            f.z,
            f.F[pick],
            f.Q[pick],
            f.H[pick],
            f.R[pick],
            f.b[pick],
            f.d[pick],
            f.mean0[sequence[0]],
            f.cov0[sequence[0]],
        )
        log_w.append(np.log(prior) + total)
        sequences.append(sequence)
        means.append(mean)
        covs.append(cov)
    w, sequences, x, P = np.exp(log_w - logsumexp(log_w)), np.array(sequences), np.array(means), np.array(covs)
    probs = np.array([[w[sequences[:, k + 1] == j].sum() for j in range(n_modes)] for k in range(n_steps)])
    pairs = np.zeros((n_steps, n_modes, n_modes))
    for k in range(n_steps):
        np.add.at(pairs[k], (sequences[:, k], sequences[:, k + 1]), w)
    mean = np.einsum("s,skn->kn", w, x)
    spread = x - mean
    cov = np.einsum("s,sknm->knm", w, P + spread[..., :, None] * spread[..., None, :])
    return Run(probs, mean, cov, logsumexp(log_w)), pairs


def _dense_smoother(z, F, Q, H, R, b, d, mean0, cov0):
    """All states given all measurements: one joint Gaussian of s = (x_0, w_1..w_T), one solve."""
    (n_steps, _), n = z.shape, len(mean0)
    s_mean, s_cov = np.concatenate([mean0, b.ravel()]), block_diag(cov0, *Q)
    x, states = np.eye(n, len(s_mean)), []
    for k in range(n_steps):
        x = F[k] @ x
        x[:, n * (k + 1) : n * (k + 2)] += np.eye(n)
        states.append(x)
    X = np.concatenate(states)
    seen = ~np.isnan(z).ravel()
    Y, noise = (block_diag(*H) @ X)[seen], block_diag(*R)[np.ix_(seen, seen)]
    nu = z.ravel()[seen] - d.ravel()[seen] - Y @ s_mean
    S, U = Y @ s_cov @ Y.T + noise, X @ s_cov @ Y.T
    mean, cov = X @ s_mean + U @ np.linalg.solve(S, nu), X @ s_cov @ X.T - U @ np.linalg.solve(S, U.T)
    blocks = cov.reshape(n_steps, n, n_steps, n)[np.arange(n_steps), :, np.arange(n_steps)]
    return mean.reshape(n_steps, n), blocks, multivariate_normal.logpdf(nu, np.zeros(len(nu)), S) if len(nu) else 0.0


def mix_all_pairs(probs, means, covs, trans):
    """Moments before the dynamics by the full sum over pairs of joint modes; `trans` is (M, M)."""
    n_modes = len(probs)
    new_probs, new_means, new_covs = np.zeros(n_modes), np.zeros_like(means), np.zeros_like(covs)
    for j in range(n_modes):
        w = trans[:, j] * probs
        new_probs[j] = w.sum()
        w = w / w.sum()
        for i in range(n_modes):
            new_means[j] += w[i] * means[i]
        for i in range(n_modes):
            new_covs[j] += w[i] * (covs[i] + np.outer(means[i] - new_means[j], means[i] - new_means[j]))
    return new_probs, new_means, new_covs


def textbook_imm(f):
    """The IMM cycle for one object on the flat chain, as plain loops; missing rows are deleted, not masked."""
    n_steps, n_modes = len(f.z), len(f.probs0)
    probs, x, P = f.probs0, f.mean0.copy(), f.cov0.copy()
    rows = []
    for k in range(n_steps):
        probs, x, P = mix_all_pairs(probs, x, P, f.trans[k])
        seen = ~np.isnan(f.z[k])
        z, log_f = f.z[k][seen], np.zeros(n_modes)
        y, S = np.zeros((n_modes, seen.sum())), np.zeros((n_modes, seen.sum(), seen.sum()))
        x_new, P_new = np.empty_like(x), np.empty_like(P)
        for j in range(n_modes):
            x_new[j] = f.F[k, j] @ x[j] + f.b[k, j]
            P_new[j] = f.F[k, j] @ P[j] @ f.F[k, j].T + f.Q[k, j]
            if seen.any():
                H = f.H[k, j][seen]
                y[j] = H @ x_new[j] + f.d[k, j][seen]
                S[j] = H @ P_new[j] @ H.T + f.R[k, j][np.ix_(seen, seen)]
                log_f[j] = multivariate_normal.logpdf(z, y[j], S[j])
                gain = P_new[j] @ H.T @ np.linalg.inv(S[j])
                x_new[j] = x_new[j] + gain @ (z - y[j])
                P_new[j] = P_new[j] - gain @ S[j] @ gain.T
        nis = 0.0
        if seen.any():
            _, y_mean, y_cov = _mixture(probs, y, S)
            nis = (z - y_mean) @ np.linalg.inv(y_cov) @ (z - y_mean)
        log_w = np.log(probs) + log_f
        total = logsumexp(log_w)
        probs, x, P = np.exp(log_w - total), x_new, P_new
        rows.append((*_mixture(probs, x, P), total, nis, x, P))
    p, mean, cov, log_likelihood, nis, mode_means, mode_covs = (np.array(column) for column in zip(*rows, strict=True))
    return Run(p, mean, cov, log_likelihood, nis, mode_means, mode_covs)


def _mixture(probs, means, covs):
    mean = sum(p * x for p, x in zip(probs, means, strict=True))
    cov = sum(p * (P + np.outer(x - mean, x - mean)) for p, x, P in zip(probs, means, covs, strict=True))
    return probs, mean, cov
