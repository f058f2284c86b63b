"""How the compiled twins are held against their definitions."""

import numpy as np

from saltus.filters import Belief, steps
from saltus.filters.align import align

__all__ = ["EPS", "assert_covariances", "assert_same", "predictions"]

EPS = np.finfo(float).eps


def predictions(p):
    """Per mode and row: standard deviations of the predicted state, and the worst condition number of S."""
    a = align(**p)
    batch, n_chains = a.z.shape[:-2], len(a.trans)
    lead, n, m = (*batch, *a.sizes), a.cov0.shape[-1], a.z.shape[-1]
    belief = Belief(
        np.broadcast_to(a.log_probs0, lead),
        np.broadcast_to(a.mean0, (*lead, n)),
        np.broadcast_to(a.cov0, (*lead, n, n)),
    )
    sigmas, condition = [], 1.0
    for k in range(a.z.shape[-2]):

        def at(x, k=k):
            return None if x is None else np.take(x, k if x.shape[len(batch)] > 1 else 0, axis=len(batch))

        log_probs, means, covs = steps.mix(*belief, [at(t) for t in a.trans])
        means, covs = steps.propagate(means, covs, at(a.F), at(a.b), at(a.Q))
        sigmas.append(np.sqrt(np.broadcast_to(np.diagonal(covs, axis1=-2, axis2=-1), (*lead, n))))
        prediction = steps.measure(means, covs, at(a.H), at(a.d), at(a.R))
        condition = max(condition, np.linalg.cond(prediction.S).max(initial=1.0))
        per_mode = (*batch, *(1 for _ in range(n_chains)), m)
        done = steps.condition(prediction, at(a.z).reshape(per_mode), at(a.seen).reshape(per_mode))
        belief = Belief(steps.reweigh(log_probs, done.loglik, n_chains)[0], done.mean, done.cov)
    return np.stack(sigmas, axis=len(batch)), condition


def assert_same(actual, expected, sigma, bound):
    """Deviations of estimates with all modes within `bound`, in units of the standard deviations `sigma` per mode."""
    for name in ("probs", "mean", "cov", "log_likelihood", "nis", "n_observed", "mode_means", "mode_covs"):
        assert getattr(actual, name).shape == getattr(expected, name).shape, name
    assert np.abs((actual.mode_means - expected.mode_means) / sigma).max(initial=0.0) < bound
    outer = sigma[..., :, None] * sigma[..., None, :]
    assert np.abs((actual.mode_covs - expected.mode_covs) / outer).max(initial=0.0) < bound
    modes = tuple(range(expected.mean.ndim - 1, sigma.ndim - 1))
    top = np.sqrt(np.diagonal(expected.cov, axis1=-2, axis2=-1)) + sigma.max(axis=modes)
    assert np.abs((actual.mean - expected.mean) / top).max(initial=0.0) < bound
    assert np.abs((actual.cov - expected.cov) / (top[..., :, None] * top[..., None, :])).max(initial=0.0) < bound
    np.testing.assert_allclose(actual.probs, expected.probs, rtol=0.0, atol=bound)
    np.testing.assert_allclose(actual.log_likelihood, expected.log_likelihood, rtol=bound, atol=bound)
    np.testing.assert_allclose(actual.nis, expected.nis, rtol=bound, atol=bound)
    np.testing.assert_array_equal(actual.n_observed, expected.n_observed)


def assert_covariances(covs):
    """Symmetric, and positive semidefinite to round-off once scaled to unit diagonal."""
    np.testing.assert_array_equal(covs, covs.swapaxes(-1, -2))
    sigma = np.sqrt(np.diagonal(covs, axis1=-2, axis2=-1))
    assert np.isfinite(sigma).all() and (sigma > 0).all()
    scaled = covs / (sigma[..., :, None] * sigma[..., None, :])
    assert np.linalg.eigvalsh(scaled).min(initial=1.0) > -20 * EPS
