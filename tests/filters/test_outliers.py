"""Every filter that reweighs, against measurements as far off as double precision holds, and farther."""

import numpy as np
import pytest

from saltus import (
    DataError,
    DiffusionSensor,
    GridFilter,
    MomentFilter,
    NumericalError,
    ParticleFilter,
    SwitchingSDE,
    imm_filter,
)
from saltus.compiled import native_module
from saltus.filters import GPB2, augmented_filter, coloured_filter, exact_filter, particle_filter

BACKENDS = ["numpy"] if native_module() is None else ["numpy", "native"]
TRANS = [np.array([[0.9, 0.1], [0.2, 0.8]])]
ONE = np.ones((1, 1, 1))
WHITE = {
    "F": ONE,
    "Q": np.array([[[1.0]], [[2.0]]]),
    "H": ONE,
    "R": ONE,
    "trans": TRANS,
    "mean0": [0.0],
    "cov0": [[1.0]],
    "probs0": [0.5, 0.5],
}
COLOURED = {
    "F": 0.0 * ONE,
    "G": np.array([[[1.0]], [[2.0]]]),
    "noise_F": -ONE,
    "noise_G": ONE,
    "H": np.ones((1, 1)),
    "dt": 1.0,
    "trans": TRANS,
    "mean0": [0.0],
    "cov0": [[1.0]],
    "noise_cov0": [[1.0]],
    "probs0": [0.5, 0.5],
}
SDE = SwitchingSDE(
    drift=[lambda x: -x, lambda x: -2 * x],
    diffusion=[np.eye(1), 1.5 * np.eye(1)],
    intensity={(0, 1): 0.1, (1, 0): 0.2},
    probs0=[0.5, 0.5],
    mean0=[0.0],
    cov0=[[1.0]],
)
SENSOR = DiffusionSensor(h=[lambda x: x] * 2, R=[np.eye(1)] * 2)
TIMES = [1.0, 2.0, 3.0]


def rng():
    return np.random.default_rng(1)


def particles(z, backend=None):
    return particle_filter(z, **WHITE, n_particles=64, groups=2, rng=rng(), backend=backend)


FILTERS = {
    "exact": lambda z: exact_filter(z, **WHITE),
    "GPB2": lambda z: exact_filter(z, **WHITE, rule=GPB2),
    "moments": lambda z: MomentFilter(closure="gaussian").run(SDE, SENSOR, z, TIMES),
    "maximum entropy": lambda z: MomentFilter(closure="maxent").run(SDE, SENSOR, z, TIMES),
    "bootstrap": lambda z: ParticleFilter(64, groups=2).run(SDE, SENSOR, z, TIMES, rng()),
    "auxiliary": lambda z: ParticleFilter(64, groups=2, proposal="auxiliary").run(SDE, SENSOR, z, TIMES, rng()),
}
for backend in BACKENDS:
    FILTERS |= {
        f"imm {backend}": lambda z, backend=backend: imm_filter(z, **WHITE, backend=backend),
        f"coloured {backend}": lambda z, backend=backend: coloured_filter(z, **COLOURED, backend=backend),
        f"augmented {backend}": lambda z, backend=backend: augmented_filter(z, **COLOURED, backend=backend),
        f"particles {backend}": lambda z, backend=backend: particles(z, backend),
    }


def measured(size):
    """Two runs of three rows; the second has an outlier in its second row."""
    return np.array([[[0.1], [0.2], [0.3]], [[0.0], [size], [0.0]]])


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("size", [1e2, 1e7, 1e9, 1e16, 1e100, 1e150])
def test_probabilities_sum_to_one_after_an_outlier_of_any_size(name, size):
    est = FILTERS[name](measured(size))
    assert np.abs(est.probs.sum(-1) - 1.0).max() < 1e-12
    for part in (est.mean, est.cov, est.log_likelihood):
        assert np.isfinite(part).all()


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("size", [1e160, 1e300])
def test_past_overflow_the_error_names_run_row_and_component(name, size):
    with pytest.raises(DataError) as told:
        FILTERS[name](measured(size))
    for word in ("run 1", "row 1", "component 0"):
        assert word in str(told.value)


@pytest.mark.parametrize("size", [1e9, 1e50, 1e160])
def test_a_grid_refuses_what_lies_off_it(size):
    with pytest.raises(DataError, match=r"row 1: measurement .* of run 1, component 0, is impossible"):
        GridFilter(64, ([-8.0], [8.0])).run(SDE, SENSOR, measured(size), TIMES)


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_one_bad_run_of_a_batch_is_named_and_the_others_are_said_to_be_sound(backend):
    z = np.zeros((3, 4, 5, 1))
    z[1, 2, 3] = 1e200
    with pytest.raises(DataError, match=r"run \[1, 2\], row 3, component 0 measures 1e\+200.*The other 11 run"):
        imm_filter(z, **WHITE, backend=backend)
    rest = np.delete(z.reshape(12, 5, 1), 6, axis=0)
    assert np.isfinite(imm_filter(rest, **WHITE, backend=backend).mean).all()


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_component_that_is_too_far_is_named(backend):
    model = {**WHITE, "H": np.ones((1, 3, 1)), "R": np.eye(3)[None]}
    with pytest.raises(DataError, match="row 2, component 1 measures -1e"):
        imm_filter([[0.0, 1.0, 0.0], [np.nan] * 3, [1e9, -1e180, np.nan]], **model, backend=backend)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_component_without_noise_or_uncertainty_is_named(backend):
    model = {**WHITE, "H": np.ones((1, 2, 1)), "R": np.diag([1.0, 0.0])[None], "Q": 0.0 * ONE, "cov0": [[0.0]]}
    with pytest.raises(NumericalError, match=r"run 0, row 1, component 1: .*not positive definite.*positive variance"):
        imm_filter([[[0.0, np.nan], [0.0, 0.0]]], **model, backend=backend)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_state_that_overflows_is_named(backend):
    with pytest.raises(NumericalError, match=r"row 2: the prediction is not finite.*Look at F, Q"):
        imm_filter(np.full((4, 1), np.nan), **{**WHITE, "F": 1e60 * ONE}, backend=backend)
