"""A chain without memory: keeping its modes and merging them give the same filter."""

import numpy as np
import pytest

from oracles import error
from saltus.filters import imm_filter, steps
from saltus.filters.memoryless import merge
from strategies import law, random_cov, random_trans


def run(problem, trans, merged):
    """The recursion by hand, one object; `merged` is the position of the axis merged after each update."""
    n_chains = len(trans)
    lead = (1,) * n_chains
    belief = steps.Belief(
        np.log(problem["probs0"]),
        np.broadcast_to(problem["mean0"], (*problem["probs0"].shape, 3)),
        np.broadcast_to(problem["cov0"], (*problem["probs0"].shape, 3, 3)),
    )
    rows = []
    for z in problem["z"]:
        step = list(trans)
        if merged is not None:
            belief = merge(belief, merged, n_chains)
            assert belief.log_probs.shape[merged] == 1
            step[merged] = trans[merged][:1]
        log_probs, means, covs = steps.mix(*belief, step)
        means, covs = steps.propagate(means, covs, problem["F"], None, problem["Q"])
        seen = np.isfinite(z)
        done = steps.condition(
            steps.measure(means, covs, problem["H"], None, problem["R"]),
            np.where(seen, z, 0.0).reshape(*lead, -1),
            seen.reshape(*lead, -1),
        )
        log_probs, log_f = steps.reweigh(log_probs, done.loglik, n_chains)
        belief = steps.Belief(log_probs, done.mean, done.cov)
        mean, cov = steps.collapse(*belief, n_chains)
        rows.append((np.exp(log_probs), mean, cov, log_f))
    return [np.array(a) for a in zip(*rows, strict=True)]


@pytest.fixture
def problem(rng):
    z = 3 * rng.normal(size=(8, 2))
    z[3, 0] = z[5] = np.nan
    return {
        "z": z,
        "F": np.eye(3) + 0.2 * rng.normal(size=(2, 1, 1, 3, 3)),
        "Q": random_cov(rng, (2, 1, 1), 3),
        "H": rng.normal(size=(1, 1, 2, 2, 3)),
        "R": random_cov(rng, (1, 3, 1), 2),
        "mean0": rng.normal(size=3),
        "cov0": random_cov(rng, (), 3),
        "probs0": law(rng, (), 12).reshape(2, 3, 2),
    }


def chains(rng):
    return [random_trans(rng, 2), np.tile(law(rng, (), 3), (3, 1)), random_trans(rng, 2)]


def test_keeping_and_merging_agree_at_every_row(problem, rng):
    trans = chains(rng)
    kept, merged = run(problem, trans, None), run(problem, trans, 1)
    for a, b in zip(kept, merged, strict=True):
        assert error(b, a) < 1e-11
    est = imm_filter(**problem, trans=trans)
    assert error(merged[0], est.probs) < 1e-9 and error(merged[1], est.mean) < 1e-9


def test_a_chain_with_memory_is_not_the_same_merged(problem, rng):
    trans = chains(rng)
    trans[1] = random_trans(rng, 3)
    assert error(run(problem, trans, 1)[0], run(problem, trans, None)[0]) > 1e-3
