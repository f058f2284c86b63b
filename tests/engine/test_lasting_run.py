"""A run over errors that last, with nothing configured: states are as good as they are said to be."""

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from saltus.run import track_files
from saltus.summary import noise_rows


def flights(rng, folder, *, tau, lasting, white):
    """Twelve aircraft that turn once, one report a second; the truth by address and second."""
    rows, truth = [], {}
    for k in range(12):
        t = np.arange(150.0)
        turn = np.where((t >= 70.0) & (t < 95.0), np.radians(rng.choice([-2.0, 2.0])), 0.0)
        heading = rng.uniform(0.0, 2.0 * np.pi) + np.cumsum(turn)
        v = rng.uniform(90.0, 200.0) * np.column_stack([np.sin(heading), np.cos(heading)])
        p = np.array([(-1) ** k * 2e3 * k, 3e3 * k - 2e4]) + np.cumsum(v, axis=0)
        a, u = np.exp(-1.0 / tau), rng.normal(size=(150, 2))
        for i in range(1, 150):
            u[i] = a * u[i - 1] + np.sqrt(1.0 - a * a) * u[i]
        z = p + lasting * u + white * rng.normal(size=p.shape)
        address = f"{0x400000 + k:06X}"
        truth[address] = p, turn != 0.0
        rows += [(1.7e9 + 0.05 * k + s, address, *z[int(s)]) for s in t]
    time, address, x, y = zip(*sorted(rows), strict=True)
    table = {"time": time, "source": ["mlat"] * len(time), "icao24": address, "x_m": x, "y_m": y}
    pq.write_table(pa.table(table), folder / "mlat.parquet")
    (folder / "site.toml").write_text('[[sensor]]\nname = "mlat"\nlatitude = 50.0\nlongitude = 10.0\nheight = 0.0\n')
    return truth


def test_what_lasts_is_found_and_the_covariance_holds(rng, tmp_path):
    truth = flights(rng, tmp_path, tau=30.0, lasting=20.0, white=3.0)
    summary = track_files([tmp_path / "mlat.parquet"], tmp_path / "out", tmp_path / "site.toml", report=False)
    said = summary["noise"]["mlat"]["lasting"]
    assert 12.0 < said["sigma_lasting"]["used"] < 36.0
    assert said["sigma_lasting"]["configured"] is None
    (row,) = (row for label, row in noise_rows(summary).items() if "errors that last" in label)
    assert row["used"] == said["sigma_lasting"]["used"]
    assert said["correlation_time"] in ("assumed", "told by its tracks")
    tracks = pq.read_table(tmp_path / "out" / "tracks.parquet")
    nees, quiet = [], []
    for address, (p, turning) in truth.items():
        own = tracks.filter(pc.equal(tracks["icao24"], address))
        columns = {n: own[n].to_numpy(zero_copy_only=False) for n in ("x_m", "y_m", "cov_ee", "cov_en", "cov_nn")}
        second = np.floor(own["time"].to_numpy() - 1.7e9 + 1e-3).astype(int)
        e = np.column_stack([columns["x_m"], columns["y_m"]]) - p[second]
        P = np.stack([columns["cov_ee"], columns["cov_en"], columns["cov_en"], columns["cov_nn"]], axis=-1)
        P = P.reshape(-1, 2, 2)
        late = second >= 20
        nees.append(np.einsum("ni,nij,nj->n", e, np.linalg.inv(P), e)[late])
        manoeuvre = own["p_manoeuvre_h"].to_numpy(zero_copy_only=False)
        quiet.append(manoeuvre[late & ~turning[second] & (second < 70)] > 0.5)
    # Twelve flights of some three independent errors each: 2 within a standard error of .35, and what tau may be off.
    assert 0.8 < np.mean(np.concatenate(nees)) < 4.0
    assert np.mean(np.concatenate(quiet)) < 0.05
