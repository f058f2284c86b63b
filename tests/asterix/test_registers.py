"""Comm-B registers of CAT048 as columns: one worked out by hand, and a recording against another program."""

import numpy as np
import pyarrow.parquet as pq
import pytest
from library import in_blocks

from saltus.asterix.codec import Want, decode, find_records
from saltus.asterix.layout import layout

FORM = layout(48, "1.32")

# name in the twin -> field, in the twin's unit
TWIN = {
    "bds50_roll_deg": "250/5,0/ROLL",
    "bds50_track_deg": "250/5,0/TRACK",
    "bds50_track_rate_dps": "250/5,0/TRACK_RATE",
    "bds50_gs_kt": "250/5,0/GS",
    "bds50_tas_kt": "250/5,0/TAS",
    "bds60_hdg_deg": "250/6,0/HEADING",
    "bds60_ias_kt": "250/6,0/IAS",
    "bds60_mach": "250/6,0/MACH",
    "bds60_baro_rate_fpm": "250/6,0/BARO_RATE",
    "bds60_inertial_rate_fpm": "250/6,0/INERTIAL_RATE",
    "bds40_mcp_alt_ft": "250/4,0/MCP_ALT",
    "bds40_qnh_hpa": "250/4,0/BARO",
}


def test_one_register_by_hand():
    # BDS 5,0: status 1, roll -32 (sign 1, 111100000: -32 x 45/256 = -5.625 degrees), status 0 of the track, whose bits
    # are set all the same, the rest 0; then the address 50. FSPEC 81 20: 010 | - - 250
    #   1 1 111100000 0 11111111111 0...: 1111 1100 0000 1111 1111 1110 = fc 0f fe
    record = bytes.fromhex("81 20 1481 01 fc0ffe00000000 50")
    data, offset, length = in_blocks(48, [record])
    records = find_records(data, offset, length, FORM).records
    held = decode(data, records, FORM, {p: Want(p) for p in ("250/5,0/ROLL", "250/5,0/TRACK", "250/6,0/HEADING")})
    assert held["250/5,0/ROLL"].values[0] == pytest.approx(np.radians(-5.625))
    assert np.isnan(held["250/5,0/TRACK"].values[0])
    assert not held["250/6,0/HEADING"].present[0]


def test_a_recording_against_another_program(recordings):
    folder = recordings / "bcn_cat048_2023-05-02"
    data = np.frombuffer((folder / "bcn_cat048.ast").read_bytes(), np.uint8)
    offset = [0]
    while offset[-1] < len(data):
        offset.append(offset[-1] + (int(data[offset[-1] + 1]) << 8 | int(data[offset[-1] + 2])))
    start = np.array(offset)
    records = find_records(data, start[:-1], np.diff(start), FORM).records
    wants = {name: Want(path, "native") for name, path in TWIN.items()}
    held = decode(data, records, FORM, {**wants, "tod": Want("140"), "theta": Want("040/THETA", "native")})
    twin = pq.read_table(folder / "bcn_cat048.parquet")
    mine = np.lexsort((np.round(held["theta"].values, 4), held["tod"].values))
    theirs = np.lexsort((np.round(np.float64(twin["theta_deg"]), 4), np.float64(twin["time"])))
    for name in TWIN:
        expected = np.array(twin[name].to_pylist(), np.float64)[theirs]
        got = held[name].values[mine]
        np.testing.assert_array_equal(np.isnan(got), np.isnan(expected), err_msg=name)
        assert np.count_nonzero(~np.isnan(got)) > 1000
        np.testing.assert_allclose(got, expected, rtol=2e-7, atol=1e-5, err_msg=name)
