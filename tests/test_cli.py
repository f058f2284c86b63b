"""The program on the command line: versions, help, and one clear line for what cannot be."""

import json
import os
import re
import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from click.testing import CliRunner

from saltus.cli import main
from saltus.io.asterix_write import write_cat048

PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
SITE = "[[sensor]]\nsac = 25\nsic = 1\nlatitude = 48.0\nlongitude = 11.0\nheight = 500.0\n"


def saltus(*arguments):
    return CliRunner().invoke(main, [str(a) for a in arguments])


def refused(*arguments, status=2):
    """The one line said by a command that fails; it must be no traceback and end the program as expected."""
    result = saltus(*arguments)
    assert result.exit_code == status, result.output
    assert result.exception is None or isinstance(result.exception, SystemExit)
    assert result.stdout == ""
    lines = result.stderr.splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("saltus: ")
    assert "Traceback" not in lines[0]
    return lines[0]


@pytest.fixture
def recording(tmp_path):
    """Ten scans of one target, 50 km away; returns the file and a configuration with its site."""
    path, config = tmp_path / "radar.ast", tmp_path / "sensors.toml"
    time, rng = 36000.0 + 4.0 * np.arange(10), np.random.default_rng(3)
    write_cat048(
        path,
        sac=25,
        sic=1,
        time_of_day=time,
        range_m=50e3 + 200.0 * (time - time[0]) + rng.normal(0.0, 35.0, 10),
        azimuth_rad=1.0 + rng.normal(0.0, 8e-4, 10),
        altitude_m=np.full(10, 9144.0),
        north_marker_times=time - 0.6,
    )
    config.write_text("date = 2025-06-01\n" + SITE)
    return path, config


def test_version_is_the_projects():
    result = saltus("--version")
    assert result.exit_code == 0
    assert result.output.split() == ["saltus,", "version", PROJECT["version"]]


def test_help_names_every_command():
    for flag in ("--help", "-h"):
        result = saltus(flag)
        assert result.exit_code == 0
        for command in ("track", "info", "study", "demo"):
            assert f"  {command}" in result.output


@pytest.mark.parametrize(
    ("command", "options"),
    [
        ("track", ["-o", "--config", "--date", "--identity", "--from", "--to", "--no-report"]),
        ("info", ["--config", "--date"]),
        ("study", ["-o", "--runs", "--seed"]),
        ("demo", ["-o", "--seed"]),
    ],
)
def test_help_of_each_command_names_its_options(command, options):
    result = saltus(command, "--help")
    assert result.exit_code == 0
    for option in options:
        assert option in result.output


def test_the_version_needs_none_of_the_heavy_libraries():
    """In a process of its own, since this one has imported everything."""
    code = (
        "import sys; from saltus.cli import main\n"
        "try: main(['--version'])\n"
        "except SystemExit as end: assert not end.code\n"
        "print(sorted({'numpy', 'scipy', 'pyarrow', 'asterix', 'matplotlib', 'rich', 'pydantic'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_the_installed_script_is_this_program():
    script = Path(sys.executable).with_name("saltus")
    done = subprocess.run([script, "--version"], capture_output=True, text=True, check=True)
    assert done.stdout.split()[-1] == PROJECT["version"]


def test_the_module_is_the_same_program():
    done = subprocess.run([sys.executable, "-m", "saltus", "--help"], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("Usage: saltus [OPTIONS]")


def test_an_unknown_study_is_refused_with_the_known_ones(tmp_path):
    line = refused("study", "no-such-study", "-o", tmp_path / "out")
    assert "no-such-study" in line
    assert "radar" in line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("arguments", ["track", "track x.ast", "no-such-command", "info", "study radar"])
def test_a_command_line_that_lacks_something_says_how_to_use_it(arguments):
    result = saltus(*arguments.split())
    assert result.exit_code == 2
    assert "Usage:" in result.stderr
    assert "Traceback" not in result.stderr


def test_a_file_that_is_not_there(tmp_path):
    line = refused("track", tmp_path / "absent.ast", "-o", tmp_path / "out")
    assert "absent.ast" in line
    assert not (tmp_path / "out").exists()
    assert "absent.toml" in refused(
        "track", tmp_path / "a.ast", "-o", tmp_path / "o", "--config", tmp_path / "absent.toml"
    )


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (FileNotFoundError("a.parquet"), "no such file: a.parquet"),
        (PermissionError("a.parquet"), "permission denied: a.parquet"),
        (OSError("a.parquet"), "reading or writing failed: a.parquet"),
        (OSError(24, "Too many open files", "a"), "Too many open files: a; raise the limit on open files (ulimit -n)"),
        (
            ImportError("x.so: cannot open: Too many open files"),
            "Too many open files; raise the limit on open files (ulimit -n)",
        ),
        (OSError(28, "No space left on device", "a"), "No space left on device: a"),
    ],
)
def test_a_failure_of_the_system_says_what_happened(monkeypatch, error, words):
    def fails(*_, **__):
        raise error

    monkeypatch.setattr("saltus.info.show_info", fails)
    assert refused("info", "x") == f"saltus: {words}"


