"""Range rates: the derivative, what they gain, what is wrong with them, and whose plot is whose."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from saltus.models import PolarSensor
from saltus.run import track_files
from saltus.tracks.range_rate import rate_of

SIGMA, EARTH = 1.0, 6.378e6
CONFIG = '[[sensor]]\nname = "r"\nlatitude = 48.0\nlongitude = 11.0\nheight = 0.0\nperiod = 4.0\n'
NOISE = "sigma_range = 60.0\nsigma_azimuth = 0.1\n"


def test_the_rate_and_its_derivatives_are_the_sensor_models(rng):
    """In the plane, where a ray has no elevation, those of the library's sensor; else those of differences."""
    mean = rng.normal(0.0, 1.0, (40, 6)) * [3e4, 150.0, 3e4, 150.0, 3e3, 10.0]
    site, nothing = rng.normal(0.0, 1e3, (40, 2)), np.zeros(40)
    mean[:, 0:3:2] += site
    sensor = PolarSensor(
        sigma_range=1.0, sigma_azimuth=1e-3, sigma_range_rate=1.0, dims=2, axes=(0, 2), velocities=(1, 3)
    )
    value, C = rate_of(mean, nothing, site, np.ones(40))
    for k in range(40):
        moved = mean[k] - [site[k, 0], 0.0, site[k, 1], 0.0, 0.0, 0.0]
        assert value[k] == pytest.approx(sensor.h(moved[:4])[2], abs=1e-9)
        np.testing.assert_allclose(C[k, :4], sensor.jacobian(moved[:4])[2], atol=1e-12)
    cosine, offset = rng.uniform(0.5, 1.0, 40), rng.uniform(-2.0, 0.0, 40)
    value, C = rate_of(mean, offset, site, cosine)
    for i, step in ((0, 1.0), (1, 0.1), (2, 1.0), (3, 0.1)):
        ahead, behind = mean.copy(), mean.copy()
        ahead[:, i] += step
        behind[:, i] -= step
        difference = (rate_of(ahead, offset, site, cosine)[0] - rate_of(behind, offset, site, cosine)[0]) / (2.0 * step)
        np.testing.assert_allclose(C[:, i], difference, atol=2e-6)
    assert (C[:, 4:] == 0.0).all()


def scene(path, rng, folded=0.0):
    """Write plots of ten aircraft at constant speed; return velocities, numbers of aircraft, places."""
    k, scans = np.repeat(np.arange(10), 40), np.tile(np.arange(40), 10)
    time = 1.7e9 + 4.0 * scans + 0.3 * k
    angle, course = 2.0 * np.pi * np.arange(10) / 10, rng.uniform(0.0, 2.0 * np.pi, 10)
    speed = rng.uniform(150.0, 240.0, 10)
    velocity = np.stack([speed * np.sin(course), speed * np.cos(course), np.zeros(10)], axis=-1)[k]
    start = np.stack([4e4 * np.sin(angle), 4e4 * np.cos(angle), np.full(10, 5e3)], axis=-1)[k]
    p = start + velocity * (time - 1.7e9 - 80.0)[:, None]
    slant = np.linalg.norm(p, axis=-1)
    rate = (p * velocity).sum(axis=-1) / slant + SIGMA * rng.standard_normal(len(k))
    wrong = rng.random(len(k)) < folded
    rate[wrong] -= 150.0 * np.sign(rate[wrong])
    table = {
        "time": time,
        "range_m": slant + 60.0 * rng.standard_normal(len(k)),
        "azimuth_deg": np.degrees(np.arctan2(p[:, 0], p[:, 1])) % 360.0 + 0.1 * rng.standard_normal(len(k)),
        "altitude_m": p[:, 2] + (p[:, 0] ** 2 + p[:, 1] ** 2) / (2.0 * EARTH),
        "range_rate_mps": rate,
        "source": np.full(len(k), "r"),
    }
    table["azimuth_deg"] %= 360.0
    order = np.argsort(time)
    pq.write_table(pa.table({name: values[order] for name, values in table.items()}), path)
    return velocity[order], k[order], p[order]


def tracked(tmp_path, path, config):
    (tmp_path / "a.toml").write_text(config)
    summary = track_files([path], tmp_path / "out", tmp_path / "a.toml", report=False)
    assigned = pq.read_table(tmp_path / "out/assignments.parquet").sort_by("record")
    tracks = pq.read_table(tmp_path / "out/tracks.parquet")
    return summary, assigned["track_id"].to_numpy(zero_copy_only=False), tracks


