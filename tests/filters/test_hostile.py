"""What no filter can take is refused by our own errors, with the argument or the record named."""

import numpy as np
import pytest

from diffusions import unchecked
from saltus import IMM, Chain, Gaussian, HybridModel, PositionSensor, constant_velocity
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


CHAIN = {"name": "a", "states": {"x": 1.0, "y": 2.0}, "stay": 0.9, "per": 1.0}


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"states": None}, "chain 'a' needs states: a mapping label -> value or a list of labels; got None"),
        ({"states": 3}, "needs states"),
        ({"stay": None, "per": None, "sojourn": 5.0}, "sojourn gives each state its own.*got 5.0"),
        ({"stay": np.array([0.9, 0.8])}, r"stay is one probability, or one for each label.*shape \(2,\)"),
    ],
)
def test_chains(wrong, message):
    with unchecked(), pytest.raises(ModelError, match=message):
        Chain(**{**CHAIN, **wrong})


@pytest.mark.parametrize(
    "wrong", [{"dims": np.array([2, 3])}, {"axes": 1}, {"axes": [[0, 1]]}, {"axes": "ab"}, {"axes": [0.5, 1.5]}]
)
def test_axes_of_a_polar_sensor(wrong):
    with unchecked(), pytest.raises(ModelError, match=r"PolarSensor (dims|axes) must be"):
        PolarSensor(sigma_range=1.0, **wrong)


@pytest.mark.parametrize("dt", [1e160, 1e300])
def test_intervals_that_overflow(dt):
    model = constant_velocity(dims=2, accel=1.0)
    with pytest.raises(ModelError, match=r"overflows double precision\. dt is in seconds"):
        model.step(np.array([dt]))


@pytest.mark.parametrize("seed", range(20))
def test_only_our_own_errors_leave_the_constructors(seed):
    rng = np.random.default_rng(seed)
    odd = [*NONE_OF_THEM, 3, "ab", 1e300, -1e300, np.datetime64("2024-01-01"), np.timedelta64(4, "s"), object(), b"x"]
    calls = {
        Chain: dict(CHAIN),
        PolarSensor: {"sigma_range": 1.0, "sigma_azimuth": 0.1, "dims": 2, "axes": (0, 2)},
        PositionSensor: {"dims": 2, "sigma": 1.0},
        Gaussian: {"mean": np.zeros(2), "cov": np.eye(2)},
        constant_velocity: {"dims": 2, "accel": 1.0},
    }
    for make, good in calls.items():
        for name in good:
            value = odd[rng.integers(len(odd))]
            refused_or_taken(lambda make=make, given={**good, name: value}: make(**given))
