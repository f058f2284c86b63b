"""Ill-conditioned models and outliers of any size, through every filter: sums, covariances, backends, words."""

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from saltus import DiffusionSensor, GridFilter, MomentFilter, ParticleFilter, SwitchingSDE, imm_filter
from saltus.compiled import native_module
from saltus.errors import DataError, NumericalError
from saltus.filters import GPB2, Bank, Belief, exact_filter, particle_filter, steps
from saltus.filters.align import align
from saltus.linalg import NOTHING
from strategies import hostile_problem, hostile_problems, of_runs, rngs

BACKENDS = ["numpy"] if native_module() is None else ["numpy", "native"]
EPS = float(np.finfo(float).eps)
MOST = 30 * EPS  # below zero, of an eigenvalue in units of the variances: rounding of a sum of up to 20 squares
some = settings(max_examples=60, deadline=None, derandomize=True)
few = settings(max_examples=25, deadline=None, derandomize=True)


def sound(run, p):
    """The runs that are not refused, and their estimates; refusals say run, row and component, and which runs."""
    left = np.arange(len(p["z"]))
    while len(left):
        try:
            return left, run(of_runs(p, left))
        except (DataError, NumericalError) as error:
            assert re.search(r"run \[?\d+\]?, row \d+", str(error)), str(error)
            assert "component" in str(error) or "not finite" in str(error), str(error)
            assert error.runs is not None and error.runs.any()
            left = left[~error.runs]
    return left, None


def assert_covariances(covs):
    assert np.isfinite(covs).all()
    variance = np.diagonal(covs, axis1=-2, axis2=-1)
    assert (variance >= 0).all()
    sigma = np.sqrt(np.where(variance > NOTHING, variance, 1.0))
    scaled = covs / sigma[..., :, None] / sigma[..., None, :]
    np.testing.assert_array_equal(covs, covs.swapaxes(-1, -2))
    assert np.linalg.eigvalsh(scaled).min(initial=0.0) > -MOST


def assert_laws(probs, n_chains, rows):
    assert np.abs(probs.sum(tuple(range(probs.ndim - n_chains, probs.ndim))) - 1.0).max(initial=0.0) < 1e-12
    assert probs.min(initial=0.0) >= 0.0 and len(probs) == rows


def assert_sound(left, est, n_chains):
    if est is None:
        return
    assert_laws(est.probs, n_chains, len(left))
    assert np.isfinite(est.mean).all() and np.isfinite(est.log_likelihood).all()
    assert_covariances(est.cov)
    if est.mode_covs is not None:
        assert_covariances(est.mode_covs)


@pytest.mark.parametrize("backend", BACKENDS)
@some
@given(p=hostile_problems())
def test_the_multimode_filter(p, backend):
    left, est = sound(lambda q: imm_filter(**q, backend=backend, per_mode=True), p)
    assert_sound(left, est, len(p["trans"]))


@pytest.mark.parametrize("rule", [None, GPB2])
@few
@given(p=hostile_problems(most_states=4, most_steps=3, chains=((), (2,), (2, 2))))
def test_the_exact_filter(p, rule):
    given = {} if rule is None else {"rule": rule}
    left, est = sound(lambda q: exact_filter(**q, **given), p)
    assert_sound(left, est, len(p["trans"]))


@pytest.mark.parametrize("backend", BACKENDS)
@few
@given(p=hostile_problems(most_states=4, most_steps=3, chains=((2,), (3,))))
def test_particles(p, backend):
    def run(q):
        return particle_filter(**q, n_particles=16, groups=2, rng=np.random.default_rng(0), backend=backend)

    left, est = sound(run, p)
    assert_sound(left, est, len(p["trans"]))