def errors(path, tracks, assigned, velocity):
    """Velocity errors of settled updates, m/s, and their squared distances (two degrees of freedom)."""
    time = pq.read_table(path)["time"].to_numpy()
    row = {
        (int(i), float(t)): n
        for n, (i, t) in enumerate(zip(tracks["track_id"].to_pylist(), tracks["time"].to_pylist(), strict=True))
    }
    number = np.array([row.get((int(i), float(t)), -1) if i == i else -1 for i, t in zip(assigned, time, strict=True)])
    late = (number >= 0) & (time > 1.7e9 + 60.0)
    get = {name: tracks[name].to_numpy()[number[late]] for name in ("ve", "vn", "cov_veve", "cov_vevn", "cov_vnvn")}
    e = np.stack([get["ve"], get["vn"]], axis=-1) - velocity[late, :2]
    P = np.stack([get["cov_veve"], get["cov_vevn"], get["cov_vevn"], get["cov_vnvn"]], axis=-1).reshape(-1, 2, 2)
    return e, np.einsum("ki,kij,kj->k", e, np.linalg.inv(P), e)


def test_speeds_are_better_for_range_rates_and_honest(tmp_path, rng):
    path = tmp_path / "r.parquet"
    velocity, aircraft, _ = scene(path, rng)
    _, assigned, tracks = tracked(tmp_path, path, CONFIG + NOISE + f"sigma_range_rate = {SIGMA}\n")
    with_rates, d2 = errors(path, tracks, assigned, velocity)
    blind = pq.read_table(path).drop_columns(["range_rate_mps"])
    pq.write_table(blind, path)
    _, others, tracks = tracked(tmp_path, path, CONFIG + NOISE)
    without, _ = errors(path, tracks, others, velocity)
    for found in (assigned, others):  # each aircraft is one track
        assert len(set(zip(aircraft.tolist(), found.tolist(), strict=True))) == 10
    assert np.sqrt(np.mean(with_rates**2)) < 0.75 * np.sqrt(np.mean(without**2))
    assert 0.3 < d2.mean() / 2.0 < 1.3


def test_folded_rates_are_left_out(tmp_path, rng):
    path = tmp_path / "r.parquet"
    velocity, aircraft, _ = scene(path, rng, folded=0.05)
    _, assigned, tracks = tracked(tmp_path, path, CONFIG + NOISE + f"sigma_range_rate = {SIGMA}\n")
    e, d2 = errors(path, tracks, assigned, velocity)
    assert len(set(zip(aircraft.tolist(), assigned.tolist(), strict=True))) == 10
    assert np.abs(e).max() < 40.0 and d2.mean() / 2.0 < 1.5


def test_their_noise_is_estimated_where_it_is_not_given(tmp_path, rng):
    path = tmp_path / "r.parquet"
    scene(path, rng)
    summary, *_ = tracked(tmp_path, path, CONFIG)
    row = summary["noise"]["r"]["sigma_range_rate_mps"]
    assert row["estimated"] == row["used"] == pytest.approx(SIGMA, rel=0.15)
    assert row["configured"] is None


def test_two_that_cross_are_told_apart_by_their_rates(tmp_path, rng):
    """They meet within the errors of position, one inbound and one outbound."""
    k, scans = np.repeat(np.arange(2), 40), np.tile(np.arange(40), 2)
    time = 1.7e9 + 4.0 * scans
    north = 3e4 + np.where(k == 0, 200.0, -200.0) * (time - 1.7e9 - 80.0)
    table = {
        "time": time + 0.01 * k,
        "range_m": north + 60.0 * rng.standard_normal(80),
        "azimuth_deg": 10.0 + 0.1 * rng.standard_normal(80),
        "range_rate_mps": np.where(k == 0, 200.0, -200.0) + rng.standard_normal(80),
        "source": np.full(80, "r"),
    }
    pq.write_table(pa.table(table), tmp_path / "r.parquet")
    _, assigned, _ = tracked(tmp_path, tmp_path / "r.parquet", CONFIG + NOISE + "sigma_range_rate = 1.0\n")
    assert len(set(assigned[k == 0].tolist())) == len(set(assigned[k == 1].tolist())) == 1
