"""Configurations: what is read, and what is refused with file, key and value."""

import datetime

import pytest

from saltus.config import load_config, parse_date
from saltus.errors import ModelError
from saltus.records import System
from saltus.tracks.settings import FilterSettings, TrackerSettings

PIER = '[[sensor]]\nname = "pier"\nlatitude = 59.9\nlongitude = 10.7\n'
SENSOR = "[[sensor]]\nsac = 20\nsic = 129\nlatitude = 41.3\nlongitude = 2.1\n"


def load(tmp_path, text):
    (tmp_path / "c.toml").write_text(text)
    return load_config(tmp_path / "c.toml")


def test_defaults_without_a_file():
    config = load_config(None)
    assert config.date is None
    assert config.tracker == TrackerSettings()
    assert config.filter == FilterSettings()
    assert config.site_for(System(48, 20, 129)) is None


def test_everything(tmp_path):
    config = load(
        tmp_path,
        "date = 2023-05-02\n" + SENSOR + 'height = 27\nname = "BCN"\nsigma_range = 3.5\nsigma_azimuth = 0.007\n'
        "sigma_xy = 5\nsigma_altitude = 8\n"
        '[editions]\n21 = "0.23"\n[tracker]\nmax_speed = 300\nconfirm_hits = 2\n[filter]\n'
        'form = "joint"\naccel_h = [0.2, 3]\n',
    )
    assert config.date == datetime.date(2023, 5, 2)
    site = config.site_for(System(48, 20, 129))
    assert (site.name, site.height, site.sigma_azimuth) == ("BCN", 27.0, 0.007)
    assert config.editions == {21: "0.23"}
    assert (config.tracker.max_speed, config.tracker.confirm_hits) == (300.0, 2)
    assert (config.filter.form, config.filter.accel_h) == ("joint", (0.2, 3.0))


def test_category_tells_systems_with_one_code_apart(tmp_path):
    both = SENSOR + 'name = "any"\n' + SENSOR + 'category = 10\nname = "surface"\n'
    config = load(tmp_path, both)
    assert config.site_for(System(10, 20, 129)).name == "surface"
    assert config.site_for(System(21, 20, 129)).name == "any"
    assert config.site_for(System(21, 20, 128)) is None


def test_tables_are_known_by_name(tmp_path):
    config = load(tmp_path, '[[sensor]]\nname = "radar"\nlatitude = 41\nlongitude = 2\n')
    assert config.site_for(System(None, None, None, "radar")).latitude == 41.0
    assert config.site_for(System(None, None, None, "other")) is None
    assert config.site_for(System(48, 1, 1)) is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("date = 2023-13-02", "c.toml: no readable TOML"),
        ('date = "02.05.2023"', "date '02.05.2023'.*YYYY-MM-DD"),
        ("date = 2023-05-02T10:00:00", "write a date"),
        ("date = 1066-01-01", "date 1066-01-01: the year must lie from 1970 to 2100"),
        ('date = "2101-01-01"', "date 2101-01-01: the year must lie from 1970 to 2100"),
        ("sensors = 1", "unknown key 'sensors'. Did you mean sensor"),
        ("[sensor]\nsac = 1", r"write \[\[sensor\]\]"),
        (SENSOR.replace("41.3", "413"), r"number 1: latitude = 413: .*less than or equal to 90.*degrees north"),
        (SENSOR.replace("2.1", "inf"), "longitude = inf"),
        (SENSOR.replace("129", "300"), "sic = 300"),
        (SENSOR.replace("41.3", '"41"'), "latitude = '41'"),
        (SENSOR.replace("latitude = 41.3\n", ""), "latitude and longitude go together"),
        (SENSOR.replace("sic = 129\n", ""), "sac and sic go together"),
        (SENSOR + "height = 29000", r"height = 29000.*1 ft = 0\.3048 m"),
        (SENSOR + "sigma_range = 0", "sigma_range = 0.*greater than 0"),
        (SENSOR + "sigma_azimuth = -0.1", "sigma_azimuth = -0.1"),
        (SENSOR + "sigma_azimut = 0.1", "unknown key 'sigma_azimut'. Did you mean sigma_azimuth"),
        (SENSOR + SENSOR, r"number 1 and number 2 are the same system \(sac = 20, sic = 129\)"),
        (SENSOR + "category = 48\n" + SENSOR + "category = 48", r"\(sac = 20, sic = 129, category = 48\)"),
        (PIER + SENSOR + PIER, r'number 1 and number 3 have one name \(name = "pier"\); .*its own name'),
        (PIER + SENSOR + 'name = "pier"', r'number 1 and number 2 have one name \(name = "pier"\)'),
        ('[editions]\n48 = "9.99"', r"\[editions\] 48 = '9\.99': not known; choose one of 1\.27"),
        ('date = "yesterday"', "c.toml: date 'yesterday'"),
        ("[editions]\n21 = 0.23", r"\[editions\] 21 = 0\.23: write"),
        ('[editions]\nads = "0.23"', r"\[editions\] ads"),
        ("[tracker]\ngate_probabilty = 0.9", "unknown key 'gate_probabilty'. Did you mean gate_probability"),
        ("[tracker]\ngate_probability = 1.5", r"c\.toml: tracker\.gate_probability"),
        ("[tracker]\nconfirm_hits = 2.5", r"\[tracker\] confirm_hits = 2\.5"),
        ('[filter]\naccel_h = "fast"', r"\[filter\] accel_h = 'fast'"),
        ('[filter]\nform = "triangular"', r"\[filter\] form = 'triangular'"),
        ("[filter]\nzzz = 1", "unknown key 'zzz'. Known are: form"),
        ("[intake]\nhold = -1.0", r"c\.toml: intake\.hold is a time in s"),
        ("[intake]\nfor_good = 0", r"intake\.for_good is a number of reports"),
        ("[setup]\nlongest = 0.5", r"setup\.longest is a number of times, 1 or more"),
        ("[periods]\nshortest = 30.0", r"periods\.shortest 30\.0 s must be below periods\.longest 20\.0 s"),
        ("[lasting]\ntimes = [70.0]", r"lasting\.times are shorter than lasting\.time, 60\.0 s"),
        ("[lasting]\nscales = [0.0]", r"lasting\.scales are positive and finite"),
        ("[lasting]\nown_share = 1.0", r"lasting\.own_share and lasting\.straight are shares of 1"),
        ("[lasting]\nmargin = -1.0", r"lasting\.margin must be positive and finite"),
        ("[tracker]\nlasting_silence = 0.0", r"tracker\.lasting_silence must be positive and finite"),
        ("[tracker]\nlasting_states = -1", r"tracker\.lasting_states is a number of states"),
        ("[periods]\nshare = 1.5", r"periods\.width and periods\.share are shares"),
        ("[systems]\nsilent = 0.0", r"systems\.silent must be positive"),
        ("tracker = 3", r"make it a table \[tracker\]"),
    ],
)
def test_refused(tmp_path, text, message):
    with pytest.raises(ModelError, match=message) as caught:
        load(tmp_path, text)
    assert "c.toml" in str(caught.value)


def test_configurations_beside_the_recordings(recordings):
    found = sorted(recordings.glob("*/sensors.toml"))
    assert found
    for path in found:
        assert load_config(path).sensor


def test_dates():
    assert parse_date("2024-02-29") == datetime.date(2024, 2, 29)
    with pytest.raises(ModelError, match="YYYY-MM-DD"):
        parse_date("2023-02-29")
