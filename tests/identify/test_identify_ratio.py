"""The likelihood ratio against the density of all measurements at once, and against the reference cases."""

import numpy as np
import pytest
from hypothesis import given
from scipy.linalg import block_diag, expm
from scipy.stats import multivariate_normal

from oracles import error
from saltus import DataError, ModelError, NumericalError, discretise, identification_llr
from saltus.identify import identification_terms, posterior
from strategies import quick, random_cov, rngs

N, M = 3, 2


def problem(rng, n_rows=7, pairs=()):
    """Random motion, measurements of both systems, some components missing."""
    z = rng.normal(size=(*pairs, n_rows, M))
    z[rng.uniform(size=z.shape) < 0.15] = np.nan
    rows = (
        np.sort(rng.uniform(0.5, 6.0, size=(*pairs, n_rows)), axis=-1),
        rng.integers(2, size=(*pairs, n_rows)),
        z,
    )
    model = {
        "F": 0.4 * rng.normal(size=(N, N)),
        "G": rng.normal(size=(N, 2)),
        "H": rng.normal(size=(2, M, N)),
        "R": (random_cov(rng, (), M), random_cov(rng, (), M)),
        "t0": 0.3,
        "prior_same": (rng.normal(size=(*pairs, N)), random_cov(rng, pairs, N)),
        "prior_other": (rng.normal(size=(*pairs, N)), random_cov(rng, pairs, N)),
    }
    return rows, model


def log_density(times, z, H, R, F, G, t0, mean, cov):
    """Of all components at once: the motion written as one big Gaussian, no recursion over rows."""
    if not len(times):
        return 0.0
    at, x_mean, x_cov, t = np.eye(N), [], np.zeros((len(times) * N, len(times) * N)), t0
    noise = []  # (matrix that carries a disturbance to now, its covariance)
    carried = [(at, cov)]
    for i, now in enumerate(times):
        A, Q = expm(F * (now - t)), discretise(F, G, now - t)[1]
        carried = [(A @ c, P) for c, P in carried] + [(np.eye(N), Q)]
        noise.append(carried)
        x_mean.append(carried[0][0] @ mean)
        for j in range(i + 1):
            block = sum(carried[d][0] @ P @ noise[j][d][0].T for d, (_, P) in enumerate(noise[j]))
            x_cov[i * N : (i + 1) * N, j * N : (j + 1) * N] = block
            x_cov[j * N : (j + 1) * N, i * N : (i + 1) * N] = block.T
        t = now
    big = block_diag(*H)
    y, S, seen = big @ np.concatenate(x_mean), big @ x_cov @ big.T + block_diag(*R), ~np.isnan(z.ravel())
    if not seen.any():
        return 0.0
    return multivariate_normal.logpdf(z.ravel()[seen], y[seen], S[np.ix_(seen, seen)])


def dense_ratio(times, system, z, F, G, H, R, t0, prior_same, prior_other):
    """Log-density of all rows under one object less that under two."""
    rows = [np.ones(len(times), bool), system == 0, system == 1]
    values = [
        log_density(times[r], z[r], [H[s] for s in system[r]], [R[s] for s in system[r]], F, G, t0, *prior)
        for r, prior in zip(rows, (prior_same, prior_same, prior_other), strict=True)
    ]
    return values[0] - values[1] - values[2]


@quick
@given(rngs())
def test_every_row_is_the_ratio_of_two_joint_densities(rng):
    (times, system, z), model = problem(rng)
    after = [3, 7]
    expected = [dense_ratio(times[:k], system[:k], z[:k], **model) for k in after]
    found = identification_llr(times, system, z, **model)[np.array(after) - 1]
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("i", range(6))
def test_reference_case(cases, i):
    c = cases("identification_llr")
    got = identification_terms(
        c[f"t{i}"],
        c[f"sensor{i}"],
        c[f"Y{i}"],
        F=c["Fc"],
        G=c["Gc"],
        H=c["H"],
        R=(c["V_sensor0"], c["V_sensor1"]),
        t0=float(c["start_time"]),
        prior_same=(c["prior1_x"], c["prior1_P"]),
        prior_other=(c["prior0_x"], c["prior0_P"]),
    )
    names = ("exp_llr{}", "exp_q1_{}", "exp_q0_{}", "exp_logdet1_{}", "exp_logdet0_{}")
    for value, name in zip(got, names, strict=True):
        assert error(value, c[name.format(i)]) < 1e-8
    assert error(posterior(got.llr), c[f"exp_post{i}"]) < 1e-8


def test_many_pairs_at_once_are_each_pair_by_itself(rng):
    rows, model = problem(rng, pairs=(2, 3))
    together = identification_llr(*rows, **model)
    assert together.shape == (2, 3, 7)
    for pair in np.ndindex(2, 3):
        priors = {k: tuple(a[pair] for a in model[k]) for k in ("prior_same", "prior_other")}
        alone = identification_llr(*(a[pair] for a in rows), **model | priors)
        np.testing.assert_allclose(together[pair], alone, rtol=1e-10, atol=1e-10)


def test_rows_without_measurement_change_nothing(rng):
    (times, system, z), model = problem(rng)
    alone = identification_llr(times, system, z, **model)
    filled = [np.concatenate([a, np.repeat(a[-1:], 2, axis=0)]) for a in (times, system, z)]
    filled[2][-2:] = np.nan
    terms = identification_terms(*filled, **model)
    np.testing.assert_allclose(terms.llr, [*alone, alone[-1], alone[-1]], rtol=1e-12, atol=1e-12)
    assert not np.abs([values[-2:] for values in terms[1:]]).max()