def scales(p):
    """Per row and mode what deviations are measured in, the terms of the mean, and the worst growth of rounding.

    In units of the predicted standard deviation and of what a measurement has moved the mean so far. Rounding of P
    grows by the condition of S and, where a measured variance is the small difference of large ones, by their ratio.
    """
    a, C = align(**p, b=None, d=None), len(p["trans"])
    lead, n = (len(a.z), *a.sizes), a.cov0.shape[-1]
    belief = Belief(
        np.broadcast_to(a.log_probs0, lead),
        np.broadcast_to(a.mean0, (*lead, n)),
        np.broadcast_to(a.cov0, (*lead, n, n)),
    )
    units, terms, growth, moved = [], [], np.ones(len(a.z)), np.zeros((*lead, n))
    for k in range(a.z.shape[1]):
        log_probs, means, covs = steps.mix(*belief, [None if t is None else t[:, 0] for t in a.trans])
        terms.append((np.abs(a.F[:, 0]) @ np.abs(means)[..., None])[..., 0])
        means, covs = steps.propagate(means, covs, a.F[:, 0], None, a.Q[:, 0])
        sigma = np.sqrt(np.diagonal(covs, axis1=-2, axis2=-1))
        prediction = steps.measure(means, covs, a.H[:, 0], None, a.R[:, 0])
        z, seen = a.z[:, k].reshape(len(a.z), *(1,) * C, -1), a.seen[:, k].reshape(len(a.z), *(1,) * C, -1)
        done = steps.condition(prediction, z, seen)
        moved = np.maximum(moved, np.abs(done.mean - means))
        units.append(sigma + moved)
        S = prediction.S
        at_most = np.square((np.abs(a.H[:, 0]) @ sigma[..., None])[..., 0])
        noise = np.diagonal(a.R[:, 0], axis1=-2, axis2=-1)
        worst = np.maximum(np.linalg.cond(S), (at_most / noise).max(-1)).reshape(len(a.z), -1).max(-1)
        growth = np.maximum(growth, worst)
        belief = Belief(steps.reweigh(log_probs, done.loglik, C)[0], done.mean, done.cov)
    return np.stack(units, axis=1), np.maximum.accumulate(np.stack(terms, axis=1), axis=1), growth


@pytest.mark.skipif(len(BACKENDS) == 1, reason="the kernel was not built")
@some
@given(p=hostile_problems(most_states=6, chains=((), (2,), (3,)), farthest=3.0, noisy=True))
def test_the_backends_agree_as_far_as_rounding_allows(p):
    (left, numpy), (others, native) = (
        sound(lambda q, b=b: imm_filter(**q, backend=b, per_mode=True), p) for b in BACKENDS
    )
    assert left.tolist() == others.tolist()  # they refuse the same
    if numpy is None:
        return
    unit, terms, growth = scales(of_runs(p, left))
    bound = (1e-10 + 1e3 * EPS * growth).reshape(-1, *(1,) * (unit.ndim - 1))
    apart = np.abs(native.mode_means - numpy.mode_means)
    assert (apart <= bound * unit + 64 * EPS * terms).all()
    outer = unit[..., :, None] * unit[..., None, :]
    apart = np.abs(native.mode_covs - numpy.mode_covs)
    assert (apart <= bound[..., None] * outer).all()


@pytest.mark.parametrize("backend", BACKENDS)
@some
@given(p=hostile_problems(most_steps=3, farthest=150.0))
def test_a_bank_as_the_tracker_uses_it(p, backend):
    """Prediction, score, a gate, update of what is in it, mixtures of hypotheses."""
    C, k = len(p["trans"]), len(p["z"])
    bank = Bank(p["cov0"].shape[-1], tuple(len(t) for t in p["trans"]), backend=backend)
    lead = (k, *bank.sizes)
    probs = np.broadcast_to(np.log(p["probs0"]), lead)
    n = bank.n
    rows = bank.add(Belief(probs, np.broadcast_to(p["mean0"], (*lead, n)), np.broadcast_to(p["cov0"], (*lead, n, n))))
    F, Q, H, R = (p[name][:, 0] for name in "FQHR")
    left = np.arange(k)
    for t in range(p["z"].shape[1]):
        bank.step(rows[left], p["trans"], F[left], None, Q[left])
        left, log_f = scored(bank, rows, left, p["z"][:, t], H, R)
        left = left[np.isfinite(log_f)]  # what lies too far away is in no gate
        if not len(left):
            return
        both = np.repeat(left, 2)  # seen, and missed
        copies = bank.take(rows[both])
        copies.update(np.arange(0, len(both), 2), p["z"][left, t], H[left], None, R[left])
        weights = np.stack([log_f[np.isfinite(log_f)] + np.log(0.9), np.full(len(left), np.log(0.1))], axis=1).ravel()
        bank.merge(rows[left], copies, np.arange(0, len(both) + 1, 2), weights)
        belief = bank.read(rows[left])
        assert_laws(np.exp(belief.log_probs), C, len(left))
        assert np.isfinite(belief.means).all()
        assert_covariances(belief.covs)


