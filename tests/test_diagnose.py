"""Noise diagnosis: its likelihood against dense Gaussians, what it recovers, and the command."""

import json

import numpy as np
import pyarrow as pa
import pytest
from click.testing import CliRunner
from scipy.stats import multivariate_normal

from saltus.cli import main
from saltus.diagnose import fit_noise
from saltus.diagnose.figure import autocovariance
from saltus.diagnose.likelihood import log_likelihood, pack, sums
from saltus.errors import DataError


def draw(rng, tau, sigma, white, n=300, n_series=6, bias=2.0):
    """First-order noise plus white noise at irregular times: times, values, labels."""
    t = np.cumsum(rng.exponential(1.0, (n_series, n)) + 0.1, axis=1)
    phi = np.exp(-np.diff(t, axis=1) / tau)
    w = np.empty((n_series, n))
    w[:, 0] = rng.normal(size=n_series)
    for k in range(1, n):
        w[:, k] = phi[:, k - 1] * w[:, k - 1] + np.sqrt(1 - phi[:, k - 1] ** 2) * rng.normal(size=n_series)
    r = bias + sigma * w + white * rng.normal(size=w.shape)
    return t.ravel(), r.ravel(), np.repeat(np.arange(n_series), n)


def test_likelihood_of_residuals_is_the_dense_gaussian_one(rng):
    t, r, label = draw(rng, 3.0, 2.0, 0.7, n=9, n_series=3)
    keep = np.arange(27) != 20  # series of unequal length
    data = pack(t[keep], r[keep], label[keep])
    theta = np.array([[3.0, 4.0, 0.5], [0.5, 1.0, 2.0]])
    found = sums(data, theta)
    for i, (tau, var, white) in enumerate(theta):
        S = np.where(
            label[keep][:, None] == label[keep], var * np.exp(-np.abs(t[keep][:, None] - t[keep]) / tau), 0.0
        ) + white * np.eye(26)
        one = np.linalg.solve(S, np.ones(26))
        bias = one @ r[keep] / one.sum()  # generalised least squares
        assert found.bias[i] == pytest.approx(bias, rel=1e-10)
        want = multivariate_normal.logpdf(r[keep], np.full(26, bias), S)
        assert log_likelihood(found)[i] == pytest.approx(want, rel=1e-10)


def test_likelihood_of_positions_is_the_dense_gaussian_one(rng):
    n, tau, var, white, q = 8, 4.0, 2.0, 0.5, 0.3
    t = np.cumsum(rng.uniform(0.3, 2.0, n))
    s = t - t[0]
    low = np.minimum(s[:, None], s)
    motion = q * (low**2 / 2 * np.maximum(s[:, None], s) - low**3 / 6)  # white acceleration integrated twice
    start = 1e6 * (var + white) * s[:, None] * s  # velocity nearly unknown
    S = motion + start + var * np.exp(-np.abs(t[:, None] - t) / tau) + white * np.eye(n)
    z = np.cumsum(rng.normal(size=n))
    D = np.eye(n)[1:] - np.eye(n)[0]  # differences from the first sample know nothing of a position quite unknown
    y, Sy = D @ z, D @ S @ D.T
    want = multivariate_normal.logpdf(y, cov=Sy) - multivariate_normal.logpdf(y[:2], cov=Sy[:2, :2])
    found = log_likelihood(sums(pack(t, z, np.zeros(n)), [[tau, var, white, q]]))[0]
    assert found == pytest.approx(want, abs=1e-6)


@pytest.mark.parametrize(("tau", "sigma", "white"), [(20.0, 3.0, 1.0), (5.0, 2.0, 0.0), (2.0, 1.0, 1.0)])
def test_parameters_are_recovered_within_their_intervals(rng, tau, sigma, white):
    fit = fit_noise(*draw(rng, tau, sigma, white))
    assert fit.verdict == "coloured"
    for p, truth in ((fit.tau, tau), (fit.sigma, sigma), (fit.white, white)):
        if truth > 0:
            half = np.log(p.high / p.low) / 2 / 1.96  # one standard error of the logarithm
            assert 0 < half < 0.25
            assert abs(np.log(p.value / truth)) < 4 * half  # one chance in 10^4 each
    assert (fit.white.value == 0.0) == (white == 0.0)
    assert abs(fit.bias - 2.0) < 5 * sigma * np.sqrt(2 * tau / (6 * 330.0))
    assert abs(fit.lag1_coloured) < 5 / np.sqrt(fit.n_values)
    phi = sigma**2 / (sigma**2 + white**2) * np.exp(-1.1 / tau)
    assert abs(fit.lag1_white - phi) < 0.15
    assert fit.overconfidence > 2.0 and "first_order(tau=" in fit.suggestion()


