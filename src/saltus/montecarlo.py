"""Monte-Carlo runs: seeded, vectorised over runs, the same numbers whatever the block size."""

from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np

from saltus.errors import ModelError
from saltus.shapes import Shaped

__all__ = ["run"]

# A NamedTuple of arrays; `typing.NamedTuple` itself is a function, which no bound can name.
Trial = TypeVar("Trial", bound=tuple[Shaped[np.ndarray, "..."], ...])


def run(
    trial: Callable[[Sequence[np.random.Generator]], Trial],
    n_runs: int,
    seed: int,
    *,
    batch: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Trial:
    """Repeat an experiment `n_runs` times and stack the results.

    Run i draws only from the generator spawned i-th from `seed`, so the results depend neither on `batch` nor
    on how many runs follow. An interruption (Ctrl-C) passes through: results are returned whole or not at
    all.

    Args:
        trial: does as many runs as it is given generators, vectorised over them: a function of a sequence of
            B generators that returns a NamedTuple of arrays, each with leading axis B.
        n_runs: number of runs, >= 1.
        seed: root of the runs' generators, >= 0.
        batch: runs done at once (bounds the memory); None means all.
        progress: called after each block with the number of runs done and `n_runs`.

    Returns:
        The same NamedTuple type, every array with leading axis `n_runs`.

    Raises:
        ModelError: `n_runs`, `seed` or `batch` out of range, or a result without the leading axis.
    """
    if n_runs < 1 or seed < 0 or (batch is not None and batch < 1):
        raise ModelError(f"need n_runs >= 1, seed >= 0, batch >= 1: {n_runs}, {seed}, {batch}")
    size = n_runs if batch is None else batch
    root = np.random.SeedSequence(seed)
    blocks: list[Trial] = []
    for done in range(0, n_runs, size):
        rngs = [np.random.default_rng(s) for s in root.spawn(min(size, n_runs - done))]
        blocks.append(_checked(trial(rngs), len(rngs)))
        if progress is not None:
            progress(done + len(rngs), n_runs)
    stacked = [np.concatenate(arrays) for arrays in zip(*blocks, strict=True)]
    return type(blocks[0])(*stacked)  # a NamedTuple takes its fields one by one


def _checked(block: Trial, n: int) -> Trial:
    names: tuple[str, ...] = block._fields  # type: ignore[attr-defined]  # a NamedTuple has them
    for name, array in zip(names, block, strict=True):
        if np.ndim(array) == 0 or len(array) != n:
            raise ModelError(
                f"trial result {name!r} has shape {np.shape(array)}: axis 0 must hold the {n} runs asked for"
            )
    return block
