"""Matrix exponentials over an interval, and the exact discretisation of linear equations.

Both start from a Taylor polynomial over a short piece h = dt / 2^s and double s times. What is doubled is
exp(A h) - I, so that slow modes keep their digits however stiff the fast ones are. Every matrix has its own s, so what
one of many becomes does not depend on the others.
"""

import numpy as np
import numpy.typing as npt

from saltus.errors import ModelError, NumericalError
from saltus.models.checks import FloatArray, intervals, numbers
from saltus.shapes import Float

__all__ = ["discretise", "exponential"]

_SHORT = 0.25  # ||A h||_1 of the shortest piece
_ORDER = 16  # 0.5**16 / 17! < 1e-19: the polynomials are exact to round-off at ||A h|| <= 1/4


def exponential(A: npt.ArrayLike) -> Float[np.ndarray, "*lead n n"]:
    """Exponential of matrices.

    exp(A) = I + Psi,  Psi(2h) = 2 Psi(h) + Psi(h)^2

    Args:
        A: (..., n, n), dimensionless.

    Returns:
        exp(A), (..., n, n).

    Raises:
        ModelError: A is not square or not finite.
        NumericalError: the exponential overflows.
    """
    matrix = _square(numbers(A, "A"), "A")
    doublings = _doublings(matrix)
    psi = _psi(matrix / 2.0 ** doublings[..., None, None])
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(int(doublings.max(initial=0))):
            at = doublings > k
            psi[at] = 2 * psi[at] + psi[at] @ psi[at]
    return _finite(np.eye(matrix.shape[-1]) + psi, matrix)


def discretise(
    F: npt.ArrayLike, G: npt.ArrayLike, dt: npt.ArrayLike
) -> tuple[Float[np.ndarray, "*lead n n"], Float[np.ndarray, "*lead n n"]]:
    """Discretise dx = F x dt + G dW exactly over intervals dt.

    Phi = exp(F dt),  Q = int_0^dt exp(F s) G G' exp(F' s) ds,
    Q(2h) = Q(h) + Phi(h) Q(h) Phi(h)'

    Nothing is subtracted in the doubling, so Q stays accurate and positive semi-definite when F is stiff. The leading
    axes of F and G and the shape of dt broadcast by NumPy's rules: F (n, n) with dt (T,) gives (T, n, n); F (M, n, n)
    with dt (T, 1) gives (T, M, n, n).

    Args:
        F: drift, (..., n, n), 1/s.
        G: diffusion, (..., n, q), state unit / sqrt(s).
        dt: intervals, (...), s, not negative.

    Returns:
        Phi and Q, each (..., n, n).

    Raises:
        ModelError: shapes do not fit, or dt is negative.
        NumericalError: exp(F dt) overflows.

    Source: Van Loan (1978) states the pair of integrals; the doubling formulas follow from splitting the integral.
    """
    drift, diffusion, step = _square(numbers(F, "F"), "F"), numbers(G, "G"), intervals(dt)[..., None, None]
    n = drift.shape[-1]
    if diffusion.ndim < 2 or diffusion.shape[-2] != n:
        raise ModelError(f"G must have shape (..., {n}, q) to go with F {drift.shape}, got {diffusion.shape}.")
    try:
        np.broadcast_shapes(drift.shape[:-2], diffusion.shape[:-2], step.shape[:-2])
    except ValueError:
        raise ModelError(
            f"leading axes do not broadcast: F {drift.shape[:-2]}, G {diffusion.shape[:-2]}, "
            f"dt {step.shape[:-2]}.\nAdd axes of length 1, for instance dt[:, None]."
        ) from None
    doublings = _doublings(drift * step)
    h = step / 2.0 ** doublings[..., None, None]
    psi, Q = _psi(drift * h), _integral(drift * h, (diffusion @ np.swapaxes(diffusion, -1, -2)) * h)
    eye = np.eye(n)
    Q = np.broadcast_to(Q, np.broadcast_shapes(psi.shape, Q.shape)).copy()
    psi, doublings = np.broadcast_to(psi, Q.shape).copy(), np.broadcast_to(doublings, Q.shape[:-2])
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(int(doublings.max(initial=0))):
            at = doublings > k
            phi = eye + psi[at]
            Q[at] += phi @ Q[at] @ np.swapaxes(phi, -1, -2)
            psi[at] = 2 * psi[at] + psi[at] @ psi[at]
    Q = (Q + np.swapaxes(Q, -1, -2)) / 2
    Phi = eye + psi
    return _finite(Phi, drift * step), _finite(Q, drift * step)


def _psi(A: FloatArray) -> FloatArray:
    """exp(A) - I = A (I + A/2 (I + A/3 (...))) for small A."""
    eye = np.eye(A.shape[-1])
    inner = np.broadcast_to(eye, A.shape)
    for k in range(_ORDER, 1, -1):
        inner = eye + A @ inner / k
    return A @ inner


def _integral(A: FloatArray, N: FloatArray) -> FloatArray:
    """int_0^1 exp(A s) N exp(A' s) ds for small A: the series of L -> A L + L A', divided by (k + 1)!."""
    shape = np.broadcast_shapes(A.shape, N.shape)
    term = np.broadcast_to(N, shape)
    total = term
    for k in range(2, _ORDER + 2):
        product = A @ term
        term = (product + np.swapaxes(product, -1, -2)) / k
        total = total + term
    return total


def _doublings(A: FloatArray) -> npt.NDArray[np.int64]:
    """How often each piece is doubled, (...)."""
    norm = np.abs(A).sum(axis=-2).max(axis=-1, initial=0.0)
    return np.asarray(np.ceil(np.log2(np.maximum(norm / _SHORT, 1.0))), np.int64)


def _square(A: FloatArray, what: str) -> FloatArray:
    if A.ndim < 2 or A.shape[-1] != A.shape[-2]:
        raise ModelError(f"{what} must be a square matrix (..., n, n), got shape {A.shape}.")
    return A


def _finite(result: FloatArray, exponent: FloatArray) -> FloatArray:
    if not np.isfinite(result).all():
        norm = np.abs(exponent).sum(axis=-2).max()
        raise NumericalError(
            f"exp(F dt) overflows: ||F dt|| reaches {norm:.3g} and F is unstable.\n"
            "Check the units of F (1/s) and dt (s), and the longest interval."
        )
    return result