def scored(bank, rows, left, z, H, R):
    """log f of the rows whose measurement has one; the others are refused by number."""
    while True:
        try:
            return left, bank.score(rows[left], z[left], H[left], None, R[left])[1] if len(left) else np.zeros(0)
        except NumericalError as error:
            assert error.runs is not None and error.runs.any() and "run" in str(error)
            left = left[~error.runs]


DIFFUSIONS = {
    "moments": lambda *given: MomentFilter(closure="gaussian").run(*given),
    "maximum entropy": lambda *given: MomentFilter(closure="maxent").run(*given),
    "bootstrap": lambda *given: ParticleFilter(64, groups=2).run(*given, np.random.default_rng(0)),
    "grid": lambda model, sensor, z, times: GridFilter(
        64, ([-8.0 * np.sqrt(model.cov0[0, 0])], [8.0 * np.sqrt(model.cov0[0, 0])])
    ).run(model, sensor, z, times),
}


@pytest.mark.parametrize("name", DIFFUSIONS)
@few
@given(rng=rngs(), decades=st.sampled_from([1.0, 4.0, 8.0]), far=st.sampled_from([0.0, 3.0, 16.0, 150.0, 300.0]))
def test_filters_of_diffusions(name, rng, decades, far):
    """One state, two modes, prior and noise of any scale and ratio."""
    scale = 10.0 ** rng.uniform(-3, 3)
    R = scale**2 * 10.0 ** (2 * rng.uniform(-decades, decades, size=2))
    model = SwitchingSDE(
        drift=[lambda x: -x, lambda x: -2 * x],
        diffusion=[scale * np.eye(1), 10.0 ** rng.uniform(-decades, 0) * scale * np.eye(1)],
        intensity={(0, 1): 0.1, (1, 0): 0.2},
        probs0=[0.5, 0.5],
        mean0=[0.0],
        cov0=[[scale**2]],
    )
    sensor = DiffusionSensor(h=[lambda x: x] * 2, R=[np.array([[r]]) for r in R])
    z = scale * rng.normal(size=(3, 3, 1))
    z[rng.random(z.shape) < 0.2] *= 10.0 ** rng.uniform(0, far)
    z[rng.random(z.shape) < 0.1] = np.nan
    try:
        est = DIFFUSIONS[name](model, sensor, z, [1.0, 2.0, 3.0])
    except (DataError, NumericalError) as error:
        assert "run" in str(error) and "row" in str(error), str(error)
        return
    assert_laws(est.probs, 1, 3)
    assert np.isfinite(est.mean).all() and np.isfinite(est.cov).all() and (est.cov[..., 0, 0] >= 0).all()


def test_the_strategy_reaches_what_it_says(rng):
    """Ratios of variances over 32 decades, singular covariances, components without noise, outliers to overflow."""
    p = hostile_problem(rng, 500, (2,), 4, 5, 3, 8.0, 300.0)
    cov0, R = p["cov0"][:, 0], p["R"][:, 0, 0]
    ratio = np.trace(p["H"][:, 0, 0] @ cov0 @ p["H"][:, 0, 0].swapaxes(-1, -2), axis1=-2, axis2=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        decades = np.log10(ratio / R[:, 0, 0])
    decades = decades[np.isfinite(decades)]
    assert decades.min() < -14 and decades.max() > 14
    assert (np.linalg.matrix_rank(cov0) < 4).any() and (R[:, 0, 0] == 0).any() and (cov0 == 0).all((-1, -2)).any()
    assert np.nanmax(np.abs(p["z"])) > 1e200
