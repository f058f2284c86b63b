"""Acceleration that lasts a stated time: the same growth of the covariance however often a track is seen."""

import numpy as np
import pytest

from saltus.errors import ModelError
from saltus.tracks.channel import Start
from saltus.tracks.kinematics import Kinematics, make_kinematics
from saltus.tracks.settings import FilterSettings

ACCEL = {"accel_h": (0.3,), "sojourn_h": (50.0,), "accel_v": (0.1,), "sojourn_v": (50.0,)}
LASTS = 2.0


def grown(settings: FilterSettings, steps: int) -> np.ndarray:
    """Covariance, from a state known exactly, after four seconds in equal steps."""
    kinematics: Kinematics = make_kinematics(settings)
    rows = kinematics.add(Start(np.zeros((1, 6)), np.zeros((1, 6, 6))))
    for _ in range(steps):
        kinematics.put(rows, kinematics.predicted(rows, np.array([4.0 / steps])), np.array([0]))
    return kinematics.moments(rows).cov[0]


@pytest.mark.parametrize("form", ["decomposed", "joint"])
def test_the_growth_is_that_of_white_acceleration_in_any_steps(form):
    settings = FilterSettings(form=form, accel_time=LASTS, **ACCEL)
    shape = np.array([[4.0**3 / 3, 4.0**2 / 2], [4.0**2 / 2, 4.0]]) * LASTS
    expected = np.kron(np.diag([0.09, 0.09, 0.01]), shape)
    for steps in (1, 2, 7, 40):
        np.testing.assert_allclose(grown(settings, steps), expected, rtol=1e-9, atol=1e-12)


def test_without_it_a_track_seen_more_often_is_stiffer():
    settings = FilterSettings(accel_time=0.0, **ACCEL)
    speed = [grown(settings, steps)[1, 1] for steps in (2, 20)]
    assert speed == pytest.approx([2 * (0.3 * 2.0) ** 2, 20 * (0.3 * 0.2) ** 2])
    lasting = grown(FilterSettings(accel_time=LASTS, **ACCEL), 20)[1, 1]
    assert lasting == pytest.approx(speed[0])  # alike at the interval that the acceleration lasts


@pytest.mark.parametrize("value", [-1.0, np.inf, np.nan])
def test_a_time_that_cannot_be(value):
    with pytest.raises(ModelError, match=r"filter\.accel_time"):
        FilterSettings(accel_time=value)
