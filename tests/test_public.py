"""What the package offers is what can be imported, and importing it costs nothing."""

import importlib
import pkgutil
import subprocess
import sys

import pytest

import saltus

MODULES = sorted(
    m.name
    for m in pkgutil.walk_packages(saltus.__path__, "saltus.")
    if not m.name.rpartition(".")[2].startswith("_")  # __main__ runs the program; compiled parts are private
)


def test_list_of_names_is_sorted_and_short():
    assert saltus.__all__ == sorted(set(saltus.__all__))
    assert len(saltus.__all__) <= 40
    assert dir(saltus) == sorted([*saltus.__all__, "__version__"])


@pytest.mark.parametrize("name", saltus.__all__)
def test_every_name_of_the_root_is_importable_and_belongs_to_its_module(name):
    value = getattr(saltus, name)
    home = importlib.import_module(saltus._EXPORTS[name])
    assert value is getattr(home, name)
    assert name in home.__all__


def test_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'saltus' has no attribute 'kalman'"):
        saltus.kalman  # noqa: B018
    with pytest.raises(ImportError):
        from saltus import kalman  # noqa: F401


def test_version_is_the_distribution_s():
    from importlib.metadata import version

    assert saltus.__version__ == version("saltus")


@pytest.mark.parametrize("module", MODULES)
def test_every_module_lists_what_it_offers(module):
    loaded = importlib.import_module(module)
    assert hasattr(loaded, "__all__"), f"{module} has no __all__"
    assert len(set(loaded.__all__)) == len(loaded.__all__)
    missing = [name for name in loaded.__all__ if not hasattr(loaded, name)]
    assert not missing


def imported_by(statement):
    """Top-level modules that a fresh interpreter has after `statement`, beyond those it starts with."""
    code = f"import sys; before = set(sys.modules); {statement}; print(*sorted(set(sys.modules) - before))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return {name.partition(".")[0] for name in done.stdout.split()}


HEAVY = {"numpy", "scipy", "pyarrow", "matplotlib", "pyproj", "jinja2", "rich", "pydantic", "asterix"}


def test_importing_the_package_imports_none_of_the_numerics():
    loaded = imported_by("import saltus; dir(saltus)")
    assert "saltus" in loaded and not loaded & HEAVY


def test_program_starts_without_the_numerics():
    loaded = imported_by("import saltus.cli")
    assert "saltus" in loaded and not loaded & HEAVY


def test_filters_need_numpy_alone():
    assert imported_by("from saltus import imm_filter") & HEAVY == {"numpy"}
