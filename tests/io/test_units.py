"""Columns in other units or places are refused or told, and none vanishes without a word."""

import numpy as np
import pytest

from saltus.errors import DataError
from saltus.io import read

T0 = 1.7e9


def table(tmp_path, **columns):
    names, rows = list(columns), np.column_stack(list(columns.values()))
    body = "\n".join(",".join(f"{v:.9g}" if abs(v) < 1e8 else f"{v:.3f}" for v in row) for row in rows)
    (tmp_path / "t.csv").write_text(f"{','.join(names)}\n{body}\n")
    return read([tmp_path / "t.csv"])


def test_azimuths_that_fill_the_circle_in_radians_are_refused(tmp_path):
    turn = np.linspace(0.0, 2.0 * np.pi, 100, endpoint=False)
    time, slant = T0 + 0.04 * np.arange(100), np.full(100, 9e3)
    for angle in (turn, turn - np.pi):
        with pytest.raises(DataError, match=r"'azimuth_deg': all 100 values .* they are radians. Multiply"):
            table(tmp_path, time=time, range_m=slant, azimuth_deg=angle)
    assert not table(tmp_path, time=time, range_m=slant, azimuth_deg=np.degrees(turn)).problems


def test_angles_within_a_circle_of_radians_are_told(tmp_path):
    time, slant = T0 + np.arange(40), np.full(40, 9e3)
    got = table(tmp_path, time=time, range_m=slant, azimuth_deg=np.linspace(0.5, 3.0, 40))
    assert "column 'azimuth_deg': all 40 values lie within -6.2832 and 6.2832: are they radians?" in got.problems[0]
    got = table(tmp_path, time=time, latitude=np.linspace(0.71, 0.72, 40), longitude=np.full(40, 0.04))
    assert "columns 'latitude' and 'longitude'" in got.problems[0] and "radians" in got.problems[0]
    got = table(tmp_path, time=time, latitude=np.linspace(0.71, 1.72, 40), longitude=np.full(40, 0.04))
    assert not got.problems


def test_altitudes_that_no_aircraft_flies_are_told(tmp_path):
    time, place = T0 + np.arange(40), np.full(40, 41.0)
    got = table(tmp_path, time=time, latitude=place, longitude=place, altitude_m=np.linspace(9e3, 37e3, 40))
    assert "68% of the values lie above 18000 m: are they feet" in got.problems[0]


def test_swapped_columns_are_named_where_they_cannot_be(tmp_path):
    time = T0 + np.arange(40)
    with pytest.raises(DataError, match=r"column 'latitude': 140 cannot be.*are latitude and longitude swapped"):
        table(tmp_path, time=time, latitude=np.full(40, 140.0), longitude=np.full(40, 35.0))


def test_every_column_that_is_not_used_is_named_and_counted(tmp_path):
    (tmp_path / "t.csv").write_text(
        "time,x_m,y_m,range_nm,altitude_ft,Lattitude,zzz,squawk,mode3a_v\n1,2,3,4,,5,,,1\n2,2,3,4,3000,5,,1200,1\n"
    )
    assert read([tmp_path / "t.csv"]).problems == (
        "t.csv: columns not used: range_nm (2 values; write range_m (1 NM = 1852 m)), altitude_ft (1 values; write "
        "altitude_m (1 ft = 0.3048 m)), Lattitude (2 values; write latitude), zzz (0 values), squawk (1 values; write "
        "mode3a, four octal digits), mode3a_v (2 values).",  # says whether a code is valid: no code
    )


def test_a_table_without_time_says_which_column_may_be_it(tmp_path):
    (tmp_path / "t.csv").write_text("ship,BaseDateTime,LAT,LON\n1,2024-05-01T12:00:00,41,2\n")
    with pytest.raises(DataError, match=r"no column for time.*For BaseDateTime write time.*For LAT write latitude"):
        read([tmp_path / "t.csv"])
