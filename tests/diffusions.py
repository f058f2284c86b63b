"""Switching diffusions of the moment-filter notes, section 11; written out here, not taken from the study."""

import numpy as np

from saltus import DiffusionSensor, SwitchingSDE


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
