"""Fixtures shared by all tests, and how annotations are executed in them."""

import functools
import os
import types
import typing
from pathlib import Path

import beartype
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

_PLAIN = beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))
_SHAPED = jaxtyping.jaxtyped


def _has_shape(annotation):
    if isinstance(annotation, list | tuple):
        return any(map(_has_shape, annotation))
    if isinstance(annotation, type) and issubclass(annotation, jaxtyping.AbstractArray):
        return True
    return _has_shape(typing.get_args(annotation))


def _resolve(function):
    """Resolve annotations that are text; what is imported for the type checker alone can be anything here."""
    for name, annotation in function.__annotations__.items():
        alone = types.SimpleNamespace(__annotations__={name: annotation})
        try:
            function.__annotations__ |= typing.get_type_hints(alone, function.__globals__, include_extras=True)
        except NameError:
            function.__annotations__[name] = typing.Any


def _checked(*, typechecker):
    """What the import hook wraps Saltus in: as much is checked as by jaxtyping's own wrapper, at a fifth of the cost.

    Arguments are checked once and not again with the result, and only shapes need a memory of axes.
    """

    def decorated(what):
        if isinstance(what, type):
            return _SHAPED(typechecker=typechecker)(what)
        _resolve(what)
        checked, config = _PLAIN(what), jaxtyping.config
        if _has_shape(list(what.__annotations__.values())):
            checked = _SHAPED(typechecker=None)(checked)

        @functools.wraps(what)
        def either(*args, **options):
            return (what if config.jaxtyping_disable else checked)(*args, **options)

        return either

    return decorated


jaxtyping.jaxtyped = _checked


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