def test_a_reader_that_has_enough_ends_the_program_quietly(recording, tmp_path):
    """The pipe is closed before the program says anything."""
    path, config = recording
    read, write = os.pipe()
    os.close(read)
    arguments = ["track", path, "-o", tmp_path / "out", "--config", config, "--no-report"]
    code = "from saltus.cli import main; main()"
    done = subprocess.run([sys.executable, "-c", code, *arguments], stdout=write, stderr=subprocess.PIPE, text=True)
    os.close(write)
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "out" / "tracks.parquet").exists()


@pytest.mark.parametrize("files", [3, 4, 5, 6])
def test_a_limit_on_open_files_is_named_or_suffices(recording, tmp_path, files):
    """From where the program starts: three are the standard streams, and no more can be opened."""
    path, config = recording
    arguments = ["track", path, "-o", tmp_path / "out", "--config", config, "--no-report"]
    limited = f"import resource; resource.setrlimit(resource.RLIMIT_NOFILE, ({files}, {files}))"
    code = f"from saltus.cli import main; {limited}; main()"
    done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True)
    said = r"saltus: Too many open files(: \S+)?; raise the limit on open files \(ulimit -n\)\n"
    assert (done.returncode == 0 and files > 3) or (done.returncode == 2 and re.fullmatch(said, done.stderr)), done
    assert (tmp_path / "out").exists() == (done.returncode == 0)


@pytest.fixture
def run(recording, tmp_path):
    """Run the program in a process of its own with streams of some kind; returns status and standard error."""
    path, config = recording

    def run(line, **environment):
        command = f"exec {line.format(saltus=f'{sys.executable} -m saltus', radar=path, config=config)}"
        done = subprocess.run(
            ["/bin/bash", "-c", command], cwd=tmp_path, capture_output=True, env={**os.environ, **environment}
        )
        return done.returncode, done.stdout, done.stderr.decode()

    return run


@pytest.mark.parametrize(
    ("line", "status", "said"),
    [
        ("{saltus} info {radar} --date 2025-06-01 >&- 2>&- <&-", 0, ""),
        ("{saltus} info {radar} --date 2025-06-01 >/dev/full", 2, "saltus: standard output: no space left on device\n"),
        ("{saltus} info absent.ast 2>/dev/full", 2, ""),
        ("{saltus} track {radar} -o out --config {config} --no-report >&- 2>/dev/full", 0, ""),
    ],
)
def test_streams_that_are_closed_or_full(run, tmp_path, line, status, said):
    found, _, err = run(line)
    assert (found, err) == (status, said)
    if "track" in line:
        assert (tmp_path / "out" / "tracks.parquet").read_bytes()[:4] == b"PAR1"


