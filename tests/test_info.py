"""`saltus info` on the command line."""

import pytest
from click.testing import CliRunner

from saltus.cli import main
from saltus.io.asterix_write import write_cat048


def info(*arguments):
    return CliRunner().invoke(main, ["info", *map(str, arguments)])


@pytest.fixture
def recording(tmp_path):
    path = tmp_path / "radar.ast"
    write_cat048(
        path,
        sac=20,
        sic=129,
        time_of_day=[3600.0, 3604.0],
        range_m=[10e3, 10.1e3],
        azimuth_rad=[1.0, 1.1],
        icao24=[1, 1],
        north_marker_times=[3599.0, 3603.0, 3607.0],
    )
    return path


def test_says_what_is_in_a_recording(recording):
    (recording.parent / "c.toml").write_text(
        'date = 2024-05-01\n[[sensor]]\nname = "BCN"\nsac = 20\nsic = 129\nlatitude = 41.3\nlongitude = 2.1\n'
    )
    result = info(recording, "--config", recording.parent / "c.toml")
    assert result.exit_code == 0, result.output
    lines = [" ".join(line.split()) for line in result.output.splitlines()]
    assert "radar.ast" in lines
    assert "CAT048:20/129 BCN edition 1.32" in lines
    assert "records 2, of these 2 target reports" in lines
    assert "time 2024-05-01 01:00:00.000 to 2024-05-01 01:00:04.000 UTC (4.000 s)" in lines
    assert lines.count("update 4.000 s") == 2
    assert "types Single ModeS Roll-Call 2" in lines
    assert "rejected none (2 usable)" in lines
    assert "2 target reports, 2 usable, 0 rejected" in lines
    assert "problem" not in result.output
    assert "\x1b" not in result.output  # plain when it is no terminal


def test_option_goes_before_configuration(recording):
    result = info(recording, "--date", "2024-05-02")
    assert "2024-05-02 01:00:00.000" in result.output


def test_without_a_date_times_of_day(recording):
    result = info(recording)
    assert "01:00:00.000 to 01:00:04.000 UTC" in result.output
    assert "problem: radar.ast: no date given" in result.output


def test_one_clear_line_for_what_cannot_be(recording, tmp_path):
    (tmp_path / "x.json").write_text("{}")
    for arguments, text in (
        ((tmp_path / "x.json",), "unknown format"),
        ((tmp_path / "absent.ast",), "absent.ast"),
        ((recording, "--date", "yesterday"), "YYYY-MM-DD"),
    ):
        result = info(*arguments)
        assert result.exit_code != 0
        assert text in result.output
        assert len(result.output.strip().splitlines()) == 1


def test_files_that_cannot_be_read_are_named_after_the_others(recording, tmp_path):
    (tmp_path / "x.json").write_text("{}")
    (tmp_path / "empty.ast").touch()
    one = info(tmp_path / "x.json", recording)
    assert one.exit_code == 2
    assert "2 target reports, 2 usable" in one.output
    assert "x.json: unknown format" in one.output.splitlines()[-1]
    two = info(tmp_path / "x.json", recording, tmp_path / "empty.ast")
    assert two.exit_code == 2
    assert "2 target reports, 2 usable" in two.output
    assert ["x.json: unknown" in two.output.splitlines()[-2], "empty" in two.output.splitlines()[-1]] == [True, True]


def test_recordings_as_given(recordings):
    folder = recordings / "lebl_2016-05-10"
    result = info(folder / "smr.ast", "--config", folder / "sensors.toml")
    text = " ".join(result.output.split())
    assert "CAT010:0/7 SMR edition 1.1 records 26549, of these 22353 target reports" in text
    assert "time 2016-05-10 22:00:01.695 to 2016-05-10 22:34:59.984 UTC (35.0 min) update 1.000 s" in text
    assert "rejected no position 311 (22042 usable)" in text
