"""A sensor whose errors are a Markov process: one description, two ways to filter it.

The augmented state a = (x, u) holds the state and the noise's own state:

    a_k = F a_{k-1} + b + e,   cov e = Q,   z_k = H x_k + L u_k + v_k,   cov v = R

*Augmentation* filters a. *Differencing* needs R = 0: with E an orthonormal basis of what L does not see, the map

    s = T a = (x, E u, y),   y = H x + L u,   T^-1: u = E' (E u) + L^+ (y - H x)

is the same in every mode, y is what is measured, and after a complete measurement nothing of it is uncertain: only
the first n + p - m components need to be filtered. For first-order noise that is x itself.

Source: Detkov (2023), equations 1-12 as corrected in the notes on coloured measurement noise, sections 1 and 2.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import DataError, ModelError
from saltus.linalg import block_diagonal, quadratic_form
from saltus.models import discretise
from saltus.models.checks import FloatArray, covariance, intervals, numbers

__all__ = ["Augmented", "Differenced", "augment", "difference", "factored"]


class Augmented(NamedTuple):
    """State and noise together, with axes (T?, M1|1, ..., MC|1, ...) as `imm_filter` reads them.

    The prior holds at the first sample, before it is seen.
    """

    F: FloatArray  # (T?, M1|1, ..., n+p, n+p), over the interval before rows 1..K
    Q: FloatArray
    b: FloatArray | None  # (T?, ..., n+p)
    H: FloatArray  # (m, n)
    L: FloatArray  # (m, p): what of the noise is seen
    mean0: FloatArray  # (M1|1, ..., n+p), perhaps with leading axes of runs
    cov0: FloatArray

    @property
    def n_state(self) -> int:
        """Dimension n of x."""
        return int(self.H.shape[-1])


class Differenced(NamedTuple):
    """s_k = Phi s_{k-1} + b + e, cov e = B, where the last m components of s are what is measured."""

    Phi: FloatArray  # (T?, M1|1, ..., n+p, n+p)
    B: FloatArray
    b: FloatArray | None
    T: FloatArray  # s = T a, (n+p, n+p)
    n_kept: int  # n + p - m


def difference(model: Augmented) -> Differenced:
    """Change variables from (x, u) to (x, E u, y).

    Phi = T F T^-1,  B = T Q T',  b = T b

    For first-order noise: Phi_yx = H Phi_xx - Phi_ww H, B_xy = B_xx H', B_yy = H B_xx H' + B_ww.

    Raises:
        ModelError: L has not full row rank: some combination of measurements has no noise of its own.

    Source: Detkov (2023), equations 10-12, corrected.
    """
    (m, n), p = model.H.shape, model.L.shape[-1]
    seen, hidden = _split(model.L)
    T, back = np.zeros((n + p, n + p)), np.zeros((n + p, n + p))
    T[:n, :n] = back[:n, :n] = np.eye(n)
    T[n : n + p - m, n:] = hidden
    T[n + p - m :, :n], T[n + p - m :, n:] = model.H, model.L
    back[n:, :n], back[n:, n : n + p - m], back[n:, n + p - m :] = -seen @ model.H, hidden.T, seen
    B = T @ model.Q @ T.T
    b = None if model.b is None else np.asarray(model.b @ T.T)
    return Differenced(T @ model.F @ back, 0.5 * (B + B.swapaxes(-1, -2)), b, T, n + p - m)


def factored(model: Augmented, moves: Differenced) -> FloatArray:
    """Split the noise of s = (x, E u, y) into what its measured part tells and the rest, as rows [Q | cov(e, f) | M].

    e = M u + v,   f = M_f u,   cov u = I,   cov v = Q = (I - J C) B_a (I - J C)' on the kept components, 0 on y

    with B_a and C = [H L] the noise and the measurement of a = (x, u), N_ff = C B_a C' = M_f M_f' and J = N_ef N_ff^-1.
    A direction of y without noise has none in e either, and gets a column of zeros in M.

    Returns:
        (T?, M1|1, ..., MC|1, n+p, n+p+2m), what the compiled kernel takes for Q.
    """
    kept, C = moves.n_kept, moves.T[moves.n_kept :]
    N_ef, N_ff = moves.B[..., kept:], moves.B[..., kept:, kept:]
    scale = np.sqrt(np.diagonal(N_ff, axis1=-2, axis2=-1))
    scale = np.where(scale > 0, scale, 1.0)
    values, V = np.linalg.eigh(N_ff / (scale[..., :, None] * scale[..., None, :]))
    root = np.sqrt(np.where(values > 1e-14, values, 0.0))
    inverse = np.divide(1.0, root, out=np.zeros_like(root), where=root > 0)
    whiten = V / scale[..., :, None] * inverse[..., None, :]
    M = N_ef @ whiten
    M[..., kept:, :] = scale[..., :, None] * V * root[..., None, :]
    J = (M @ whiten.swapaxes(-1, -2))[..., :kept, :]
    rest = np.zeros_like(moves.B)
    rest[..., :kept, :kept] = quadratic_form(moves.T[:kept] - J @ C, model.Q)
    return np.concatenate([rest, N_ef, M], axis=-1)


def _split(L: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return L^+ (p, m) and an orthonormal basis of the null space of L, (p - m, p)."""
    m, p = L.shape
    if m == p and (np.eye(m) == L).all():
        return np.eye(m), np.zeros((0, m))
    _, singular, vectors = np.linalg.svd(L, full_matrices=True)
    if p < m or singular[-1] < 1e-12 * singular[0]:
        raise ModelError(
            f"differencing needs noise in every measured combination: L {L.shape} has rank below {m}. "
            "Filter the augmented state instead."
        )
    return np.asarray(np.linalg.pinv(L)), np.asarray(vectors[m:])


