"""The committed tables are what the script writes from libasterix, and reading does without the library."""

import importlib.util
import subprocess
import sys
from importlib.resources import files
from pathlib import Path

import pytest

from saltus.asterix.layout import categories

SCRIPT = Path(__file__).parents[2] / "scripts" / "asterix_tables.py"


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("asterix_tables", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("category", categories())
def test_tables_are_those_of_the_library(script, category):
    written = (files("saltus.asterix") / "tables" / f"cat{category:03d}.json").read_text(encoding="utf-8")
    assert written == script.lines(script.tables(category))


def test_reading_does_without_the_library():
    code = "import sys, saltus.io.asterix, saltus.io.asterix_write; sys.exit('asterix' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
