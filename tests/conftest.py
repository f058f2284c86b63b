"""Fixtures shared by all tests."""

import os
from pathlib import Path

import jaxtyping
import numpy as np
import pytest

# Reference cases and recordings lie beside a developer's checkout; nothing of them is shipped.
_SHARED = Path(os.environ.get("SALTUS_SHARED", Path(__file__).parents[1] / ".." / "shared")).resolve()


# Tests of whole runs, which call what other tests check: shapes and types are not checked there: half the time.
_RUNS = {"engine", "fuzz", "studies"}
_RUN_FILES = {
    "test_cli.py",
    "test_convert.py",
    "test_crash.py",
    "test_demo.py",
    "test_docs.py",
    "test_examples.py",
    "test_info.py",
    "test_injection.py",
    "test_placement.py",
    "test_report.py",
    "test_report_systems.py",
    "test_run.py",
    "test_run_edges.py",
    "test_score.py",
    "test_summary.py",
    "test_systems.py",
    "test_fuse.py",
    "test_identity.py",
    "test_lifecycle.py",
    "test_recordings.py",
    "test_sights.py",
    "test_source_conditions.py",
    "test_splits.py",
    "test_dense.py",
    "test_tracker.py",
    "test_tracker_pieces.py",
}


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Check the shapes and types of arguments unless the test is one of whole runs."""
    jaxtyping.config.update("jaxtyping_disable", item.path.parent.name in _RUNS or item.path.name in _RUN_FILES)


@pytest.fixture(scope="session")
def cases():
    """Load a reference case by name; skips where the cases are not at hand."""
    folder = _SHARED / "cases"
    if not folder.is_dir():
        pytest.skip(f"reference cases not found at {folder} (set SALTUS_SHARED)")
    return lambda name: dict(np.load(folder / f"{name}.npz"))


@pytest.fixture(scope="session")
def recordings():
    """Folder of real recordings; skips where they are not at hand."""
    folder = _SHARED / "data"
    if not folder.is_dir():
        pytest.skip(f"recordings not found at {folder} (set SALTUS_SHARED)")
    return folder


@pytest.fixture
def rng():
    return np.random.default_rng(20240501)
