"""Scores against a truth that is known: places by PROJ, figures by hand."""

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pyproj
import pytest
from click.testing import CliRunner

from saltus.cli import main
from saltus.errors import DataError
from saltus.score import score_files

START = 1.7e9
PLACE = pyproj.Transformer.from_pipeline(
    "+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lat_0=63.4 +lon_0=10.4 +h_0=0 "
    "+step +inv +proj=cart +ellps=WGS84"
)


def geodetic(east, north):
    lon, lat, _ = PLACE.transform(np.asarray(east, float), np.asarray(north, float), np.zeros(len(east)))
    return {"latitude": lat, "longitude": lon}


def line(time, x0=0.0, y0=0.0, vx=4.0, vy=-2.0):
    return x0 + vx * time, y0 + vy * time


def truth(*targets):
    """Rows of (name, time, east, north)."""
    return {
        "time": np.concatenate([START + t for _, t, _, _ in targets]),
        "target_id": np.concatenate([np.full(len(t), name, object) for name, t, _, _ in targets]),
        **geodetic(np.concatenate([e for *_, e, _ in targets]), np.concatenate([n for *_, n in targets])),
    }


def tracks(*parts, cov=((4.0, 0.0), (0.0, 9.0)), status="confirmed"):
    """Rows of (track id, time, east, north)."""
    n = sum(len(t) for _, t, _, _ in parts)
    return {
        "track_id": np.concatenate([np.full(len(t), k) for k, t, _, _ in parts]),
        "time": np.concatenate([START + t for _, t, _, _ in parts]),
        **geodetic(np.concatenate([e for *_, e, _ in parts]), np.concatenate([m for *_, m in parts])),
        "cov_ee": np.full(n, cov[0][0]),
        "cov_en": np.full(n, cov[0][1]),
        "cov_nn": np.full(n, cov[1][1]),
        "status": np.full(n, status, object) if isinstance(status, str) else status,
    }


@pytest.fixture
def scored(tmp_path):
    def run(track_columns, truth_columns, cutoff=20.0):
        pq.write_table(pa.table(track_columns), tmp_path / "tracks.parquet")
        pq.write_table(pa.table(truth_columns), tmp_path / "truth.parquet")
        return score_files(tmp_path, tmp_path / "truth.parquet", cutoff=cutoff)

    return run


T = np.arange(0.0, 20.5, 0.5)


def test_a_steady_offset(scored):
    east, north = line(T)
    found = scored(tracks((7, T, east + 3.0, north + 4.0)), truth(("a", T, east, north)))
    assert found["rmse_m"] == pytest.approx(5.0, abs=1e-4)
    assert found["rmse_missing20_m"] == pytest.approx(5.0, abs=1e-4)
    assert (found["bias_east_m"], found["bias_north_m"]) == pytest.approx((3.0, 4.0), abs=1e-4)
    assert found["nees"] == pytest.approx(9 / 4 + 16 / 9, abs=1e-4)
    assert found["nees_inside_95"] == 1.0
    assert found["gospa_m"] == pytest.approx(5.0, abs=1e-4)
    assert (found["completeness"], found["id_switches"], found["tracks"], found["longest_gap_s"]) == (1.0, 0, 1, 0.0)
    overall = {k: v for k, v in found["targets"]["a"].items() if k != "gospa_m"}
    assert overall == {k: found[k] for k in overall}  # one target: its figures are all there are


def test_correlated_errors_use_the_whole_covariance(scored):
    east, north = line(T)
    cov = np.array([[5.0, 3.0], [3.0, 4.0]])
    found = scored(tracks((7, T, east + 3.0, north - 1.0), cov=cov), truth(("a", T, east, north)))
    e = np.array([3.0, -1.0])
    assert found["nees"] == pytest.approx(e @ np.linalg.inv(cov) @ e, abs=1e-3)


def test_a_track_is_interpolated_between_its_rows(scored):
    east, north = line(T)
    rows = np.arange(0.0, 20.5, 2.5)
    found = scored(tracks((1, rows, *line(rows))), truth(("a", T, east, north)))
    assert found["rmse_m"] < 1e-4
    assert found["completeness"] == 1.0


