"""The fusion experiment: a manoeuvring object, an active and a passive sensor that fail unannounced, three chains.

State [phi, omega, D, V, J]: angle (rad), its rate (rad/s), deviations of distance (m) and closing speed (m/s) from a
nominal approach, acceleration (m/s^2). Measured every second: angle and speed by the active sensor, the angle again
by the passive one. Chain A is the intensity of J (1, 5), B the variance factor of the active sensor (1, 10), C the gain
of the passive one (1, 10). Three filters follow: adaptive (eight modes), nominal (a Kalman filter for the first state
of every chain) and clairvoyant (a Kalman filter that is told the chains).

Source: Detkov (2023), section 4; theory notes on fusion, section 7, whose choices are those made here.
"""

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from saltus import montecarlo
from saltus.evaluate import nees
from saltus.filters import Estimates, imm_filter
from saltus.models import discretise
from saltus.shapes import Float, Int

__all__ = [
    "CHAINS",
    "FILTERS",
    "STATES",
    "STEPS",
    "Chains",
    "Matrices",
    "Trial",
    "Variant",
    "filtered",
    "fixed_chains",
    "matrices",
    "run_fusion",
]

FILTERS = ("adaptive", "nominal", "clairvoyant")
CHAINS = ("A", "B", "C")
STATES = ("phi", "omega", "V", "J")  # those that are judged: D is not observed
STEPS = 200  # of 1 s
_JUDGED = [0, 1, 3, 4]
_DT = 1.0  # s
_TRANS = np.array([[0.8, 0.2], [0.2, 0.8]])
_CHI, _CHI_J = 0.16, 0.1  # 1/s
_SIGMA_PHI, _SIGMA_V = 0.1, 30.0  # rad and m/s: stationary standard deviations of phi and, in state 1 of A, of V
_SPEED = 300.0  # m/s, nominal closing speed
_COV0 = np.diag(np.square([0.1, 0.016, 100.0, 30.0, 3.0]))
_RUNS_AT_ONCE = 100  # about 200 MB

_Array = npt.NDArray[np.float64]
Variant = Literal["frozen", "range"]
Chains = Literal["test", "drawn"]


class Matrices(NamedTuple):
    """The model's arrays, with mode axes A, B, C, as `imm_filter` takes them."""

    F: Float[np.ndarray, "*_f 5 5"]  # (T?, 1, 1, 1, 5, 5)
    Q: Float[np.ndarray, "*_q 5 5"]  # (T?, 2, 1, 1, 5, 5)
    H: Float[np.ndarray, "*_h 3 5"]  # (1, 1, 2, 3, 5)
    R: Float[np.ndarray, "*_r 3 3"]  # (1, 2, 1, 3, 3)


class Trial(NamedTuple):
    """What B runs of T steps gave; filters in the order of FILTERS, states in the order of STATES."""

    modes: Int[np.ndarray, "b t 3"]
    states: Float[np.ndarray, "b t 4"]
    measurement: Float[np.ndarray, "b t 3"]
    estimate: Float[np.ndarray, "b 3 t 4"]
    nees: Float[np.ndarray, "b t"]  # of the adaptive filter, over STATES
    marginals: Float[np.ndarray, "b t 3"]  # P(second state) of each chain, adaptive filter
    prob_true: Float[np.ndarray, "b t"]  # P of the true joint mode
    prob_square: Float[np.ndarray, "b t"]  # sum of P^2 over the joint modes: the former, on average, if P is honest
    decided: Int[np.ndarray, "b t 3"]  # the most probable joint mode


def matrices(variant: Variant) -> Matrices:
    """Build the model: frozen at a distance of 40 km, or depending on it as it shrinks from 80 to 20 km.

    d phi = omega dt,  d omega = (-chi^2 phi - 2 alpha omega - psi J) dt + sqrt(4 alpha chi^2 s_phi^2) dW1,
    dD = V dt,  dV = J dt,  dJ = (-chi_J^2 V - 4 chi_J J) dt + sqrt(8 a chi_J^3 s_V^2) dW2,
    alpha = 2 V* / D*,  psi = 1 / D*
    """
    distance = np.array([40e3]) if variant == "frozen" else 80e3 - _SPEED * _DT * np.arange(STEPS)
    alpha = 2 * _SPEED / distance
    F, G = np.zeros((len(alpha), 1, 5, 5)), np.zeros((len(alpha), 2, 5, 2))
    F[..., 0, 1] = F[..., 2, 3] = F[..., 3, 4] = 1.0
    F[..., 1, 0], F[..., 1, 1], F[..., 1, 4] = -(_CHI**2), -2 * alpha[:, None], -1 / distance[:, None]
    F[..., 4, 3], F[..., 4, 4] = -(_CHI_J**2), -4 * _CHI_J
    G[..., 1, 0] = np.sqrt(4 * alpha[:, None] * (_CHI * _SIGMA_PHI) ** 2)
    G[..., 4, 1] = np.sqrt(8 * np.array([1.0, 5.0]) * _CHI_J**3 * _SIGMA_V**2)
    Phi, Q = discretise(F, G, _DT)
    Phi, Q = Phi[:, :1, None, None], Q[:, :, None, None]
    H = np.zeros((1, 1, 2, 3, 5))
    H[..., 0, 0] = H[..., 1, 3] = 1.0
    H[..., 2, 0] = [1.0, 10.0]
    R = np.zeros((1, 2, 1, 3, 3))
    R[..., 0, 0], R[..., 1, 1], R[..., 2, 2] = 1e-4, 0.25, 4e-4
    R[:, 1, :, :2, :2] *= 10.0
    return Matrices(Phi[0], Q[0], H, R) if variant == "frozen" else Matrices(Phi, Q, H, R)


