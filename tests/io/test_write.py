"""Outputs appear whole or not at all."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from saltus.errors import DataError
from saltus.io import publish
from saltus.io.publish import MANIFEST
from saltus.io.write import output_directory, output_file


def listing(folder):
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*"))


def test_files_appear_when_the_block_ends(tmp_path):
    target = tmp_path / "new" / "out"
    with output_directory(target) as tmp:
        (tmp / "a.txt").write_text("a")
        (tmp / "b.txt").write_text("b")
        assert not target.exists()
    assert listing(tmp_path / "new") == ["out", "out/.saltus.json", "out/a.txt", "out/b.txt"]
    with pytest.raises(ValueError, match="holds files, no folders"), output_directory(target) as tmp:
        (tmp / "sub").mkdir()


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
    target = tmp_path / "out"
    target.mkdir()
    make, move = Path.mkdir, os.rename

    def mkdir(path, *arguments, **options):
        if path.parent == tmp_path:
            raise PermissionError(13, "Permission denied", str(path))
        make(path, *arguments, **options)

    def rename(source, destination):
        if Path(destination).parent == tmp_path:
            raise PermissionError(13, "Permission denied", str(source), None, str(destination))
        move(source, destination)

    monkeypatch.setattr(Path, "mkdir", mkdir)
    monkeypatch.setattr(os, "rename", rename)
    for files in ("ab", "bc"):
        with output_directory(target) as tmp:
            for name in files:
                (tmp / name).write_text(name)
        assert listing(tmp_path) == ["out", "out/.saltus.json", *(f"out/{name}" for name in files)]
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
    monkeypatch.setattr(os, "rename", fails)
    with pytest.raises(DataError, match="out: cannot be written"), output(tmp_path / "out") as tmp:
        (tmp / "a.txt" if tmp.is_dir() else tmp).write_text("a")


def test_the_root_is_no_output():
    with pytest.raises(DataError, match="root of the file system"), output_directory("/"):
        pass


WAYS = ["exchange", "in place"]


@pytest.fixture(params=WAYS)
def way(request, tmp_path, monkeypatch):
    """Publish by exchange, or in place because somebody works in the folder."""
    (tmp_path / "out").mkdir()
    if request.param == "in place":
        monkeypatch.chdir(tmp_path / "out")
    return request.param


def write(target, kind="track", kept=(), **files):
    with output_directory(target, kind, kept) as tmp:
        for name, text in files.items():
            (tmp / name).write_text(text)


def contents(folder):
    return {p.name: p.read_text() for p in folder.iterdir() if p.is_file() and p.name != MANIFEST}


def test_a_set_goes_with_the_next_of_its_kind(tmp_path, way):
    out = tmp_path / "out"
    (out / "mine").write_text("notes")
    inode = out.stat().st_ino
    write(out, tracks="1", report="1")
    assert (out.stat().st_ino != inode) == (way == "exchange")
    write(out, "noise", noise="1", shared="1")
    write(out, tracks="2", shared="2")
    assert contents(out) == {"mine": "notes", "tracks": "2", "noise": "1", "shared": "2"}
    write(out, "noise", noise="2")
    assert contents(out) == {"mine": "notes", "tracks": "2", "noise": "2", "shared": "2"}
    assert listing(tmp_path) == ["out", *(f"out/{name}" for name in sorted([MANIFEST, *contents(out)]))]


def test_what_is_kept_stays_when_its_set_goes(tmp_path, way):
    out = tmp_path / "out"
    write(out, kept=["recording"], recording="1", tracks="1", report="1")
    write(out, tracks="2")
    assert contents(out) == {"recording": "1", "tracks": "2"}
    os.utime(out / "recording", (4e9, 4e9))  # whatever its time says
    write(out, kept=["recording"], recording="3", tracks="3")
    assert contents(out) == {"recording": "3", "tracks": "3"}


def test_links_modes_and_folders_of_the_users_own_stay(tmp_path, way):
    out = tmp_path / "out"
    (out / "link").symlink_to("nowhere")
    (out / "script").write_text("run")
    (out / "script").chmod(0o750)
    out.chmod(0o751)
    write(out, tracks="1")
    assert (out / "link").is_symlink() and os.readlink(out / "link") == "nowhere"
    assert (out / "script").stat().st_mode & 0o777 == 0o750
    assert out.stat().st_mode & 0o777 == 0o751
    (out / "sub").mkdir()
    (out / "sub" / "deep").write_text("mine")
    inode = (out / "sub").stat().st_ino
    write(out, tracks="2")
    assert (out / "sub").stat().st_ino == inode and (out / "sub" / "deep").read_text() == "mine"
    with pytest.raises(DataError, match="sub: is a folder where a file is to be written"):
        write(out, sub="3")
    (out / "tracks").unlink()
    (out / "tracks").mkdir()  # where an older set had a file
    write(out, report="3")
    assert (out / "tracks").is_dir()
    (out / "tracks").rmdir()
    write(out, tracks="2")
    assert contents(out) == {"script": "run", "tracks": "2"}


def test_a_list_of_somebody_elses_making_deletes_nothing_outside(tmp_path, way):
    out = tmp_path / "out"
    (tmp_path / "precious").write_text("mine")
    for told in (
        {"sets": {"track": ["../precious", "..", ".", "", str(tmp_path / "precious"), "a\0b"]}, "kept": []},
        {"sets": {"track": [1, None]}, "kept": []},
        {"sets": [], "kept": 0},
        [],
    ):
        (out / MANIFEST).write_text(json.dumps(told))
        write(out, tracks="1")
        assert (tmp_path / "precious").read_text() == "mine"
        assert contents(out) == {"tracks": "1"}
    for text in ("{", "[" * 100_000):
        (out / MANIFEST).write_text(text)
        write(out, tracks="1")


def test_what_a_user_saves_meanwhile_is_not_lost(tmp_path, monkeypatch):
    """Between the links and the exchange another program writes a file anew and one more."""
    out = tmp_path / "out"
    write(out, tracks="1")
    (out / "notes").write_text("old")
    os.utime(out / "notes", (1e9, 1e9))
    swap = publish._swap_names

    def meanwhile(one, other):
        (out / "saved").write_text("new")
        os.replace(out / "saved", out / "notes")
        (out / "more").write_text("more")
        swap(one, other)

    monkeypatch.setattr(publish, "_swap_names", meanwhile)
    write(out, tracks="2")
    assert contents(out) == {"tracks": "2", "notes": "new", "more": "more"}


def test_the_folder_of_a_run_that_lives_is_left_alone(tmp_path, way):
    out = tmp_path / "out"
    with output_directory(out, "track") as slow:
        (slow / "tracks").write_text("slow")
        with output_directory(out, "track") as quick:
            (quick / "tracks").write_text("quick")
        assert contents(out) == {"tracks": "quick"}
        (slow / "report").write_text("slow")
    assert contents(out) == {"tracks": "slow", "report": "slow"}
    assert listing(tmp_path) == ["out", "out/.saltus.json", "out/report", "out/tracks"]


def test_the_system_that_cannot_exchange_publishes_in_place(tmp_path, monkeypatch):
    def cannot(one, other):
        raise OSError(22, "Invalid argument")

    out = tmp_path / "out"
    out.mkdir()
    (out / "mine").write_text("notes")
    monkeypatch.setattr(publish, "_swap_names", cannot)
    inode = out.stat().st_ino
    write(out, tracks="1", report="1")
    write(out, tracks="2")
    assert contents(out) == {"mine": "notes", "tracks": "2"}
    assert out.stat().st_ino == inode
    assert listing(tmp_path) == ["out", "out/.saltus.json", "out/mine", "out/tracks"]


def test_a_full_disk_names_the_file(tmp_path):
    """By the limit on the size of a file: the system says so when bytes are written, without a name."""
    code = (
        "import resource, sys, numpy, pyarrow\n"
        "from saltus.errors import DataError\n"
        "from saltus.io.write import output_directory, output_file, write_json, write_table\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n"
        "table = pyarrow.table({'x': numpy.random.default_rng(0).normal(size=5000)})\n"
        "for name, act in (\n"
        "    ('a.parquet', lambda p: write_table(p, table)),\n"
        "    ('b.json', lambda p: write_json(p, list(range(5000)))),\n"
        "    ('c', lambda p: p.write_bytes(bytes(5000))),\n"
        "):\n"
        "    try:\n"
        "        with output_directory('out') as folder: act(folder / name)\n"
        "    except DataError as error: print(error)\n"
        "try:\n"
        "    with output_file('d.json') as path: write_json(path, list(range(5000)))\n"
        "except DataError as error: print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    said = "cannot be written (file too large); make room."
    assert done.stdout.splitlines() == [f"{p}: {said}" for p in ("out/a.parquet", "out/b.json", "out", "d.json")]
    assert listing(tmp_path) == []


def test_a_device_is_written_to_and_not_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    reader = os.open(tmp_path / "pipe", os.O_RDONLY | os.O_NONBLOCK)
    with output_file(tmp_path / "pipe") as path:
        path.write_text("x")
    assert os.read(reader, 10) == b"x"
    os.close(reader)
    with output_file("/dev/null") as path:
        path.write_text("x")
    assert not Path("/dev/null").is_file()
    assert listing(tmp_path) == ["pipe"]