def test_white_noise_is_called_white(rng):
    t, _, label = draw(rng, 1.0, 1.0, 1.0)
    fit = fit_noise(t, 3.0 * rng.normal(size=len(t)), label)
    assert fit.verdict == "white" and fit.suggestion().startswith("R = ")
    assert np.hypot(fit.sigma.value, fit.white.value) == pytest.approx(3.0, rel=5 / np.sqrt(2 * len(t)))
    assert abs(fit.overconfidence - 1.0) < 5 * np.sqrt(2 / (len(t) / 10))


def test_units_scale_the_answer(rng):
    t, r, label = draw(rng, 6.0, 2.0, 1.0, n=120)
    a, b = fit_noise(t, r, label), fit_noise(60 * t, 10 * r, label)
    assert b.tau.value == pytest.approx(60 * a.tau.value, rel=0.03)
    assert b.sigma.value == pytest.approx(10 * a.sigma.value, rel=0.03)
    assert b.gain == pytest.approx(a.gain, rel=1e-3)


def test_outliers_are_left_out_and_counted(rng):
    t, r, label = draw(rng, 6.0, 2.0, 1.0, n=120)
    bad = r.copy()
    bad[[7, 300]] = [1e4, -1e5]
    fit, clean = fit_noise(t, bad, label), fit_noise(t, r, label)
    assert fit.n_outliers == clean.n_outliers + 2
    assert fit.sigma.value == pytest.approx(clean.sigma.value, rel=0.1)


def test_positions_tell_noise_from_motion_when_the_noise_is_fast(rng):
    t, r, _ = draw(rng, 2.0, 3.0, 0.0, n=400, n_series=1)
    dt = np.diff(t, prepend=t[0])
    v = np.cumsum(np.sqrt(0.01 * dt) * rng.normal(size=len(t)))
    fit = fit_noise(t, r + np.cumsum(v * dt), motion=True)
    assert fit.verdict == "coloured"
    for p, truth in ((fit.tau, 2.0), (fit.sigma, 3.0), (fit.accel, 0.01)):
        half = np.log(p.high / p.low) / 2 / 1.96
        assert 0 < half < 0.6 and abs(np.log(p.value / truth)) < 4 * half


def test_what_is_no_first_order_noise_is_called_unexplained(rng):
    t = np.arange(400.0)
    smooth = np.convolve(rng.normal(size=460), np.hanning(60), "valid")[:400]
    fit = fit_noise(t, smooth, motion=False)
    assert fit.verdict == "unexplained" and fit.suggestion().startswith("none")


def test_autocovariance_of_a_wave_is_a_wave():
    t = np.arange(0.0, 600.0, 0.5)
    data = pack(t, np.sqrt(2) * np.cos(2 * np.pi * t / 20), np.zeros(len(t)))
    lags, cov = autocovariance(data, 0.0, 40.0)
    np.testing.assert_allclose(cov, np.cos(2 * np.pi * lags / 20), atol=0.03)


def test_what_the_data_do_not_bound_is_left_open(rng):
    t, r, _ = draw(rng, 15.0, 3.0, 1.0, n=300, n_series=1)
    dt = np.diff(t, prepend=t[0])
    v = np.cumsum(np.sqrt(0.05 * dt) * rng.normal(size=len(t)))
    fit = fit_noise(t, r + np.cumsum(v * dt), motion=True)  # slow noise is much like slow motion
    assert fit.tau.low is None and fit.tau.high is None and fit.white.low is not None
    assert ("do not bound" in fit.suggestion()) == (fit.tau.low is None)


@pytest.mark.parametrize(
    ("times", "values", "message"),
    [
        (np.arange(5.0), np.zeros(4), "one length"),
        (np.arange(40.0), np.full(40, np.nan), "must be finite"),
        (np.arange(10.0), np.arange(10.0), "9 intervals are too few"),
        (np.repeat(np.arange(30.0), 2), np.arange(60.0), "share a time"),
        (np.zeros(0), np.zeros(0), "no value"),
        (np.arange(40.0), np.full(40, 0.1), r"all 40 values are constant \(0\.1\)"),
        (np.arange(40.0), np.zeros(40), r"constant \(0\)"),
    ],
)
def test_bad_data_are_refused(times, values, message):
    with pytest.raises(DataError, match=message):
        fit_noise(times, values)