def test_letters_that_a_terminal_does_not_know_are_spelt_out(run, tmp_path):
    """A name that is no UTF-8, and a sensor in Greek on a terminal of Latin letters."""
    raw = os.fsencode(tmp_path) + b"/r\xff.ast"
    os.rename(tmp_path / "radar.ast", raw)
    sensors = tmp_path / "sensors.toml"
    sensors.write_text(sensors.read_text() + 'name = "σ"\nperiod = 4.0\n', encoding="utf-8")
    status, out, err = run("{saltus} track $'r\\xff.ast' -o $'o\\xfe' --config {config}", PYTHONIOENCODING="latin-1")
    assert (status, err) == (0, "")
    assert rb"noise of \u03c3" in out and rb"written to o\udcfe/" in out
    assert (Path(os.fsdecode(os.fsencode(tmp_path) + b"/o\xfe")) / "report.html").is_file()


@pytest.mark.parametrize(("number", "said"), [(signal.SIGTERM, "ended by SIGTERM"), (signal.SIGINT, "interrupted")])
def test_a_signal_ends_the_program_and_leaves_nothing(recording, tmp_path, number, said):
    """It comes while the run waits for a recording that nobody writes."""
    path, config = recording
    code = (
        "import os, signal, saltus.run.command as command\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # jobs in the background begin without
        f"command.follow = lambda *_, **__: os.kill(os.getpid(), {int(number)})\n"
        "from saltus.cli import main; main()"
    )
    arguments = ["track", path, "-o", tmp_path / "out", "--config", config]
    done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True)
    assert done.returncode == 128 + number
    assert done.stderr == f"saltus: {said}; nothing half-written was left\n"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["radar.ast", "sensors.toml"]


def test_an_empty_file(tmp_path):
    (tmp_path / "empty.ast").write_bytes(b"")
    line = refused("track", tmp_path / "empty.ast", "-o", tmp_path / "out")
    assert "empty.ast" in line
    assert "empty" in line
    assert not (tmp_path / "out").exists()


def test_garbage(tmp_path):
    noise = np.random.default_rng(1).integers(0, 256, 5000).astype(np.uint8).tobytes()
    for name in ("noise.ast", "noise.pcap", "noise.csv", "noise.parquet", "noise.xyz", "noise"):
        (tmp_path / name).write_bytes(noise)
        assert name in refused("track", tmp_path / name, "-o", tmp_path / "out")
        assert not (tmp_path / "out").exists()


def test_an_unknown_format_lists_the_known_ones(tmp_path):
    (tmp_path / "tracks.dat").write_bytes(b"\xff\x00\x01\x02" + bytes(100))
    line = refused("track", tmp_path / "tracks.dat", "-o", tmp_path / "out")
    for known in ("tracks.dat", ".ast", ".pcap", ".csv", ".parquet"):
        assert known in line


def test_an_output_directory_that_is_a_file(recording, tmp_path):
    path, config = recording
    (tmp_path / "out").write_text("mine")
    assert "out" in refused("track", path, "-o", tmp_path / "out", "--config", config)
    assert (tmp_path / "out").read_text() == "mine"


@pytest.mark.parametrize("output", ["", "/"])
def test_an_output_without_a_name(recording, output):
    path, config = recording
    result = saltus("track", path, "-o", output, "--config", config)
    assert result.exit_code == 2
    assert ("name is empty" if output == "" else "root of the file system") in result.stderr


def test_an_output_inside_a_file(recording, tmp_path):
    path, config = recording
    (tmp_path / "afile").write_text("mine")
    assert "afile is a file" in refused("track", path, "-o", tmp_path / "afile" / "x", "--config", config)


def test_a_report_of_an_earlier_run_does_not_stay_beside_new_results(recording, tmp_path):
    path, config = recording
    assert saltus("track", path, "-o", tmp_path / "out", "--config", config).exit_code == 0
    assert (tmp_path / "out" / "report.html").exists()
    assert saltus("track", path, "-o", tmp_path / "out", "--config", config, "--no-report").exit_code == 0
    assert (tmp_path / "out" / "tracks.parquet").exists()
    assert not (tmp_path / "out" / "report.html").exists()