def test_noise_that_changes_from_row_to_row(rng):
    (times, system, z), model = problem(rng)
    loud = random_cov(rng, (len(times),), M)
    got = identification_llr(times, system, z, **model | {"R": (loud, model["R"][1])})
    by_row = [R0 if s == 0 else model["R"][1] for R0, s in zip(loud, system, strict=True)]
    # Give the oracle a "system" for every row, so that it looks up that row's matrices.
    rows = [np.ones(len(times), bool), system == 0, system == 1]
    same, first, other = (
        log_density(
            times[r],
            z[r],
            [model["H"][s] for s in system[r]],
            [R for R, used in zip(by_row, r, strict=True) if used],
            model["F"],
            model["G"],
            model["t0"],
            *prior,
        )
        for r, prior in zip(rows, (model["prior_same"],) * 2 + (model["prior_other"],), strict=True)
    )
    assert got[-1] == pytest.approx(same - first - other, abs=1e-8)


def test_one_system_alone_says_nothing_if_it_is_the_first(rng):
    (times, _, z), model = problem(rng)
    assert not identification_llr(times, np.zeros(len(times), int), z, **model).any()
    assert np.abs(identification_llr(times, np.ones(len(times), int), z, **model)).max() > 0.01


def test_ratio_does_not_depend_on_the_axes_of_the_state(rng):
    rows, model = problem(rng)
    T = rng.normal(size=(N, N)) + 2 * np.eye(N)
    back = np.linalg.inv(T)
    turned = model | {
        "F": T @ model["F"] @ back,
        "G": T @ model["G"],
        "H": model["H"] @ back,
        **{k: (T @ model[k][0], T @ model[k][1] @ T.T) for k in ("prior_same", "prior_other")},
    }
    np.testing.assert_allclose(
        identification_llr(*rows, **turned), identification_llr(*rows, **model), rtol=1e-7, atol=1e-7
    )


def test_posterior_is_calibrated(rng):
    runs, K = 6000, 6
    F, H = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[1.0, 0.0]])
    G, cov = np.array([[0.0], [0.5]]), np.diag([25.0, 1.0])
    same, system = rng.uniform(size=runs) < 0.5, np.tile([0, 1], K // 2)
    A, Q = discretise(F, G, 1.0)
    x = rng.normal(size=(runs, 2, 2)) @ np.sqrt(cov)
    z = np.empty((runs, K, 1))
    for k in range(K):
        x = x @ A.T + rng.normal(size=x.shape) @ np.linalg.cholesky(Q).T
        seen = np.where(same | (system[k] == 0), x[:, 0, 0], x[:, 1, 0])
        z[:, k, 0] = seen + (1.0, 2.0)[system[k]] * rng.normal(size=runs)
    prior = (np.zeros(2), cov)
    llr = identification_llr(
        1.0 + np.arange(K), system, z, F=F, G=G, H=H, R=([[1.0]], [[4.0]]), t0=0.0, prior_same=prior, prior_other=prior
    )

    def worst(p):
        """Deviation of the share of one object from what the bins promise, in standard errors."""
        bins = np.digitize(p, [0.1, 0.3, 0.5, 0.7, 0.9])
        pull = [
            (same[bins == b] - p[bins == b]).sum() / np.sqrt((p * (1 - p))[bins == b].sum())
            for b in range(6)
            if (bins == b).sum() > 50
        ]
        return np.abs(pull).max()

    assert worst(posterior(llr[:, -1])) < 4.0
    assert worst(posterior(1.5 * llr[:, -1])) > 6.0  # over-confident: would be found


def call(rng, **changes):
    (times, system, z), model = problem(rng)
    arguments = {"times": times, "system": system, "z": z, **model} | changes
    return identification_llr(**arguments)


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"times": [1.0, 2.0, 3.0, 2.5, 4.0, 5.0, 6.0]}, r"times\[3\] = 2.5 s comes before 3 s"),
        ({"t0": 100.0}, r"times\[0\] = .* comes before t0 = 100"),
        ({"times": [1.0, np.nan, 3.0, 4.0, 4.0, 5.0, 6.0]}, "must be finite"),
        ({"system": [0, 1, 2, 0, 1, 0, 1]}, r"system\[2\] is 2"),
        ({"z": np.full((7, M), np.inf)}, "infinite"),
        ({"z": np.zeros(7)}, "at least 1"),
    ],
)
def test_data_that_cannot_be_are_refused(rng, changes, what):
    with pytest.raises(DataError, match=what):
        call(rng, **changes)


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"times": np.arange(1.0, 5.0)}, "times has shape"),
        ({"H": np.zeros((M + 1, N))}, "H has shape"),
        ({"R": (np.eye(M),)}, "two covariances"),
        ({"R": (np.eye(M), -np.eye(M))}, "positive semi-definite"),
        ({"R": (np.eye(M), np.eye(M + 1))}, r"R\[1\] has shape"),
        ({"prior_other": (np.zeros(N), np.diag([1.0, 1.0, np.inf]))}, "covariance of prior_other holds inf"),
        ({"prior_same": (np.zeros(N + 1), np.eye(N))}, "mean of prior_same"),
        ({"prior_same": (np.zeros(N),)}, r"must be \(mean, cov\)"),
        ({"F": np.zeros((N + 1, N + 1))}, "G must have shape"),
    ],
)
def test_models_that_cannot_be_are_refused(rng, changes, what):
    with pytest.raises(ModelError, match=what):
        call(rng, **changes)


def test_no_noise_and_no_uncertainty_is_an_error(rng):
    sure = (np.zeros(N), np.zeros((N, N)))
    with pytest.raises(NumericalError, match="innovation covariance"):
        call(rng, R=(np.zeros((M, M)),) * 2, G=np.zeros((N, 1)), prior_same=sure, prior_other=sure)
