"""What the README and the pages of docs/ say is what the package does."""

import importlib.util
import re
import shlex
from pathlib import Path

import click
import pytest
from pyarrow import parquet

from saltus.cli import main
from saltus.config import SensorConfig, load_config
from saltus.gap import load_scenario
from saltus.records import REASONS
from saltus.tracks.output import BEARING, ELSEWHERE, NOT_CONFIRMED, SINGLE, SPLIT

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
TEXT = {page.name: page.read_text(encoding="utf-8") for page in PAGES}


def blocks(page, language):
    return re.findall(rf"^```{language}\n(.*?)^```", TEXT[page], re.MULTILINE | re.DOTALL)


def cells(section):
    """First cells of the rows of a page's tables, the names in them."""
    return [name for row in re.findall(r"^\| (`.*?) \|", section, re.MULTILINE) for name in re.findall(r"`(.*?)`", row)]


@pytest.mark.parametrize("page", [name for name in TEXT if "```python\n" in TEXT[name]])
def test_python_of_a_page_runs_from_top_to_bottom(page, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "documentation"}
    for source in blocks(page, "python"):
        exec(compile(source, page, "exec"), names)
    assert capsys.readouterr().out


def test_example_of_the_readme_is_short_and_tells_the_turn():
    (source,) = blocks("README.md", "python")
    assert len(source.splitlines()) <= 12
    names = {}
    exec(compile(source, "README.md", "exec"), names)
    for chain in ("manoeuvre", "radar"):
        prob = names["est"].prob(chain)
        assert prob.shape == (30, 2)
        assert prob.sum(-1) == pytest.approx(1.0)
    assert names["est"].prob("manoeuvre")[0, 1] < 0.3 < 0.7 < names["est"].prob("manoeuvre")[-1, 1]


def test_readme_is_short():
    assert len(TEXT["README.md"].splitlines()) <= 120


def shown_commands():
    """Page, command line, and whether it is only mentioned in a sentence (arguments may then be left out)."""
    for page, text in TEXT.items():
        for block in blocks(page, "console"):
            yield from ((page, line[2:], False) for line in block.splitlines() if line.startswith("$ "))
        yield from ((page, line, True) for line in re.findall(r"`(saltus [a-z]+[^`<\n]*)`", text))


@pytest.mark.parametrize(("page", "line", "mentioned"), sorted(set(shown_commands())))
def test_commands_shown_exist_with_their_options(page, line, mentioned):
    program, name, *words = shlex.split(line, comments=True)
    if program == "make":
        assert re.search(rf"^{name}:", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
        return
    assert program == "saltus"
    try:
        main.commands[name].make_context(name, words)
    except click.MissingParameter:
        assert mentioned


def test_an_option_that_does_not_exist_would_be_found():
    with pytest.raises(click.NoSuchOption):
        main.commands["track"].make_context("track", ["a.ast", "-o", "out", "--colour", "red"])


@pytest.mark.parametrize(
    ("page", "source"), [(page, source) for page in TEXT for source in blocks(page, "toml")], ids=lambda v: v[:20]
)
def test_configurations_shown_are_accepted(page, source, tmp_path):
    path = tmp_path / "shown.toml"
    path.write_text(source, encoding="utf-8")
    if page == "optimality_gap.md":
        assert load_scenario(path).steps > 0
    else:
        assert load_config(path).sensor


def test_every_key_of_a_sensor_is_explained():
    section = TEXT["configuration.md"].partition("## `[[sensor]]`")[2].partition("\n## ")[0]
    assert sorted(cells(section)) == sorted(SensorConfig.model_fields)


def test_columns_explained_are_the_columns_written(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "documentation"}
    for source in blocks("quickstart.md", "python"):
        exec(compile(source, "quickstart.md", "exec"), names)
    capsys.readouterr()
    for file in ("tracks", "assignments", "identifications"):
        section = TEXT["formats.md"].partition(f"### `{file}.parquet`")[2].partition("\n### ")[0]
        explained = cells(section)
        written = parquet.read_schema(tmp_path / "out" / f"{file}.parquet")
        assert explained == written.names


def test_every_reason_is_explained():
    section = TEXT["formats.md"].partition("### Why a report is not a plot")[2].partition("\n## ")[0]
    wanted = {*REASONS, BEARING, SPLIT, ELSEWHERE, SINGLE, NOT_CONFIRMED} - {"", "status message"}
    assert set(cells(section)) == wanted


def test_the_house_has_a_word_for_every_module_of_the_contract():
    spec = importlib.util.spec_from_file_location("house", ROOT / "docs/house.py")
    house = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(house)
    modules = {name for layer in house.layers() for name in layer}
    assert modules <= set(house.WORDS)
    drawing = house.draw()
    assert all(f">{name}</text>" in drawing for name in modules)


def test_links_between_pages_lead_somewhere():
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#:\s]+)\)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_equations_cited_are_numbered():
    labels = {label for text in TEXT.values() for label in re.findall(r"^\$\$ \((.+)\)$", text, re.MULTILINE)}
    cited = {label for text in TEXT.values() for label in re.findall(r"\{eq\}`(.+?)`", text)}
    assert cited and cited <= labels
