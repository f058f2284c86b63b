"""The innovations tell a wrong noise from a right one."""

import numpy as np
import pytest

from saltus.io.asterix_write import write_cat048
from saltus.progress import Progress
from saltus.run import Options, write_tracks

SIGMA_RANGE, SIGMA_AZIMUTH = 60.0, 0.08  # m, degrees


def nis(folder, seed, factor):
    """Mean NIS of 40 aircraft flying straight for 40 scans, and the interval within which it fits."""
    rng = np.random.default_rng(seed)
    scans, n = 4.0 * np.arange(40), 40
    azimuth = np.radians(9.0 * np.arange(n) + 4.0)
    time = scans[:, None] + azimuth * 4.0 / (2.0 * np.pi)
    range_m = 40e3 + 2e3 * (np.arange(n) % 7) + 180.0 * scans[:, None] + rng.normal(0.0, SIGMA_RANGE, time.shape)
    azimuths = azimuth + rng.normal(0.0, np.radians(SIGMA_AZIMUTH), time.shape)
    order = np.argsort(time.ravel())
    write_cat048(
        folder / "radar.ast",
        sac=25,
        sic=1,
        time_of_day=36000.0 + time.ravel()[order],
        range_m=range_m.ravel()[order],
        azimuth_rad=azimuths.ravel()[order],
        altitude_m=np.full(time.size, 9144.0),
    )
    (folder / "a.toml").write_text(
        "date = 2025-06-01\n[[sensor]]\nsac = 25\nsic = 1\nlatitude = 48.0\nlongitude = 11.0\nheight = 500.0\n"
        f"period = 4.0\nsigma_range = {factor * SIGMA_RANGE}\nsigma_azimuth = {factor * SIGMA_AZIMUTH}\n"
    )
    (row,) = write_tracks([folder / "radar.ast"], folder, Progress(), Options(folder / "a.toml", report=False))[0][
        "noise"
    ].values()
    assert row["nis_updates"] > 1400
    return row["nis_mean"], *row["nis_interval"]


@pytest.mark.parametrize("seed", [0, 1])
def test_the_right_noise_fits(tmp_path, seed):
    mean, low, high = nis(tmp_path, seed, 1.0)
    assert low < mean < high


def test_noise_that_is_wrong_by_half_does_not(tmp_path):
    mean, low, _ = nis(tmp_path, 0, 1.5)
    assert mean < low
    mean, _, high = nis(tmp_path, 0, 1 / 1.5)
    assert mean > high