def augment(
    *,
    F: npt.ArrayLike,
    G: npt.ArrayLike,
    noise_F: npt.ArrayLike,
    noise_G: npt.ArrayLike,
    H: npt.ArrayLike,
    dt: npt.ArrayLike,
    n_steps: int,
    n_chains: int,
    mean0: npt.ArrayLike,
    cov0: npt.ArrayLike,
    noise_cov0: npt.ArrayLike,
) -> Augmented:
    """Read the arguments of `coloured_filter`: discretise state and noise apart, and set them side by side.

    dx = F x dt + G dW,   dw = noise_F w dt + noise_G dW',   y = H x + w

    Raises:
        ModelError: shapes that do not fit.
        DataError: intervals that are negative, or not one for each step.
    """
    h = numbers(H, "H")
    if h.ndim != 2:
        raise ModelError(f"H has shape {h.shape}; it is (m, n), the same in every mode: differencing needs that.")
    m, n = h.shape
    step = _steps(dt, n_steps)
    shape = (-1,) + (1,) * n_chains if step.ndim else ()
    move_x = _move(F, G, n, n_chains, step.reshape(shape), ("F", "G"))
    move_w = _move(noise_F, noise_G, m, n_chains, step.reshape(shape), ("noise_F", "noise_G"))
    P, W = covariance(cov0, "cov0"), covariance(noise_cov0, "noise_cov0")
    mean = numbers(mean0, "mean0")
    sizes = {"cov0": (P.shape, n), "noise_cov0": (W.shape, m), "mean0": (mean.shape, n)}
    for name, (shape_of, size) in sizes.items():
        if shape_of[-1:] != (size,):
            raise ModelError(f"{name} has shape {shape_of}; its last axis has length {size} to go with H {h.shape}.")
    mean = np.concatenate([mean, np.zeros((*mean.shape[:-1], m))], axis=-1)
    F_both, Q_both = (block_diagonal(a, b) for a, b in zip(move_x, move_w, strict=True))
    return Augmented(F_both, Q_both, None, h, np.eye(m), mean, block_diagonal(P, W))


def _steps(dt: npt.ArrayLike, n_steps: int) -> FloatArray:
    """One interval for all steps, or one for each."""
    step = intervals(dt)
    if step.shape not in ((), (n_steps,)):
        raise DataError(
            f"dt has shape {step.shape}; z has {n_steps + 1} rows, so give one interval for all steps or "
            f"{n_steps} of them, dt[k] between rows k and k+1."
        )
    return step if step.ndim == 0 or (step != step[0]).any() else np.asarray(step[0])


def _move(
    F: npt.ArrayLike, G: npt.ArrayLike, size: int, n_chains: int, dt: FloatArray, names: tuple[str, str]
) -> tuple[FloatArray, FloatArray]:
    f, g = numbers(F, names[0]), numbers(G, names[1])
    for name, a, core in ((names[0], f, f"({size}, {size})"), (names[1], g, f"({size}, q)")):
        if a.ndim != n_chains + 2 or a.shape[-2] != size:
            raise ModelError(
                f"{name} has shape {a.shape}; with {n_chains} chain(s) it has one axis per chain (length 1 where it "
                f"does not depend on it) and then {core}."
            )
    if dt.ndim == 0:
        return discretise(f, g, dt)
    lengths, which = np.unique(dt.ravel(), return_inverse=True)
    Phi, Q = discretise(f, g, lengths.reshape(-1, *dt.shape[1:]))
    return Phi[which], Q[which]