def test_a_missing_track_counts_as_the_cutoff(scored):
    east, north = line(T)
    late = T[T >= 15.0]
    x, y = line(late)
    found = scored(tracks((1, late, x + 3.0, y + 4.0)), truth(("a", T, east, north)))
    n, m = len(late), len(T) - len(late)
    assert found["rmse_m"] == pytest.approx(5.0, abs=1e-4)
    assert found["rmse_missing20_m"] == pytest.approx(np.sqrt((25 * n + 400 * m) / (n + m)), abs=1e-4)
    assert found["completeness"] == pytest.approx(n / (n + m))
    assert found["longest_gap_s"] == pytest.approx(15.0, abs=1e-6)
    assert found["gospa_m"] == pytest.approx((5.0 * n + np.sqrt(200.0) * m) / (n + m), abs=1e-4)


def test_nothing_follows_from_beyond_the_cutoff(scored):
    east, north = line(T)
    found = scored(tracks((1, T, east + 25.0, north)), truth(("a", T, east, north)))
    assert found["rmse_m"] is None
    assert found["nees"] is None
    assert (found["completeness"], found["tracks"], found["false_tracks"]) == (0.0, 0, 1.0)
    assert found["gospa_m"] == pytest.approx(np.sqrt(400.0), abs=1e-4)  # one missed and one false
    found = scored(tracks((1, T, east + 25.0, north)), truth(("a", T, east, north)), cutoff=30.0)
    assert found["rmse_missing30_m"] == pytest.approx(25.0, abs=1e-3)


def test_a_false_track_costs_gospa_only(scored):
    east, north = line(T)
    found = scored(tracks((1, T, east, north), (2, T, east + 500.0, north)), truth(("a", T, east, north)))
    assert found["gospa_m"] == pytest.approx(np.sqrt(200.0), abs=1e-3)
    assert found["gospa_parts_m2"]["false"] == pytest.approx(200.0)
    assert found["targets"]["a"]["gospa_m"] < 1e-3
    assert found["rmse_m"] < 1e-4


def test_tracks_that_swap_targets_are_switches_of_both(scored):
    a, b = line(T), line(T, y0=300.0)
    first = T < 10.0
    swapped = [np.where(first, x, y) for x, y in zip(a, b, strict=True)]
    other = [np.where(first, y, x) for x, y in zip(a, b, strict=True)]
    found = scored(tracks((1, T, *swapped), (2, T, *other)), truth(("a", T, *a), ("b", T, *b)))
    assert found["id_switches"] == 2
    assert [found["targets"][k]["id_switches"] for k in "ab"] == [1, 1]
    assert found["completeness"] == 1.0


def test_a_target_keeps_its_track_when_a_nearer_one_comes(scored):
    east, north = line(T)
    late = T[T > 8.0]
    x, y = line(late)
    found = scored(tracks((1, T, east + 3.0, north), (2, late, x, y)), truth(("a", T, east, north)))
    assert found["id_switches"] == 0
    assert found["rmse_m"] == pytest.approx(3.0, abs=1e-4)
    assert found["gospa_m"] < np.sqrt(200.0)  # the metric itself takes the nearest


def test_rows_of_a_tentative_track_do_not_count(scored):
    east, north = line(T)
    status = np.where(T < 5.0, "tentative", np.where(T < 15.0, "confirmed", "coasted")).astype(object)
    found = scored(tracks((1, T, east, north), status=status), truth(("a", T, east, north)))
    assert found["completeness"] == pytest.approx(np.mean(T >= 5.0))
    assert found["longest_gap_s"] == pytest.approx(5.0, abs=1e-6)


def test_targets_at_times_of_their_own(scored):
    other = T + 0.17
    a, b = line(T), line(other, y0=300.0)
    found = scored(tracks((1, T, *a), (2, other, *b)), truth(("a", T, *a), ("b", other, *b)))
    assert found["epochs"] == 2 * len(T)
    assert found["rmse_m"] < 1e-4
    assert found["completeness"] == 1.0  # each is known at the other's epochs too, but not beyond its own ends