# --- the command ----------------------------------------------------------------------------------------------


def command(*words):
    return CliRunner().invoke(main, ["diagnose", "noise", *map(str, words)])


def write_csv(path, columns):
    from pyarrow.csv import write_csv as write

    write(pa.table(columns), path)


def test_a_table_of_residuals(tmp_path, rng):
    t, r, label = draw(rng, 8.0, 2.0, 0.5, n=120)
    write_csv(tmp_path / "r.csv", {"time": t, "east": r, "north": rng.normal(size=len(t)), "flight": label})
    done = command(tmp_path / "r.csv", "--columns", "east,north", "--series", "flight", "-o", tmp_path / "out")
    assert done.exit_code == 0, done.output
    assert "suggested noise: first_order(tau=" in done.output and "suggested noise: R = " in done.output
    assert "(tau: s; sigma: a standard deviation in the column's unit" in done.output
    assert "(R: a variance in the square of the column's unit)" in done.output
    found = json.loads((tmp_path / "out" / "noise.json").read_text())
    assert list(found) == ["east", "north"]
    assert found["east"]["verdict"] == "coloured" and found["north"]["verdict"] == "white"
    assert found["east"]["tau"]["low"] < found["east"]["tau"]["value"] < found["east"]["tau"]["high"]
    assert (tmp_path / "out" / "noise.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def test_two_recordings_of_the_same_aircraft(tmp_path, rng):
    """The sensor's tables lie 40 m east of the reference's, with first-order noise north."""
    n, north_m = 200, 1.0 / 111_200.0  # degrees of latitude per metre, to 0.2 %
    t, r, _ = draw(rng, 10.0, 20.0, 0.0, n=n, n_series=2, bias=0.0)
    east_m = north_m / np.cos(np.radians(50.0))
    t0 = np.repeat([0.0, 1000.0], n)
    speed = 100.0
    truth = {
        "time": np.arange(0.0, 1400.0),
        "latitude": np.full(1400, 50.0),
        "longitude": 8.0 + speed * east_m * np.arange(1400.0),
        "icao24": ["3c0001"] * 1400,
        "source": ["good"] * 1400,
    }
    seen = {
        "time": np.round(t + t0, 3),
        "latitude": 50.0 + r * north_m,
        "longitude": 8.0 + (speed * np.round(t + t0, 3) + 40.0) * east_m,
        "icao24": ["3c0001"] * (2 * n),
        "source": ["bad"] * (2 * n),
    }
    write_csv(tmp_path / "truth.csv", truth)
    write_csv(tmp_path / "seen.csv", seen)
    done = command(tmp_path / "seen.csv", "--reference", tmp_path / "truth.csv", "-o", tmp_path / "out")
    assert done.exit_code == 0, done.output
    assert "(tau: s; sigma: a standard deviation in m" in done.output
    found = json.loads((tmp_path / "out" / "noise.json").read_text())
    assert found["north"]["verdict"] == "coloured"
    assert found["north"]["tau"]["low"] < 10.0 < found["north"]["tau"]["high"]
    assert found["north"]["sigma"]["low"] < 20.0 < found["north"]["sigma"]["high"]
    assert found["east"]["bias"] == pytest.approx(40.0, abs=0.6)  # the ellipsoid is not that sphere
    assert found["east"]["n_values"] == found["north"]["n_values"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "either --reference RECORDING, or --columns"),
        (["--columns", "up"], "no column 'up'; there are time, east, name"),
        (["--columns", "name"], "row 0, column 'name': 'a' is no number"),
        (["--columns", "east"], "too few"),
    ],
)
def test_a_wrong_command_gives_one_clear_line(tmp_path, words, message):
    write_csv(tmp_path / "r.csv", {"time": [0.0, 1.0], "east": [1.0, 2.0], "name": ["a", "b"]})
    done = command(tmp_path / "r.csv", *words, "-o", tmp_path / "out")
    assert done.exit_code == 2 and message in done.output
    assert not (tmp_path / "out").exists()


def test_a_recording_is_no_reference_for_itself(tmp_path):
    path = tmp_path / "seen.csv"
    time = np.arange(60.0)
    write_csv(
        path, {"time": time, "latitude": 50.0 + 1e-4 * time, "longitude": np.full(60, 8.0), "icao24": ["3c0001"] * 60}
    )
    done = command(path, "--reference", path, "-o", tmp_path / "out")
    assert done.exit_code == 2 and "all 60 residuals are 0" in done.output and "the same recording?" in done.output
    assert not (tmp_path / "out").exists()
