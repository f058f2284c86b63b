"""The Monte-Carlo runner: block size changes nothing, seeds change everything, Ctrl-C passes through."""

from typing import NamedTuple

import numpy as np
import pytest

from saltus.errors import ModelError
from saltus.montecarlo import run


class Drawn(NamedTuple):
    normal: np.ndarray
    uniform: np.ndarray


def draw(rngs):
    return Drawn(np.stack([r.normal(size=(4, 2)) for r in rngs]), np.array([r.random() for r in rngs]))


def test_results_do_not_depend_on_the_block_size_or_on_later_runs():
    whole = run(draw, 7, 42)
    assert isinstance(whole, Drawn) and whole.normal.shape == (7, 4, 2) and whole.uniform.shape == (7,)
    for batch in (1, 3, 7, 100):
        for a, b in zip(run(draw, 7, 42, batch=batch), whole, strict=True):
            np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(run(draw, 3, 42).normal, whole.normal[:3])


def test_runs_are_independent_draws_and_seeds_differ():
    # 1000 runs of 8 normals: off-diagonal correlations between values have standard error 1/sqrt(1000).
    x = run(draw, 1000, 1).normal.reshape(1000, 8)
    assert np.abs(np.corrcoef(x.T) - np.eye(8)).max() < 5 / np.sqrt(1000)
    assert len(np.unique(x)) == x.size
    assert not np.any(np.isin(run(draw, 10, 2).normal, x))


def test_progress_counts_every_run_once():
    seen = []
    run(draw, 7, 0, batch=3, progress=lambda done, total: seen.append((done, total)))
    assert seen == [(3, 7), (6, 7), (7, 7)]


def test_an_interruption_passes_through():
    def interrupted(done, total):
        if done == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(draw, 6, 0, batch=2, progress=interrupted)


@pytest.mark.parametrize(("n_runs", "seed", "batch"), [(0, 0, None), (1, -1, None), (1, 0, 0)])
def test_numbers_out_of_range_are_refused(n_runs, seed, batch):
    with pytest.raises(ModelError, match="n_runs >= 1"):
        run(draw, n_runs, seed, batch=batch)


def test_a_result_without_the_run_axis_is_refused():
    with pytest.raises(ModelError, match="'uniform' has shape"):
        run(lambda rngs: Drawn(np.zeros((len(rngs), 1)), np.zeros(5)), 3, 0)
