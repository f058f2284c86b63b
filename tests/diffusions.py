"""Switching diffusions of the moment-filter notes, section 11; written out here, not taken from the study."""

from contextlib import contextmanager

import jaxtyping
import numpy as np

from saltus import DiffusionSensor, SwitchingSDE


@contextmanager
def unchecked():
    """As users run it: annotations are not executed, and what is refused is refused by the package itself."""
    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        yield
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)


def double_well(y):
    return 2 * (y - y**3)


def leaving(y):
    return 0.2 + 0.6 * y[..., 0] ** 2 / (1 + y[..., 0] ** 2)


def case(name):
    """Model and sensor of a case: a1, a2, b, br or c."""
    half = [0.5, 0.5]
    if name in ("a1", "a2"):
        intensity = {(0, 1): 0.3, (1, 0): leaving if name == "a1" else 0.3}
        model = SwitchingSDE(
            drift=[double_well, lambda y: 0.5 - y], diffusion=[0.8, 0.6], intensity=intensity, probs0=half
        )
        if name == "a1":
            return model, DiffusionSensor(h=[lambda y: y] * 2, R=[0.64] * 2)
        return model, DiffusionSensor(h=[lambda y: y**3] * 2, R=[0.25] * 2)
    if name in ("b", "br"):
        restore = {(0, 1): ([1.5], [[0.04]]), (1, 0): ([-1.5], [[0.04]])} if name == "br" else None
        model = SwitchingSDE(
            drift=[lambda y: 1 - y, lambda y: -1 - y],
            diffusion=[0.4, 0.4],
            intensity={(0, 1): 0.4, (1, 0): 0.4},
            restore=restore,
            probs0=half,
        )
        return model, DiffusionSensor(h=[lambda y: y] * 2, R=[0.49] * 2)
    goals = np.array([[1.5, 0.0], [0.0, 1.5]])
    model = SwitchingSDE(
        drift=[lambda y: -0.6 * (y - goals[0]), lambda y: -0.6 * (y - goals[1])],
        diffusion=[0.35, 0.8],
        intensity={(0, 1): 0.3, (1, 0): 0.5},
        probs0=half,
        mean0=[1.2, 0.3],
        cov0=0.36 * np.eye(2),
    )
    R = np.diag([0.12**2, 0.6**2])
    return model, DiffusionSensor(h=[range_bearing] * 2, R=[R, R], angular=(1,))


def range_bearing(y):
    return np.stack([np.hypot(y[..., 0], y[..., 1]), np.arctan2(y[..., 1], y[..., 0])], axis=-1)


def exact_mixture(z, times, rng, n_paths):
    """Posterior of case b at the last time by drawing switching paths: given a path all is Gaussian.

    The forcing is +1 in mode 0 and -1 in mode 1; Y - m given the path is an Ornstein-Uhlenbeck process of unit rate,
    so that only the mean depends on the path. Returns P(mode 0), mean and variance, and their standard errors.
    """
    T, end = len(times), times[-1]
    dt = times[:, None] - times[None, :]
    within = 0.08 * (np.exp(-np.abs(dt)) - np.exp(-(times[:, None] + times[None, :])))
    C = within + np.exp(-(times[:, None] + times[None, :]))  # the start has variance 1
    S = C + 0.49 * np.eye(T)
    mode = rng.integers(0, 2, n_paths)
    mean, at, now = np.zeros((n_paths, T)), np.zeros(n_paths), mode.copy()
    now_at = np.zeros((n_paths, T), int)
    while (at < end).any():
        leave = at + rng.exponential(1 / 0.4, n_paths)
        for k, t in enumerate(times):
            a, b = np.minimum(at, t), np.minimum(leave, t)
            mean[:, k] += np.where(now == 0, 1.0, -1.0) * (np.exp(-(t - b)) - np.exp(-(t - a)))
            now_at[:, k] = np.where((at <= t) & (t < leave), now, now_at[:, k])
        at, now = leave, 1 - now
    nu = z - mean
    log_w = -0.5 * np.einsum("pi,ij,pj->p", nu, np.linalg.inv(S), nu)
    w = np.exp(log_w - log_w.max())
    w /= w.sum()
    gain = np.linalg.solve(S, C[:, -1])
    y = mean[:, -1] + nu @ gain
    first = w @ (now_at[:, -1] == 0)
    m = w @ y
    var = C[-1, -1] - C[-1] @ gain + w @ (y - m) ** 2
    spread = lambda f, value: np.sqrt(np.sum(w**2 * (f - value) ** 2))  # noqa: E731
    errors = spread(now_at[:, -1] == 0, first), spread(y, m), spread((y - m) ** 2, w @ (y - m) ** 2)
    return np.array([first, m, var]), np.array(errors)


def distances(estimates, case):
    """Rms error of the mean in posterior standard deviations, mean covariance error, rms error of P(mode 0)."""
    cov = case["grid_cov"] if "grid_cov" in case else case["grid_var"][..., None, None]
    mean = case["grid_mean"] if "grid_cov" in case else case["grid_mean"][..., None]
    off = (estimates.mean - mean) / np.sqrt(np.diagonal(cov, axis1=-2, axis2=-1))
    size = np.linalg.norm(cov, axis=(-2, -1))
    return (
        np.sqrt(np.mean(off**2)),
        np.mean(np.linalg.norm(estimates.cov - cov, axis=(-2, -1)) / size),
        np.sqrt(np.mean((estimates.probs[..., 0] - case["grid_prob1"]) ** 2)),
    )


def few(case, runs, steps):
    """A part of a reference case, its z with a component axis."""
    part = {k: v[:steps] if k == "times" else v[:runs, :steps] for k, v in case.items()}
    if part["z"].ndim == 2:
        part["z"] = part["z"][..., None]
    return part