def fixed_chains() -> Int[np.ndarray, "t 3"]:
    """Return the chains the paper sets for its figure, unknown to the filter: (T, 3), 0 or 1."""
    k = np.arange(1, STEPS + 1)
    A = ((k >= 120) & (k < 140)) | ((k >= 160) & (k < 180))
    return np.stack([A, (k >= 50) & (k < 70), (k >= 90) & (k < 130)], axis=-1).astype(np.int64)


def run_fusion(
    n_runs: int,
    seed: int,
    variant: Variant = "frozen",
    chains: Chains = "test",
    progress: Callable[[int, int], None] | None = None,
) -> Trial:
    """Repeat the experiment.

    Args:
        n_runs: number of runs, each with its own initial state and noises.
        seed: root of the runs' generators.
        variant: "frozen" at one distance, or a model that depends on the "range".
        chains: the "test" chains, the same in every run, or "drawn" from the model's law.
        progress: called with (runs done, all runs).
    """
    model = matrices(variant)

    def trial(rngs: Sequence[np.random.Generator]) -> Trial:
        modes, states, z = _drawn(rngs, model, chains)
        return filtered(model, modes, states, z)

    return montecarlo.run(trial, n_runs, seed, batch=_RUNS_AT_ONCE, progress=progress)


def _drawn(
    rngs: Sequence[np.random.Generator], model: Matrices, chains: Chains
) -> tuple[npt.NDArray[np.int64], _Array, _Array]:
    """Draw modes (B, T, 3), states (B, T, 5) and measurements (B, T, 3); each run from its own generator."""
    start, noise = (np.stack([rng.standard_normal(shape) for rng in rngs]) for shape in ((5,), (STEPS, 8)))
    if chains == "test":
        modes = np.broadcast_to(fixed_chains(), (len(rngs), STEPS, 3)).copy()
    else:
        # Equal switching both ways: the first state is even odds, then each step switches or not.
        switch = np.stack([rng.uniform(size=(STEPS + 1, 3)) for rng in rngs])
        flips = switch < np.array([0.5] + [_TRANS[0, 1]] * STEPS)[:, None]
        modes = flips.cumsum(axis=1)[:, 1:] % 2
    x, states = start @ np.sqrt(_COV0), np.empty((len(rngs), STEPS, 5))
    roots = _root(model.Q)
    for k in range(STEPS):
        F, root = (a[k] if a.ndim == 6 else a for a in (model.F, roots))
        moved = (F[0, 0, 0] @ x[..., None]) + root[modes[:, k, 0], 0, 0] @ noise[:, k, :5, None]
        states[:, k] = x = moved[..., 0]
    H, R = model.H[0, 0][modes[..., 2]], np.diagonal(model.R[0, :, 0], axis1=-2, axis2=-1)[modes[..., 1]]
    z = np.einsum("btij,btj->bti", H, states) + np.sqrt(R) * noise[..., 5:]
    return modes.astype(np.int64), states, z


def _root(cov: _Array) -> _Array:
    """Symmetric square roots: Q is nearly singular."""
    values, vectors = np.linalg.eigh(cov)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :] @ vectors.swapaxes(-1, -2))


def filtered(
    model: Matrices, modes: Int[np.ndarray, "b t 3"], states: Float[np.ndarray, "b t 5"], z: Float[np.ndarray, "b t 3"]
) -> Trial:
    """Run the three filters on simulated runs (B, T): their modes, true states and measurements."""
    adaptive = imm_filter(
        z, **model._asdict(), trans=[_TRANS] * 3, mean0=np.zeros(5), cov0=_COV0, probs0=np.full((2, 2, 2), 1 / 8)
    )
    first = np.zeros_like(modes[:1])
    answers = [adaptive, _kalman(model, first, z), _kalman(model, modes, z)]
    off = states[..., _JUDGED] - adaptive.mean[..., _JUDGED]
    p = adaptive.probs
    flat = p.reshape(*p.shape[:2], 8)
    true = np.ravel_multi_index(tuple(np.moveaxis(modes, -1, 0)), (2, 2, 2))
    return Trial(
        modes=modes,
        states=states[..., _JUDGED],
        measurement=z,
        estimate=np.stack([a.mean[..., _JUDGED] for a in answers], axis=1),
        nees=nees(off, adaptive.cov[..., _JUDGED, :][..., _JUDGED]),
        marginals=np.stack([adaptive.prob(c)[..., 1] for c in range(3)], axis=-1),
        prob_true=np.take_along_axis(flat, true[..., None], axis=-1)[..., 0],
        prob_square=np.square(flat).sum(-1),
        decided=np.stack(np.unravel_index(flat.argmax(-1), (2, 2, 2)), axis=-1).astype(np.int64),
    )


def _kalman(model: Matrices, modes: npt.NDArray[np.int64], z: _Array) -> Estimates:
    """Filter with known modes (B|1, T, 3)."""
    a, b, c = np.moveaxis(modes, -1, 0)
    Q = model.Q[:, 0, 0][a] if model.Q.ndim == 5 else model.Q[np.arange(STEPS), a, 0, 0]
    F = model.F[..., 0, 0, 0, :, :]
    arrays = {"Q": Q, "H": model.H[0, 0][c], "R": model.R[0, :, 0][b]}
    if len(modes) == 1 or (modes == modes[:1]).all():  # the same in every run: one set of matrices for all
        arrays = {name: array[0] for name, array in arrays.items()}
    return imm_filter(z, F=F, **arrays, trans=[], mean0=np.zeros(5), cov0=_COV0, probs0=1.0)