def test_a_target_without_fixes_for_long_is_unknown(scored):
    gone = np.append(T, T + 40.0)
    east, north = line(gone)
    found = scored(
        tracks((1, T, *line(T))),
        truth(("a", gone, east, north), ("b", np.arange(61.0), *line(np.arange(61.0), y0=900.0))),
    )
    own = found["targets"]["a"]
    assert own["completeness"] == pytest.approx(0.5, abs=0.05)
    assert own["longest_gap_s"] == pytest.approx(40.0, abs=0.51)


@pytest.mark.parametrize(("factor", "expected"), [(1.0, 2.0), (0.5, 4.0)])
def test_honest_covariances_have_two(scored, rng, factor, expected):
    time = np.arange(2000.0)
    cov = np.array([[4.0, 1.5], [1.5, 9.0]])
    e = rng.multivariate_normal(np.zeros(2), cov, len(time)).T
    found = scored(
        tracks((1, time, e[0], e[1]), cov=factor * cov), truth(("a", time, np.zeros(len(time)), np.zeros(len(time))))
    )
    # Standard error of a mean of N chi-square values of two degrees of freedom: 2 / sqrt(N), scaled like the value.
    assert found["nees"] == pytest.approx(expected, abs=5 * expected / np.sqrt(len(time)))


@pytest.mark.parametrize(("correlation", "expected"), [(1.0, 2.0), (0.0, 1.0)])
def test_interpolation_never_claims_too_little(scored, rng, correlation, expected):
    """Midway between rows of equal errors the covariance is exact, of independent ones twice what it needs to be."""
    n = 2000
    time = np.arange(2.0 * n)
    cov = np.diag([4.0, 9.0])
    first, second = rng.multivariate_normal(np.zeros(2), cov, (2, n))
    e = np.empty((2 * n, 2))
    e[0::2], e[1::2] = first, correlation * first + np.sqrt(1.0 - correlation**2) * second
    middle = time[0::2] + 0.5
    found = scored(tracks((1, time, *e.T), cov=cov), truth(("a", middle, np.zeros(n), np.zeros(n))))
    assert found["nees"] == pytest.approx(expected, abs=5 * expected / np.sqrt(n))


def test_across_the_date_line(scored):
    east, north = line(T, x0=-40.0)
    true, estimated = truth(("a", T, east, north)), tracks((1, T, east + 3.0, north + 4.0))
    for columns in (true, estimated):
        columns["longitude"] = (columns["longitude"] - 10.4 + 180.0 + 180.0) % 360.0 - 180.0
    assert min(true["longitude"]) < -179.0 and max(true["longitude"]) > 179.0
    assert scored(estimated, true)["rmse_m"] == pytest.approx(5.0, abs=1e-4)


def run(*arguments):
    return CliRunner().invoke(main, ["score", *(str(a) for a in arguments)])


def test_the_command_writes_what_it_shows(tmp_path):
    east, north = line(T)
    pq.write_table(pa.table(tracks((1, T, east + 3.0, north + 4.0))), tmp_path / "tracks.parquet")
    table = truth(("tug", T, east, north))
    header = ",".join(table)
    rows = [
        ",".join(repr(v) if isinstance(v, float) else str(v) for v in row)
        for row in zip(*(c.tolist() for c in table.values()), strict=True)
    ]
    (tmp_path / "truth.csv").write_text("\n".join([header, *rows]) + "\n")
    result = run(tmp_path, tmp_path / "truth.csv", "--json", tmp_path / "new" / "score.json")
    assert result.exit_code == 0, result.output
    figures = json.loads((tmp_path / "new" / "score.json").read_text())
    assert {"rmse_m", "nees", "gospa_m", "completeness", "id_switches", "rmse_missing20_m"} <= set(figures)
    assert {"rmse_m", "nees", "gospa_m", "completeness", "id_switches"} <= set(figures["targets"]["tug"])
    assert "tug" in result.output and "rmse_m" in result.output


