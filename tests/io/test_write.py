"""Outputs appear whole or not at all."""

import pytest

from saltus.errors import DataError
from saltus.io.write import output_directory, output_file


def listing(folder):
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*"))


def test_files_appear_when_the_block_ends(tmp_path):
    target = tmp_path / "new" / "out"
    with output_directory(target) as tmp:
        (tmp / "a.txt").write_text("a")
        (tmp / "sub").mkdir()
        (tmp / "sub" / "b.txt").write_text("b")
        assert not target.exists()
    assert listing(tmp_path / "new") == ["out", "out/a.txt", "out/sub", "out/sub/b.txt"]


@pytest.mark.parametrize("failure", [RuntimeError, KeyboardInterrupt])
def test_failure_leaves_the_older_output(tmp_path, failure):
    target = tmp_path / "out"
    target.mkdir()
    (target / "a.txt").write_text("old")
    with pytest.raises(failure), output_directory(target) as tmp:
        (tmp / "a.txt").write_text("half")
        raise failure
    assert listing(tmp_path) == ["out", "out/a.txt"]
    assert (target / "a.txt").read_text() == "old"


def test_success_replaces_what_it_wrote_and_keeps_the_rest(tmp_path):
    target = tmp_path / "out"
    target.mkdir()
    (target / "a.txt").write_text("old")
    (target / "mine.txt").write_text("notes")
    with output_directory(target) as tmp:
        (tmp / "a.txt").write_text("new")
    assert (target / "a.txt").read_text() == "new"
    assert (target / "mine.txt").read_text() == "notes"


def test_a_file_in_the_way_is_refused(tmp_path):
    (tmp_path / "out").write_text("a file")
    with pytest.raises(DataError, match="must be a directory"), output_directory(tmp_path / "out"):
        pass


def test_single_file(tmp_path):
    target = tmp_path / "new" / "plots.ast"
    with output_file(target) as tmp:
        assert tmp.suffix == ".ast"
        tmp.write_bytes(b"x")
    assert listing(target.parent) == ["plots.ast"]
    with pytest.raises(RuntimeError), output_file(target) as tmp:
        tmp.write_bytes(b"half")
        raise RuntimeError
    assert target.read_bytes() == b"x"
    with pytest.raises(DataError, match="nothing was written"), output_file(target):
        pass
    assert listing(target.parent) == ["plots.ast"]
