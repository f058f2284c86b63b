"""Names from outside are seen and do nothing, wherever they are printed."""

import pytest
from click.testing import CliRunner

from saltus.cli import main
from saltus.progress import Progress, progress_bar
from saltus.text import brief, say, shown

HOSTILE = "\x1b]0;owned\x07\x1b[2J\u202eevil\u2028\x9b31m"
ROW = "1700000000,41.0,2.0"


def test_what_prints_stays():
    for name in ("BCN radar 1", "Öresund", "航空", "C:\\data\\a.csv", ""):
        assert shown(name) is name


def test_what_steers_a_terminal_is_spelt():
    text = shown(HOSTILE)
    assert text.isprintable()
    assert text == "\\x1b]0;owned\\x07\\x1b[2J\\u202eevil\\u2028\\x9b31m"
    assert shown("\udcff.csv") == "\\udcff.csv"  # a file name that is no UTF-8


def test_values_are_cut():
    assert brief([1, 2]) == "[1, 2]"
    assert len(brief("x" * 10_000)) == 80
    assert brief(10**5000) == "a int too long to be written"


def test_lines_stay_lines(capsys):
    say("one\ntw\x1bo")
    assert capsys.readouterr().out == "one\ntw\\x1bo\n"


@pytest.mark.parametrize("command", ["info", "track"])
def test_names_of_sources_and_files_reach_no_terminal(tmp_path, command):
    table = tmp_path / "a\x1b[31m.csv"
    body = "".join(f'{1.7e9 + 4 * k},{41 + 0.002 * k},2.0,"{HOSTILE}",1\n' for k in range(30))
    table.write_text(f"time,latitude,longitude,source,col\x1b[2J\n{body}", encoding="utf-8", newline="")
    config = tmp_path / "c.toml"
    name = HOSTILE.encode("unicode_escape").decode().replace("\\x1b", "\\u001b").replace("\\x07", "\\u0007")
    name = name.replace("\\x9b", "\\u009b")
    config.write_text(f'[[sensor]]\nname = "{name}"\nsigma_xy = 20.0\nperiod = 4.0\n')
    arguments = [command, str(table), "--config", str(config)]
    run = CliRunner().invoke(main, arguments + (["-o", str(tmp_path / "o")] if command == "track" else []))
    assert run.exit_code == 0, run.output
    said = run.stdout + run.stderr
    assert set("\x1b\x07\x9b\u202e\u2028").isdisjoint(said)
    assert "\\x1b]0;owned" in said


def test_a_message_of_an_error_reaches_no_terminal(tmp_path):
    run = CliRunner().invoke(main, ["info", str(tmp_path / "no\x1b[2Jne.csv")])
    assert run.exit_code == 2
    assert "\x1b" not in run.stderr and "no\\x1b[2Jne.csv" in run.stderr


def test_stages_of_progress_are_no_markup(monkeypatch):
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    with progress_bar() as bar:
        bar.reading("a[/b]\x1b.csv", 0.5)
    Progress().reading("a[/b].csv", 0.5)