def test_what_cannot_be_scored_is_one_line(tmp_path):
    east, north = line(T)
    good = truth(("a", T, east, north))
    pq.write_table(pa.table(good), tmp_path / "truth.parquet")

    def said(*arguments):
        result = run(*arguments)
        assert result.exit_code == 2
        (text,) = result.stderr.splitlines()
        return text

    assert "OUTPUT is a folder that saltus track wrote" in said(tmp_path, tmp_path / "truth.parquet")
    pq.write_table(pa.table(tracks((1, T, east, north))), tmp_path / "tracks.parquet")
    del good["target_id"]
    pq.write_table(pa.table(good), tmp_path / "truth.parquet")
    assert "no column 'target_id'" in said(tmp_path, tmp_path / "truth.parquet")
    good["target_id"], good["time"] = ["a"] * len(T), ["noon"] * len(T)
    pq.write_table(pa.table(good), tmp_path / "truth.parquet")
    assert "row 0, column 'time': 'noon' is no number" in said(tmp_path, tmp_path / "truth.parquet")
    good["time"] = [[1.0]] * len(T)
    pq.write_table(pa.table(good), tmp_path / "truth.parquet")
    assert "column 'time' is of type list" in said(tmp_path, tmp_path / "truth.parquet")
    pq.write_table(pa.table(truth(("a", T, east, north))).slice(0, 0), tmp_path / "truth.parquet")
    assert "no row" in said(tmp_path, tmp_path / "truth.parquet")
    assert "is a folder; name a table" in said(tmp_path, tmp_path)
    assert "absent.parquet: no such file" in said(tmp_path, tmp_path / "absent.parquet")
    (tmp_path / "ragged.csv").write_text("time,target_id,latitude,longitude\n1,a,2,3\n4,a,5\n")
    assert "row 1: 3 cells where the header has 4" in said(tmp_path, tmp_path / "ragged.csv")
    (tmp_path / "empty.csv").write_text("")
    assert "it is empty" in said(tmp_path, tmp_path / "empty.csv")
    (tmp_path / "truth.parquet").write_bytes(b"nothing")
    assert "no readable Parquet table" in said(tmp_path, tmp_path / "truth.parquet")


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
@pytest.mark.parametrize(
    ("column", "value", "words"),
    [
        ("latitude", 412.0, "row 3, column 'latitude': 412 cannot be (degrees north, -90 to 90)"),
        ("longitude", -181.0, "row 3, column 'longitude': -181 cannot be"),
        ("time", 1.7e12, "row 3, column 'time': 1.7e+12 cannot be (seconds since 1970-01-01, UTC"),
        ("latitude", np.nan, "row 3, column 'latitude': no value"),
        ("latitude", "north", "row 3, column 'latitude': 'north' is no number"),
    ],
)
def test_a_value_of_the_truth_that_cannot_be_is_told_by_its_place(scored, tmp_path, suffix, column, value, words):
    from pyarrow.csv import write_csv

    east, north = line(T)
    table = truth(("a", T, east, north))
    cells = list(table[column])
    cells[3] = value
    table[column] = [str(v) for v in cells] if isinstance(value, str) else cells
    scored(tracks((1, T, east, north)), truth(("a", T, east, north)))
    path = tmp_path / f"bad.{suffix}"
    (write_csv if suffix == "csv" else pq.write_table)(pa.table(table), path)
    with pytest.raises(DataError) as caught:
        score_files(tmp_path, path)
    assert f"{path}: {words}" in str(caught.value)


def test_a_truth_of_another_time_or_place_is_refused(scored):
    east, north = line(T)
    with pytest.raises(
        DataError,
        match=r"truth covers 2023-11-15 22:13:20 to 2023-11-15 22:13:40, "
        r"tracks cover 2023-11-14 22:13:20 to 2023-11-14 22:13:40 \(UTC\): nothing in common",
    ):
        scored(tracks((1, T, east, north)), truth(("a", T + 86400.0, east, north)))
    swapped = truth(("a", T, east, north))
    swapped["latitude"], swapped["longitude"] = swapped["longitude"], swapped["latitude"]
    with pytest.raises(DataError, match=r"truth covers latitude 10.4 .*tracks cover latitude 63.4 .*nothing in common"):
        scored(tracks((1, T, east, north)), swapped)
    far = truth(("a", T, east, north + 5e3))
    assert scored(tracks((1, T, east, north)), far)["completeness"] == 0.0


def test_no_track_at_all_is_scored(scored):
    east, north = line(T)
    found = scored(tracks((1, T, east, north), status="tentative"), truth(("a", T, east, north)))
    assert (found["completeness"], found["rmse_m"]) == (0.0, None)
