"""Fixtures shared by all tests."""

import os
from pathlib import Path

import numpy as np
import pytest

# Reference cases and recordings lie beside a developer's checkout; nothing of them is shipped.
_SHARED = Path(os.environ.get("SALTUS_SHARED", Path(__file__).parents[1] / ".." / "shared")).resolve()


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
