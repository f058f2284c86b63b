"""The experiment with coloured noise: a point whose agitation and whose sensor's noise jump, and five filters.

Position and velocity of a damped oscillator, driven by white noise of two levels, are estimated from its position
plus first-order noise of two levels. The filters: *adaptive* knows neither level, *nominal* believes in the lower
ones, *clairvoyant* is told both; *white* is adaptive but takes the noise, of the right variance, for white; *raw* is
the measurement itself.

Source: Detkov (2023), section 3.1 with the corrections of the notes on coloured measurement noise, section 4.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus import montecarlo
from saltus.evaluate.estimation import nees
from saltus.filters import Estimates, coloured_filter, imm_filter
from saltus.filters.coloured import after_first, run_differenced
from saltus.filters.coloured_model import Augmented
from saltus.linalg import block_diagonal
from saltus.models import discretise
from saltus.shapes import Float

__all__ = ["FILTERS", "PAPER_RATE", "STEPS", "Trial", "follow", "oscillator", "run_coloured", "scripted_modes"]

FILTERS = ("adaptive", "nominal", "clairvoyant", "white")
STEPS = 400
PAPER_RATE = 10.0  # noise's rate over the oscillator's
_DT = 0.5  # s
_RATE = 2 * np.pi / 20  # rad/s
_SIGMA_X, _SIGMA_W = np.sqrt(5.0), 1.0
_A, _B = np.array([1.0, 5.0]), np.array([1.0, 10.0])  # factors of the two variances
_TRANS = np.array([[0.9, 0.1], [0.1, 0.9]])
_RUNS_AT_ONCE = 400  # about 300 MB

_Array = npt.NDArray[np.float64]
_Modes = npt.NDArray[np.int64]


class Trial(NamedTuple):
    """What B runs gave at K steps; state (position, velocity), filters in the order of FILTERS."""

    modes: npt.NDArray[np.int64]  # (B, K, 2): truth of the two chains
    states: Float[np.ndarray, "b k 2"]
    z: Float[np.ndarray, "b k 1"]
    estimate: Float[np.ndarray, "b f k 2"]
    variance: Float[np.ndarray, "b f k 2"]
    nees: Float[np.ndarray, "b f k"]
    probs: Float[np.ndarray, "b 2 k 2 2"]  # of the adaptive and the white filter


def scripted_modes() -> npt.NDArray[np.int64]:
    """Return the chains of the published run, (K, 2): agitated in steps 50 to 149, noisy in steps 200 to 299."""
    k = np.arange(1, STEPS + 1)
    return np.stack([(k >= 50) & (k <= 149), (k >= 200) & (k <= 299)], axis=-1).astype(np.int64)


def oscillator(rate: float) -> dict[str, _Array]:
    """Return F, G, noise_F, noise_G, H, cov0 and noise_cov0 of `coloured_filter`.

    F = [[0, 1], [-2 alpha^2, -2 alpha]],  G = [0, sqrt(8 alpha^3 a) sigma_x],  noise: -rate alpha, sqrt(2 rate alpha b)
    sigma_w: stationary variances a sigma_x^2, 2 alpha^2 a sigma_x^2, b sigma_w^2.

    Args:
        rate: 1 / correlation time of the noise, in units of alpha.
    """
    G = np.zeros((2, 1, 2, 1))
    G[:, 0, 1, 0] = np.sqrt(8 * _RATE**3 * _A) * _SIGMA_X
    return {
        "F": np.array([[0.0, 1.0], [-2 * _RATE**2, -2 * _RATE]]).reshape(1, 1, 2, 2),
        "G": G,
        "noise_F": np.full((1, 1, 1, 1), -rate * _RATE),
        "noise_G": (np.sqrt(2 * rate * _RATE * _B) * _SIGMA_W).reshape(1, 2, 1, 1),
        "H": np.array([[1.0, 0.0]]),
        "cov0": np.diag([1.0, 2 * _RATE**2]) * _SIGMA_X**2,
        "noise_cov0": (_B * _SIGMA_W**2).reshape(1, 2, 1, 1),
    }


def run_coloured(
    n_runs: int,
    seed: int,
    *,
    rate: float = PAPER_RATE,
    drawn: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Trial:
    """Repeat the experiment.

    Args:
        n_runs: number of runs.
        seed: root of the runs' generators.
        rate: of the noise, in units of the oscillator's.
        drawn: number of steps whose chains are drawn from their own law; None follows the published script.
        progress: called with (runs done, all runs).

    Returns:
        Truth, measurements and every filter's answers, one row of axis 0 per run.
    """
    trial = partial(_trial, rate=rate, drawn=drawn)
    return montecarlo.run(trial, n_runs, seed, batch=_RUNS_AT_ONCE, progress=progress)


def _trial(rngs: Sequence[np.random.Generator], *, rate: float, drawn: int | None) -> Trial:
    first, modes = _draw_modes(rngs, drawn)
    states, z = _simulate(rngs, rate, first, modes)
    found = follow(z, first, modes, rate)
    error = np.stack([states - est.mean for est in found], axis=1)
    cov = np.stack([est.cov for est in found], axis=1)
    return Trial(
        modes=modes,
        states=states,
        z=z[:, 1:],
        estimate=np.stack([est.mean for est in found], axis=1),
        variance=np.diagonal(cov, axis1=-2, axis2=-1).copy(),
        nees=nees(error, cov),
        probs=np.stack([found[FILTERS.index(name)].probs for name in ("adaptive", "white")], axis=1),
    )


def _draw_modes(rngs: Sequence[np.random.Generator], drawn: int | None) -> tuple[_Modes, _Modes]:
    """Chains at the first sample, (B, 2), and after it, (B, K, 2)."""
    if drawn is None:
        return np.zeros((len(rngs), 2), np.int64), np.broadcast_to(scripted_modes(), (len(rngs), STEPS, 2)).copy()
    u = np.stack([rng.random((drawn + 1, 2)) for rng in rngs])
    first = (u[:, 0] < 0.5).astype(np.int64)
    jumps = np.cumsum(u[:, 1:] < _TRANS[0, 1], axis=1)  # both chains leave either state equally often
    return first, (first[:, None] + jumps) % 2


def _simulate(rngs: Sequence[np.random.Generator], rate: float, first: _Modes, modes: _Modes) -> tuple[_Array, _Array]:
    """States (B, K, 2) and measurements (B, K+1, 1); noise and state are continuous when their chains jump."""
    model = oscillator(rate)
    Phi, Q = discretise(model["F"][0, 0], model["G"][0, 0], _DT)
    phi, q = discretise(model["noise_F"][0, 0], model["noise_G"][0, 0], _DT)
    root, decay, kick = np.linalg.cholesky(Q), float(phi[0, 0]), float(np.sqrt(q[0, 0]))
    n_steps = modes.shape[1]
    normal = np.stack([rng.normal(size=(n_steps + 1, 3)) for rng in rngs])
    x = normal[:, 0, :2] * np.sqrt(np.diag(model["cov0"]))
    w = normal[:, 0, 2] * np.sqrt(_B[first[:, 1]]) * _SIGMA_W
    states, z = np.empty((len(rngs), n_steps, 2)), np.empty((len(rngs), n_steps + 1, 1))
    z[:, 0, 0] = x[:, 0] + w
    for k in range(n_steps):
        x = x @ Phi.T + np.sqrt(_A[modes[:, k, 0], None]) * (normal[:, k + 1, :2] @ root.T)
        w = decay * w + kick * np.sqrt(_B[modes[:, k, 1]]) * normal[:, k + 1, 2]
        states[:, k], z[:, k + 1, 0] = x, x[:, 0] + w
    return states, z


def follow(
    z: npt.NDArray[np.float64], first: npt.NDArray[np.int64], modes: npt.NDArray[np.int64], rate: float
) -> list[Estimates]:
    """Run every filter over measurements.

    Args:
        z: (B, K+1, 1).
        first: true modes at the first sample, (B, 2).
        modes: true modes after it, (B, K, 2).
        rate: of the noise, in units of the oscillator's.

    Returns:
        Estimates in the order of FILTERS.
    """
    model = oscillator(rate)
    adaptive = coloured_filter(
        z,
        F=model["F"],
        G=model["G"],
        noise_F=model["noise_F"],
        noise_G=model["noise_G"],
        H=model["H"],
        dt=_DT,
        trans=[_TRANS, _TRANS],
        mean0=np.zeros(2),
        cov0=model["cov0"],
        noise_cov0=model["noise_cov0"],
        probs0=np.full((2, 2), 0.25),
    )
    before, after = (np.concatenate([np.zeros_like(a), a]) for a in (first, modes))
    told = _told(np.concatenate([z, z]), before, after, rate)
    return [adaptive, _runs(told, slice(len(z))), _runs(told, slice(len(z), None)), _white(z, model)]


def _runs(est: Estimates, which: slice) -> Estimates:
    """The estimates of some runs."""
    return Estimates(
        probs=est.probs[which],
        mean=est.mean[which],
        cov=est.cov[which],
        log_likelihood=est.log_likelihood[which],
        log_likelihood_start=est.log_likelihood_start[which],
        nis=est.nis[which],
        n_observed=est.n_observed[which],
    )


def _told(z: _Array, first: _Modes, modes: _Modes, rate: float) -> Estimates:
    """The filter that is told the modes, (B, 2) at the first sample and (B, K, 2) after it."""
    model = oscillator(rate)
    x = discretise(model["F"], model["G"], _DT)
    w = discretise(model["noise_F"], model["noise_G"], _DT)
    Q = block_diagonal(x[1][modes[..., 0], 0], w[1][0, modes[..., 1]])
    F = np.broadcast_to(block_diagonal(x[0][0, 0], w[0][0, 0]), Q.shape)
    cov0 = block_diagonal(model["cov0"], model["noise_cov0"][0, first[:, 1]])
    described = Augmented(F, Q, None, model["H"], np.eye(1), np.zeros(3), cov0)
    return after_first(run_differenced(z, described, [], 1.0))


def _white(z: _Array, model: dict[str, _Array]) -> Estimates:
    """The multimode filter that takes the noise for white: nothing moves before the first sample."""
    rows = z.shape[1]
    Phi, Q = discretise(model["F"], model["G"], _DT)
    F = np.broadcast_to(Phi, (rows, *Phi.shape)).copy()
    F[0], still = np.eye(2), np.broadcast_to(_TRANS, (rows, 2, 2)).copy()
    still[0] = np.eye(2)
    Q = np.broadcast_to(Q, (rows, *Q.shape)).copy()
    Q[0] = 0.0
    est = imm_filter(
        z,
        F=F,
        Q=Q,
        H=model["H"].reshape(1, 1, 1, 2),
        R=model["noise_cov0"],
        trans=[still, still],
        mean0=np.zeros(2),
        cov0=model["cov0"],
        probs0=np.full((2, 2), 0.25),
    )
    return after_first(est)
