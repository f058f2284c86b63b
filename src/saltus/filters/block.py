"""The gain of two measurement channels written apart: what each adds to the other, as in a structure diagram.

An equivalent of the stacked gain R~ H' W^-1 that `steps.condition` computes; the filters use the stacked one.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import ModelError, NumericalError
from saltus.shapes import Float

__all__ = ["BlockGain", "block_gain"]

_Array = npt.NDArray[np.float64]


class BlockGain(NamedTuple):
    """Gains of two channels for their own innovations: x = x~ + K1 nu1 + K2 nu2."""

    first: Float[np.ndarray, "*lead n m1"]
    second: Float[np.ndarray, "*lead n m2"]
    schur: Float[np.ndarray, "*lead m1 m1"]  # D, covariance of nu1 given nu2


def block_gain(
    cov: npt.ArrayLike, H1: npt.ArrayLike, R1: npt.ArrayLike, H2: npt.ArrayLike, R2: npt.ArrayLike
) -> BlockGain:
    """Return the gains of two channels with independent noises.

    W_ab = H_a R~ H_b' (+ R_a on the diagonal),   D = W11 - W12 W22^-1 W21,
    K1 = R~ H1' D^-1 - R~ H2' W22^-1 W21 D^-1,
    K2 = -R~ H1' D^-1 W12 W22^-1 + R~ H2' (W22^-1 + W22^-1 W21 D^-1 W12 W22^-1)

    Args:
        cov: R~, predicted covariance, (..., n, n).
        H1: measurement matrix of the first channel, (..., m1, n).
        R1: its noise covariance, (..., m1, m1).
        H2: measurement matrix of the second channel, (..., m2, n).
        R2: its noise covariance, (..., m2, m2).

    Returns:
        The gains, and D. Side by side, [K1 K2], they are the stacked gain.

    Raises:
        ModelError: shapes do not fit.
        NumericalError: W22 or D is singular: a measured component has neither noise nor uncertainty.

    Source: Detkov (2023), equations 3.2-3.4, A.29-A.34, corrected as the fusion notes, sections 4 and 8.
    """
    P, A, B, Ra, Rb = (np.asarray(a, np.float64) for a in (cov, H1, H2, R1, R2))
    n = P.shape[-1] if P.ndim else 0
    for name, a, rows, cols in (("cov", P, n, n), *_shapes("1", A, Ra, n), *_shapes("2", B, Rb, n)):
        if a.ndim < 2 or a.shape[-2:] != (rows, cols):
            raise ModelError(f"{name} has shape {a.shape}, expected (..., {rows}, {cols}) beside cov {P.shape}.")
    PA, PB = P @ A.swapaxes(-1, -2), P @ B.swapaxes(-1, -2)
    W11, W12, W22 = A @ PA + Ra, A @ PB, B @ PB + Rb
    W21 = W12.swapaxes(-1, -2)
    try:
        W22_inv = np.linalg.inv(W22)
        D = W11 - W12 @ W22_inv @ W21
        D_inv = np.linalg.inv(D)
    except np.linalg.LinAlgError as error:
        raise NumericalError(
            f"the innovations of the two channels have a singular covariance ({error}): give every measured "
            "component a positive variance in R1 and R2."
        ) from error
    K1 = PA @ D_inv - PB @ W22_inv @ W21 @ D_inv
    K2 = -PA @ D_inv @ W12 @ W22_inv + PB @ (W22_inv + W22_inv @ W21 @ D_inv @ W12 @ W22_inv)
    return BlockGain(K1, K2, D)


def _shapes(which: str, H: _Array, R: _Array, n: int) -> tuple[tuple[str, _Array, int, int], ...]:
    m = H.shape[-2] if H.ndim > 1 else 1
    return (f"H{which}", H, m, n), (f"R{which}", R, m, m)
