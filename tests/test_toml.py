"""TOML files of odd bytes: always a ModelError that names the file."""

import pytest

from saltus.config import load_config
from saltus.errors import ModelError
from saltus.gap import load_scenario
from saltus.toml import LARGEST, load_toml

ODD = [
    ("no UTF-8", b'a = "\xff"', "byte 5 is no UTF-8"),
    ("no TOML", b"a = \n", "line 1"),
    ("many digits", b"[tracker]\nconfirm_hits = " + b"9" * 5000, r"too many digits \(line 2\)"),
    ("deep list", b"a = " + b"[" * 5000 + b"]" * 5000, "nested too deep"),
    ("deep table", b"a = " + b"{b = " * 3000, "nested too deep|end of document|line 1"),
    ("no date", b"date = 2023-02-30", "day|line 1|date"),
    ("nul", b"a\x00 = 1", "line 1"),
    ("too long", b"#" * (LARGEST + 1), "longer than"),
]


@pytest.mark.parametrize(("content", "said"), [pytest.param(c, s, id=i) for i, c, s in ODD])
@pytest.mark.parametrize("load", [load_toml, load_config, load_scenario])
def test_odd_bytes_are_refused(tmp_path, load, content, said):
    path = tmp_path / "odd.toml"
    path.write_bytes(content)
    with pytest.raises(ModelError, match=said) as caught:
        load(path)
    assert str(path) in str(caught.value)


def test_a_byte_order_mark_is_no_fault(tmp_path):
    (tmp_path / "bom.toml").write_bytes(b"\xef\xbb\xbf[tracker]\r\nmax_speed = 300\r\n")
    assert load_config(tmp_path / "bom.toml").tracker.max_speed == 300.0


@pytest.mark.parametrize(
    "text",
    [
        '[editions]\n"\u00b2" = "1.0"\n',  # a digit to Unicode, no number
        '[editions]\n"' + "9" * 400 + '" = "1.0"\n',
        f"[tracker]\nmax_speed = {'9' * 400}\n",
        f"[tracker]\nconfirm_hits = {'9' * 400}\n",
        f"[[sensor]]\nsac = {'9' * 4000}\n",
        "[tracker]\nmax_speed = nan\n",
        "[tracker]\nheight_prior = [nan, 1.0]\n",
        "[tracker]\nclutter_density = nan\n",
        "[filter]\naccel_h = [[1.0]]\n",
        "[systems]\nreference = 3\n",
        "[registration]\ninterval = inf\n",
        "sensor = 3\n",
        "sensor = [3]\n",
        "editions = 3\n",
        "[[sensor]]\nname = 3\n",
    ],
)
def test_odd_values_are_refused_by_key(tmp_path, text):
    path = tmp_path / "c.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ModelError) as caught:
        load_config(path)
    assert str(path) in str(caught.value) and len(str(caught.value)) < 600
