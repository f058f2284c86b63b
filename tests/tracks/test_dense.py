"""Many plots that nothing tells apart in one scan."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from saltus.run import track_files
from saltus.tracks import gates


def test_a_dense_scan_costs_as_many_pairs_as_it_has_tracks(tmp_path, monkeypatch, rng):
    """Five hundred unidentified plots a scan and fifteen targets among them: the same targets as among all pairs."""
    time, slant, azimuth = [], [], []
    for scan in range(5):
        east, north = 2e4 + 150.0 * 4.0 * scan * np.cos(np.arange(15)), 3e3 * np.arange(15) - 2.2e4
        spread = 3.5e4 * np.sqrt(rng.random(500)), rng.uniform(0.0, 2.0 * np.pi, 500)
        r = np.concatenate([np.hypot(east, north) + rng.normal(0.0, 20.0, 15), spread[0]])
        a = np.concatenate([np.arctan2(east, north) + rng.normal(0.0, 5e-4, 15), spread[1]]) % (2.0 * np.pi)
        time.append(1.7e9 + 4.0 * scan + 4.0 * a / (2.0 * np.pi))
        slant.append(r)
        azimuth.append(np.degrees(a))
    columns = {"time": time, "range_m": slant, "azimuth_deg": azimuth}
    table = pa.table({name: np.concatenate(values) for name, values in columns.items()} | {"source": ["r"] * 5 * 515})
    pq.write_table(table, tmp_path / "r.parquet")
    asked, predict = [], gates.predict
    monkeypatch.setattr(
        gates,
        "predict",
        lambda k, life, m, track, *a: asked.append(np.bincount(track)) or predict(k, life, m, track, *a),
    )
    found = {}
    for most in (12, 1000):
        asked.clear()
        (tmp_path / "a.toml").write_text(
            '[[sensor]]\nname = "r"\nlatitude = 48.0\nlongitude = 11.0\nperiod = 4.0\n'
            f"[tracker]\nmost_candidates = {most}\n"
        )
        track_files([tmp_path / "r.parquet"], tmp_path / "out", tmp_path / "a.toml", report=False)
        assert (max(int(counts.max(initial=0)) for counts in asked) <= 12) == (most == 12)
        assigned = (
            pq.read_table(tmp_path / "out/assignments.parquet")
            .sort_by("record")["track_id"]
            .to_numpy(zero_copy_only=False)
        )
        assigned = assigned.reshape(5, 515)[:, :15]
        same = [np.unique(mine[np.isfinite(mine)], return_counts=True)[1].max(initial=0) for mine in assigned.T]
        found[most] = int(np.sum(np.array(same) >= 4))
    assert found[12] >= found[1000] - 1 and found[12] >= 12