def test_a_site_that_is_missing_is_named_with_what_to_write(recording, tmp_path):
    path, _ = recording
    line = refused("track", path, "-o", tmp_path / "out", "--date", "2025-06-01")
    for word in ("25/1", "[[sensor]]", "sac = 25", "sic = 1", "latitude", "longitude", "height", "--config"):
        assert word in line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--date", "2025-13-01"], ["2025-13-01", "YYYY-MM-DD"]),
        (["--date", "yesterday"], ["yesterday", "YYYY-MM-DD"]),
        (["--from", "half past ten"], ["half past ten", "HH:MM"]),
        (["--to", "25:00"], ["25:00", "HH:MM"]),
        (["--from", "12:00"], ["outside time window"]),  # after the recording's end
        (["--from", "10:00:30", "--to", "10:00:10"], ["--from 10:00:30 is after --to 10:00:10"]),
    ],
)
def test_times_and_dates_that_cannot_be(recording, tmp_path, arguments, words):
    path, config = recording
    line = refused("track", path, "-o", tmp_path / "out", "--config", config, *arguments)
    for word in words:
        assert word in line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (SITE.replace("latitude", "lattitude"), ["lattitude", "latitude"]),
        (SITE.replace("48.0", "480.0"), ["latitude", "480"]),
        ("[tracker]\ngate_probability = 1.5\n", ["gate_probability", "1.5"]),
        ('[filter]\nform = "spherical"\n', ["form", "spherical"]),
        ("[[sensor]\n", ["TOML"]),
    ],
)
def test_configurations_that_cannot_be(recording, tmp_path, content, words):
    path, _ = recording
    config = tmp_path / "wrong.toml"
    config.write_text(content)
    line = refused("track", path, "-o", tmp_path / "out", "--config", config)
    for word in ("wrong.toml", *words):
        assert word in line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("rows", "why"),
    [
        (["0,48.0,11.0", "4,48.0,11.01"], "2 reports with a position can be tracked."),
        (["0,48.0,11.0", "1,48.0,11.001", "2,48.0,11.002"], "the reports last 2 s. Track a longer time"),
        ([f"{4 * k},{48.0 + k % 3},{11.0 + k % 2}" for k in range(9)], "no report has another near it"),
        (
            [f"{40 * (k // 2) + 4 * (k % 2)},48.{k // 2},11.0" for k in range(12)],
            "the longest of 6 begun got 2: is the update period another",
        ),
    ],
)
def test_a_run_without_a_track_says_why_and_writes_its_tables(tmp_path, rows, why):
    (tmp_path / "a.csv").write_text("source,time,latitude,longitude\n" + "".join(f"r,{row}\n" for row in rows))
    (tmp_path / "a.toml").write_text('[[sensor]]\nname = "r"\nperiod = 4.0\nsigma_xy = 30.0\n')
    arguments = ["track", tmp_path / "a.csv", "-o", tmp_path / "out", "--config", tmp_path / "a.toml"]
    result = saltus(*arguments)
    assert result.exit_code == 2, result.output
    (line,) = (line for line in result.stderr.splitlines() if line.startswith("note: no track: "))
    assert "none got 3 reports in 5 update periods" in line and why in line
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["problems"][-1] == line.removeprefix("note: ")
    assert pq.read_table(tmp_path / "out" / "tracks.parquet").num_rows == 0
    assert pq.read_table(tmp_path / "out" / "assignments.parquet").num_rows == len(rows)
    assert (tmp_path / "out" / "report.html").exists()
    assert saltus(*arguments, "--allow-empty").exit_code == 0


def test_track_says_what_it_did(recording, tmp_path):
    path, config = recording
    result = saltus("track", path, "-o", tmp_path / "out", "--config", config, "--no-report")
    assert result.exit_code == 0, result.output
    assert "10 reports read, 10 on 1 confirmed tracks" in result.stdout
    assert str(tmp_path / "out") in result.stdout
    assert result.stderr == ""
