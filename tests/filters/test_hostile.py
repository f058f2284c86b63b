"""What no filter can take is refused by our own errors, with the argument or the record named."""

import numpy as np
import pytest

from diffusions import unchecked
from saltus import IMM, Gaussian, HybridModel, PositionSensor, constant_velocity
from saltus.errors import DataError, ModelError, SaltusError
from saltus.filters import exact_filter, imm_filter, particle_filter
from saltus.filters.run import in_order
from saltus.models import PolarSensor

NONE_OF_THEM = [
    None, "x", [], [[]], [1, [2, 3]], [[1, 2], [3]], np.nan, np.inf, -1.0, np.zeros((2, 3)), np.zeros((0, 0)),
    {}, [None], ["a", "b"], np.array([1 + 2j]), True, np.ones((2, 2, 2, 2, 2, 2)),
]  # fmt: skip
ARRAYS = dict(
    F=np.eye(2)[None], Q=np.eye(2)[None], H=np.eye(1, 2)[None], R=np.array([[[1.0]], [[4.0]]]),
    trans=[np.array([[0.9, 0.1], [0.2, 0.8]])], mean0=[0.0, 0.0], cov0=np.eye(2), probs0=[0.5, 0.5],
)  # fmt: skip


def drawn(z, **arrays):
    return particle_filter(z, n_particles=20, groups=2, rng=np.random.default_rng(0), **arrays)


def refused_or_taken(call):
    try:
        with unchecked():
            call()
    except SaltusError as error:
        assert len(str(error)) > 10


@pytest.mark.parametrize("run", [imm_filter, exact_filter, drawn])
@pytest.mark.parametrize("name", [*ARRAYS, "z", "b", "d"])
def test_arrays(run, name):
    for value in NONE_OF_THEM:
        given = {"z": np.zeros((3, 1))} | ARRAYS | {name: value}
        refused_or_taken(lambda given=given: run(**given))
    if name == "trans":
        for value in NONE_OF_THEM:
            refused_or_taken(lambda value=value: run(np.zeros((3, 1)), **(ARRAYS | {"trans": [value]})))


LINEAR = HybridModel([], constant_velocity(1, 1.0), {"s": PositionSensor(1, 1.0)}, Gaussian([0.0, 0.0], np.eye(2)))
CURVED = HybridModel(
    [], constant_velocity(2, 1.0), {"s": PolarSensor(sigma_range=1.0)}, Gaussian([9.0, 0, 9, 0], np.eye(4))
)


@pytest.mark.parametrize("model", [LINEAR, CURVED])
def test_records(model):
    for value in NONE_OF_THEM:
        for records in (value, [value], [(value, "s", [1.0])], [(0.0, value, [1.0])], [(0.0, "s", value)]):
            refused_or_taken(lambda records=records: IMM(model).run(records))


@pytest.mark.parametrize(
    "records, message",
    [
        ([(0.0, "s", [1.0]), (1.0, "s", [1, [2, 3]])], "record 1: a time in seconds and an array of numbers"),
        ([(0.0, 3, [1.0])], "record 0: the sensor is given by its name, got 3"),
        ([(0.0, "s")], r"records are \(time, sensor, values\) each"),
    ],
)
def test_a_bad_record_is_named(records, message):
    with unchecked(), pytest.raises(DataError, match=message):
        in_order(records)


def test_modes_of_different_size_say_how_to_embed_the_smaller():
    with unchecked(), pytest.raises(ModelError, match="All modes have one state vector"):
        imm_filter(np.zeros((3, 1)), **(ARRAYS | {"F": [np.eye(2), np.eye(3)]}))
