"""`saltus track` killed at any moment and taken up again: the same bytes as in one go."""

import json
import signal
import subprocess
import sys

import numpy as np
import pytest
from click.testing import CliRunner
from engine_scenes import demo_start

from saltus.cli import main

TABLES = ("tracks.parquet", "assignments.parquet", "identifications.parquet", "biases.json")
EVERY = ("--checkpoint-every", "40", "--chunk", "200", "--no-report")


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A simulated recording of two radars, a minute of it for the setup, and its outputs in one go."""
    folder = tmp_path_factory.mktemp("killed")
    files, config = demo_start(folder, 5)
    inputs = [*files, "--config", str(config)]
    result = CliRunner().invoke(main, ["track", *inputs, "-o", str(folder / "whole"), "--no-report"])
    assert result.exit_code == 0, result.output
    return folder, inputs


def same_outputs(a, b):
    for name in TABLES:
        assert (a / name).read_bytes() == (b / name).read_bytes(), name
    summaries = [json.loads((folder / "summary.json").read_text()) for folder in (a, b)]
    for summary in summaries:
        del summary["seconds"], summary["problems"]
    assert summaries[0] == summaries[1]


@pytest.mark.parametrize("chunk", [137, 50_000])
def test_the_size_of_the_pieces_changes_no_byte(recording, tmp_path, chunk):
    folder, inputs = recording
    result = CliRunner().invoke(main, ["track", *inputs, "-o", str(tmp_path), "--no-report", "--chunk", str(chunk)])
    assert result.exit_code == 0, result.output
    same_outputs(folder / "whole", tmp_path)


def test_killed_at_any_moment_and_resumed(recording, tmp_path):
    """Killed from outside at random moments, while states are written above all, until a run comes through."""
    folder, inputs = recording
    state, out = tmp_path / "state", tmp_path / "out"
    arguments = [*inputs, "-o", out, "--checkpoint", state, *EVERY]
    resume, codes = [], []
    rng = np.random.default_rng(1)
    for moment in (*rng.integers(1, 8, 6).tolist(), 10**6):
        run = subprocess.run(
            [sys.executable, "-c", KILLED, str(moment), "track", *map(str, arguments), *resume], capture_output=True
        )
        codes.append(run.returncode)
        assert run.returncode in (0, -signal.SIGKILL), run.stderr.decode()
        assert out.exists() == (run.returncode == 0)
        if run.returncode == 0:
            break
        resume = ["--resume"]
    assert codes.count(-signal.SIGKILL) >= 3
    same_outputs(folder / "whole", out)


# Killed a moment after the piece, counted from the start of the program, that its first argument tells.
KILLED = """
import os, signal, sys, threading
from saltus.engine import Session
moment, feed = int(sys.argv.pop(1)), Session.feed
def fed(self, *rest):
    global moment
    told = feed(self, *rest)
    moment -= 1
    if moment == 0:
        threading.Timer(0.01, os.kill, (os.getpid(), signal.SIGKILL)).start()
    return told
Session.feed = fed
from saltus.cli import main
main()
"""


def test_ctrl_c_saves_the_state(recording, tmp_path):
    folder, inputs = recording
    state, out = tmp_path / "state", tmp_path / "out"
    arguments = [
        *inputs,
        "-o",
        out,
        "--checkpoint",
        state,
        "--checkpoint-every",
        "1e9",
        "--chunk",
        "100",
        "--no-report",
    ]
    code = (
        "import os, signal; from saltus.engine import Session; feed = Session.feed\n"
        "def fed(self, *rest):\n"
        "    told = feed(self, *rest)\n"
        "    if self.reports >= 1500: os.kill(os.getpid(), signal.SIGINT)\n"
        "    return told\n"
        "Session.feed = fed; from saltus.cli import main; main()"
    )
    done = subprocess.run([sys.executable, "-c", code, "track", *map(str, arguments)], capture_output=True, text=True)
    assert done.returncode == 130
    assert f"interrupted; the state is saved in {state}; go on from there with --resume" in done.stderr
    assert not out.exists()
    result = CliRunner().invoke(main, ["track", *map(str, arguments), "--resume"])
    assert result.exit_code == 0, result.output
    assert "went on from report 1500" in result.output
    same_outputs(folder / "whole", out)


def test_other_inputs_and_options_are_not_taken_for_the_same(recording, tmp_path):
    _, inputs = recording
    state = tmp_path / "state"
    arguments = ["track", *inputs, "-o", str(tmp_path / "out"), "--checkpoint", str(state), *EVERY]
    first = CliRunner().invoke(main, [*arguments, "--resume"])
    assert first.exit_code == 0 and "holds no state yet: begun from the first report" in first.output
    other = CliRunner().invoke(main, [*arguments, "--resume", "--identity", "ignore"])
    assert other.exit_code == 2 and "changed since are --identity" in other.output
    alone = CliRunner().invoke(main, ["track", *inputs, "-o", str(tmp_path / "out"), "--resume"])
    assert alone.exit_code == 2 and "--resume goes on from the state that --checkpoint DIR saved" in alone.output
