"""Readers under mutated inputs, seeded, and every input that ever failed. `make fuzz` goes on for longer."""

import random

import pytest
from fuzzing import check, corpus, mutated
from targets import targets

TARGETS = targets()
INPUTS = 20  # of each target


@pytest.fixture(scope="module", autouse=True)
def loaded(tmp_path_factory):
    """Read something of every kind, so that no input is charged for what is loaded or compiled with the first."""
    for target in TARGETS.values():
        path = tmp_path_factory.mktemp("loaded") / f"input{target.suffix}"
        path.write_bytes(target.seeds[0])
        target.read(path)


@pytest.mark.parametrize("name", TARGETS)
def test_good_inputs_are_read(name, tmp_path):
    target = TARGETS[name]
    for seed in target.seeds:
        assert check(target, seed, tmp_path) == "read"


@pytest.mark.parametrize("name", TARGETS)
def test_mutated_inputs_are_read_or_refused_and_accounted_for(name, tmp_path):
    draw = random.Random(f"saltus {name}")
    for _ in range(INPUTS):
        check(TARGETS[name], mutated(draw, TARGETS[name])[0], tmp_path)


@pytest.mark.parametrize(("name", "content"), [pytest.param(n, c, id=f"{n}-{k}") for k, (n, c) in enumerate(corpus())])
def test_inputs_that_once_failed(name, content, tmp_path):
    check(TARGETS[name], content, tmp_path)
