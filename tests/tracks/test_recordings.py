"""Real recordings, cut short: tracks judged by what aircraft say of themselves, counts by an independent decoding."""

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from saltus import io
from saltus.config import load_config
from saltus.evaluate import track_scores
from saltus.run import track_files


class Tracked:
    """One run of the program: its tables, and the reports it was made from by (source, category, record)."""

    def __init__(self, folder, inputs, config, identity="use", begin=None, end=None):
        self.summary = track_files(inputs, folder, config, None, identity, begin, end, report=False)
        self.tracks = pq.read_table(folder / "tracks.parquet")
        self.assignments = pq.read_table(folder / "assignments.parquet")
        self.track_id = self.assignments["track_id"].fill_null(-1).to_numpy()

    def check(self):
        """Nothing lost, nothing counted twice, no number that is none."""
        used = self.track_id >= 0
        assert (used != np.array(self.assignments["reason"].is_valid())).all()
        assert sum(self.summary["reasons"].values()) == (~used).sum() == self.summary["reports"]["unused"]
        assert used.sum() == self.summary["reports"]["used"]
        for name in self.tracks.schema.names:
            if name in ("status", "icao24", "mode3a", "callsign"):
                continue
            assert np.isfinite(self.tracks[name].drop_null().to_numpy()).all(), name
        for a, b, c in (("cov_ee", "cov_en", "cov_nn"), ("cov_veve", "cov_vevn", "cov_vnvn")):
            a, b, c = (self.tracks[n].to_numpy() for n in (a, b, c))
            assert (a * c > b * b).all()


@pytest.fixture(scope="module")
def barcelona(recordings, tmp_path_factory):
    """The first ten minutes, identities ignored."""
    folder = recordings / "bcn_cat048_2023-05-02"
    config = folder / "sensors.toml"
    found = Tracked(tmp_path_factory.mktemp("bcn"), [folder / "bcn_cat048.ast"], config, "ignore", None, "08:10")
    settings = load_config(config)
    plots = io.read([folder / "bcn_cat048.ast"], date=settings.date).plots
    row = np.empty(len(plots), int)
    row[found.assignments["record"].to_numpy().argsort()] = plots.record.argsort()
    return found, plots.take(row)  # reports in the order of the assignments


def test_barcelona_tracks_are_aircraft(barcelona):
    found, plots = barcelona
    found.check()
    np.testing.assert_allclose(found.assignments["time"].to_numpy(), plots.time)
    seen = plots.time < plots.time[0] - plots.time[0] % 86400 + 8 * 3600 + 600
    airborne = np.where((plots.on_ground == 0) & (plots.icao24 >= 0) & seen & (plots.reason == 0), plots.icao24, -1)
    score = track_scores(found.track_id, airborne.astype(np.int64), min_plots=10)
    assert len(score.objects) > 40
    assert score.n_judged > 4000
    assert score.purity >= 0.998
    assert score.completeness >= 0.98
    assert score.fragmentation <= 1.2


def test_barcelona_counts(barcelona, recordings):
    found, _ = barcelona
    twin = pq.read_table(recordings / "bcn_cat048_2023-05-02" / "bcn_cat048.parquet", columns=["typ", "time"])
    assert len(found.assignments) == twin.num_rows
    time = np.array(twin["time"])
    inside = time <= time[0] - time[0] % 86400 + 8 * 3600 + 600
    reasons = found.summary["reasons"]
    assert reasons["outside time window"] == (~inside).sum()
    assert reasons["coasted by station"] == (np.array(twin["typ"])[inside] == 0).sum() > 10
    noise = found.summary["noise"]["BCN"]
    # The station's plots are ten times better than textbooks say, and rounding alone gives 2.09 m and 0.0016 degrees.
    assert 2.08 < noise["sigma_range_m"]["used"] < 8.0
    assert 0.0015 < noise["sigma_azimuth_deg"]["used"] < 0.02
    assert noise["update_period_s"] == pytest.approx(4.0, abs=0.01)


def test_surface_radar(recordings, tmp_path):
    folder = recordings / "lebl_2016-05-10"
    found = Tracked(tmp_path, [folder / "smr.ast"], folder / "sensors.toml", "use", "22:10", "22:11")
    found.check()
    twin = pq.read_table(folder / "smr.parquet", columns=["msg_type"])
    assert len(found.assignments) == pc.sum(pc.equal(twin["msg_type"], 1)).as_py()
    assert 5 <= found.summary["tracks"]["confirmed"] <= 60
    assert found.summary["reports"]["used"] > 300
    for name in ("altitude", "vu", "icao24", "mode3a"):
        assert found.tracks[name].null_count == len(found.tracks)


def test_multilateration_and_ads_b_share_tracks(recordings, tmp_path):
    """Both name their aircraft: no track holds two addresses, and common ones are on common tracks."""
    folder = recordings / "lebl_2016-05-10"
    files = [folder / "mlat.ast", folder / "adsb_v023.ast"]
    found = Tracked(tmp_path, files, folder / "sensors.toml", "use", "22:10", "22:10:20")
    found.check()
    twins = [pq.read_table(folder / f"{name}.parquet") for name in ("mlat", "adsb_v023")]
    expected = pc.sum(pc.equal(twins[0]["msg_type"], 1)).as_py() + twins[1].num_rows
    assert len(found.assignments) == expected
    settings = load_config(folder / "sensors.toml")
    plots = io.read(files, date=settings.date, editions=settings.editions).plots
    reports = zip((plots.files[f] for f in plots.file), plots.record.tolist(), plots.icao24.tolist(), strict=True)
    address = {(file, record): code for file, record, code in reports}
    both = found.assignments.filter(found.assignments["track_id"].is_valid()).to_pylist()
    codes, files_of = {}, {}
    for row in both:
        code = address[row["source"], row["record"]]
        if code >= 0:
            codes.setdefault(row["track_id"], set()).add(code)
            files_of.setdefault(row["track_id"], set()).add(row["source"])
    assert all(len(names) == 1 for names in codes.values())
    assert len(codes) >= 10
    assert sum(len(names) == 2 for names in files_of.values()) >= 5
    per_aircraft = np.unique([next(iter(names)) for names in codes.values()], return_counts=True)[1]
    assert np.mean(per_aircraft == 1) > 0.7


def test_argentina(recordings, tmp_path):
    """A capture of a distant radar without Mode S: 18 codes, some shared or changed, hardly more tracks."""
    folder = recordings / "argentina_2026-04-29"
    found = Tracked(tmp_path, [folder / "radar_226_232.pcap"], folder / "sensors.toml", "ignore", None, "17:08")
    found.check()
    twin = pq.read_table(folder / "radar_226_232.parquet")
    assert len(found.assignments) == twin.num_rows
    early = np.array(found.assignments["reason"].to_pylist(), object) != "outside time window"
    assert (found.track_id[early] >= 0).mean() > 0.98
    n_codes = len(set(twin["mode3a"].to_pylist()) - {None})
    assert n_codes / 3 <= found.summary["tracks"]["confirmed"] <= 2 * n_codes
    assert np.isfinite(found.tracks["altitude"].drop_null().to_numpy()).any()
