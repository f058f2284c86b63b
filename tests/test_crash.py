"""A run that is killed leaves the old set of outputs or the new one, never one of each."""

import json
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.parametrize("way", ["exchange", "in-place"])
def test_a_kill_leaves_the_old_set_or_the_new_one(way):
    """In a process of its own, which forks: `make crash` does the same to whole runs of the tracker, 200 times."""
    script = Path(__file__).with_name("crashing.py")
    arguments = ["--of", "files", "--way", way, "--kills", "40"]
    done = subprocess.run([sys.executable, script, *arguments], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["mixed"] == 0 and found["left behind"] == []
    assert found["crash points"] > 12 and found["old"] > 5 and found["new"] > 2
    assert (found["part"] > 3) == (way == "in-place")
