"""Outputs appear whole or not at all."""

import os
import tempfile
from pathlib import Path

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


def test_a_folder_is_filled_though_nothing_may_be_written_beside_it(tmp_path, monkeypatch):
    target, make = tmp_path / "out", tempfile.mkdtemp
    target.mkdir()

    def only_inside(**options):
        if Path(options["dir"]) == tmp_path:
            raise PermissionError(13, "Permission denied", str(tmp_path / ".out.x.tmp"))
        return make(**options)

    monkeypatch.setattr(tempfile, "mkdtemp", only_inside)
    with output_directory(target) as tmp:
        (tmp / "a.txt").write_text("a")
    assert listing(tmp_path) == ["out", "out/a.txt"]
    with pytest.raises(DataError, match=r"new: cannot be written \(permission denied\)") as caught:
        with output_directory(tmp_path / "new"):
            pass
    assert ".tmp" not in str(caught.value)


@pytest.mark.parametrize("output", [output_directory, output_file])
def test_what_cannot_be_written_names_what_the_user_gave(tmp_path, monkeypatch, output):
    (tmp_path / "afile").write_text("mine")
    with pytest.raises(DataError, match=r"afile/x/y: .*afile is a file"), output(tmp_path / "afile" / "x" / "y"):
        pass

    def full(tmp):
        raise OSError(28, "No space left on device", str(tmp))

    with pytest.raises(DataError, match=r"out: cannot be written \(no space left on device\)") as caught:
        with output(tmp_path / "out") as tmp:
            full(tmp)
    assert str(tmp) not in str(caught.value)
    with pytest.raises(FileNotFoundError), output(tmp_path / "out"):
        (tmp_path / "input").read_bytes()  # no fault of the output
    assert listing(tmp_path) == ["afile"]

    def fails(source, target):
        raise IsADirectoryError(21, "Is a directory", str(source), None, str(target))

    monkeypatch.setattr(os, "replace", fails)
    with pytest.raises(DataError, match="out: cannot be written"), output(tmp_path / "out") as tmp:
        (tmp / "a.txt" if tmp.is_dir() else tmp).write_text("a")


def test_the_root_is_no_output():
    with pytest.raises(DataError, match="root of the file system"), output_directory("/"):
        pass


def test_stale_files_go_when_the_new_ones_come(tmp_path):
    for name in ("report.html", "mine.txt"):
        (tmp_path / name).write_text("old")
    with pytest.raises(RuntimeError), output_directory(tmp_path, stale=["report.html"]):
        raise RuntimeError
    assert listing(tmp_path) == ["mine.txt", "report.html"]
    with output_directory(tmp_path, stale=["report.html", "never.was"]) as tmp:
        (tmp / "a.txt").write_text("a")
    assert listing(tmp_path) == ["a.txt", "mine.txt"]
    with output_directory(tmp_path, stale=["a.txt"]) as tmp:
        (tmp / "a.txt").write_text("new")
    assert (tmp_path / "a.txt").read_text() == "new"
