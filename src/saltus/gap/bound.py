"""A bound no filter can beat: the covariance of the filter that is told the modes.

    P_k <- F P_{k-1} F' + Q,   P_k <- (P_k^-1 + H' R^-1 H)^-1,   all at the true modes of a run; averaged over runs.

Given the modes the posterior Cramer-Rao bound is this covariance (for linear models it is reached by the Kalman
filter), and knowing the modes can only help: the average over mode sequences bounds the mean square error of every
filter from below. It is not the tightest: a filter must find the modes out first. Nonlinear sensors count with their
tangent at the true state, which makes the figure an approximation.

Source: Tichavsky, Muravchik and Nehorai (1998), Posterior Cramer-Rao bounds for discrete-time nonlinear filtering, IEEE
Trans. SP 46(5), equation 21, in covariance form; Hernandez, Farina and Ristic (2006), PCRLB for tracking in cluttered
environments, for conditioning on the sequence.
"""

import numpy as np
import numpy.typing as npt

from saltus.filters import steps
from saltus.filters.flat import Flat
from saltus.models import DiffusionSensor
from saltus.shapes import Float, Int

__all__ = ["informed_covariance"]

_Array = npt.NDArray[np.float64]


def informed_covariance(
    flat: Flat,
    modes: Int[np.ndarray, "b t"],
    sensor: DiffusionSensor | None = None,
    states: Float[np.ndarray, "b t n"] | None = None,
) -> Float[np.ndarray, "b t n n"]:
    """Return the covariance of the filter that is told the joint modes, of each run and row.

    Args:
        flat: arrays of the model, common to all runs.
        modes: true joint modes, in C order.
        sensor: a nonlinear sensor in place of the H and R of `flat`.
        states: true states, where its tangents are taken.
    """
    B, T = modes.shape
    n = flat.mean0.shape[-1]
    _, P = steps.collapse(
        np.broadcast_to(flat.log_probs0, (1, flat.n_modes)),
        np.broadcast_to(flat.mean0, (1, flat.n_modes, n)),
        np.broadcast_to(flat.cov0, (1, flat.n_modes, n, n)),
        1,
    )
    P, x = np.broadcast_to(P, (B, n, n)), np.zeros((B, n))
    out = np.empty((B, T, n, n))
    for k in range(T):
        F, _, Q, H, _, R = (None if a is None else a[0] for a in flat.matrices(k, modes[:, k]))
        if F is None or Q is None or H is None or R is None:
            raise TypeError("F, Q, H and R are always there")
        _, P = steps.propagate(x, P, F, None, Q)
        if sensor is not None and states is not None:
            H, R = _tangents(sensor, modes[:, k], states[:, k])
        m = R.shape[-1]
        seen = np.ones((B, m), bool)
        P = steps.condition(steps.measure(x, P, H, None, R), np.zeros((B, m)), seen).cov
        out[:, k] = P
    return out


def _tangents(sensor: DiffusionSensor, modes: npt.NDArray[np.int64], x: _Array) -> tuple[_Array, _Array]:
    """H (b, m, n) by central differences, and R (b, m, m), at states (b, n)."""
    n = x.shape[-1]
    step = 1e-5 * np.maximum(np.abs(x), 1.0)
    m = sensor.h_at(0, x[:1]).shape[-1]
    H, R = np.empty((len(x), m, n)), np.empty((len(x), m, m))
    for mode in np.unique(modes):
        own = modes == mode
        here, by = x[own], step[own]
        R[own] = sensor.noise_at(int(mode), here)
        for i in range(n):
            move = by[:, i, None] * np.eye(n)[i]
            change = sensor.residual(sensor.h_at(int(mode), here + move), sensor.h_at(int(mode), here - move))
            H[own, :, i] = change / (2 * by[:, i, None])
    return H, R
