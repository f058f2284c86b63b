"""A set of files takes the place of an older one: at any moment, killed or not, there is the old set or the new one.

Two ways. *Exchange*: the new folder, with links to the user's own files in it, and the old one change names in one
step of the system. *In place*, where that cannot be (the folder is a mount, somebody works in it, its parent is
read-only, it holds folders of the user's own): the complete new set is renamed to a folder within, which decides; then
the old files go, then the new ones come. A reader may find files missing, never files of two sets, and `settle` ends
what a kill has broken off.
"""

import ctypes
import fcntl
import json
import os
import re
import shutil
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import NamedTuple

from saltus.errors import DataError

__all__ = ["MANIFEST", "Stage", "is_stage", "open_stage", "publish", "settle", "sweep"]

MANIFEST = ".saltus.json"  # in a folder of outputs: the files of each set, so that nothing else is ever taken for one
_DECIDED = ".saltus-new"  # in a folder: a complete new set on its way
_STAGE = re.compile(r"\..*\.saltus-\d+-\d+(\.swap)?\.tmp", re.DOTALL)
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2  # fcntl.h and linux/fs.h


class _Manifest(NamedTuple):
    """Which files in a folder of outputs are Saltus's."""

    sets: dict[str, set[str]]  # by kind
    kept: set[str]  # came with the latest set and do not go with it


class Stage(NamedTuple):
    """A temporary folder, locked while the run that fills it lives."""

    path: Path
    lock: int | None  # file descriptor; None where the file system has no locks

    def close(self) -> None:
        """Let go of the lock."""
        if self.lock is not None:
            os.close(self.lock)


def open_stage(place: Path, name: str) -> Stage:
    """Make a temporary folder in `place` for the output `name`."""
    for number in count():
        path = place / f"{_prefix(name)}{os.getpid()}-{number}.tmp"
        try:
            path.mkdir()
        except FileExistsError:
            continue
        with suppress(FileNotFoundError, BlockingIOError):
            lock = _lock(path)
            if path.exists():
                return Stage(path, lock)
        # Another run took it for a leftover between the two steps.
    raise AssertionError  # count() does not end


def publish(stage: Stage, target: Path, kind: str, kept: frozenset[str] = frozenset()) -> None:
    """Put the files of a stage into `target`, in place of the older set of the same kind.

    Args:
        stage: lies in `target` if that exists, else beside it.
        target: folder to fill.
        kind: the command's: sets of other kinds, and all other files in the folder, stay.
        kept: files of the stage that the next set does not replace: recordings that other commands read.

    Raises:
        OSError: `target` cannot be written.
        DataError: a folder has the name of a file to write.
        ValueError: the stage holds a folder; a set is of files.
    """
    if any(p.is_dir() for p in stage.path.iterdir()):
        raise ValueError(f"a set of outputs holds files, no folders: {[p.name for p in stage.path.iterdir()]}.")
    names = {p.name for p in stage.path.iterdir()}
    sets = _read_manifest(target).sets
    others = {k: v - names for k, v in sets.items() if k != kind}
    _write_manifest(stage.path, _Manifest(others | {kind: names - kept}, names & kept))
    if not target.exists():
        os.rename(stage.path, target)
        return
    ours = sets.get(kind, set()) | names | {MANIFEST}
    own = [p for p in target.iterdir() if (p.name not in ours or _is_folder(p)) and not is_stage(p.name)]
    for path in (target / name for name in names):
        if _is_folder(path):
            raise DataError(f"{path}: is a folder where a file is to be written; move it, or name another output.")
    for path in [stage.path, *stage.path.iterdir()]:
        _flush(path)
    if not _exchange(stage.path, target, own):
        _replace_in_place(stage.path, target)


def settle(target: Path) -> None:
    """End what a killed run has begun to put into a folder.

    Raises:
        DataError: that cannot be done, because the folder is read-only.
    """
    if not (target / _DECIDED).is_dir():
        return
    try:
        with _alone(target):
            _roll(target)
    except OSError as error:
        raise DataError(
            f"{target}: the run that filled it was killed while its files took their places, and they cannot be moved "
            f"now ({(error.strerror or str(error)).lower()}); make the folder writable, or run again."
        ) from error


def sweep(place: Path, name: str, target: Path) -> None:
    """Remove temporary folders of killed runs; what of the user's own came to lie in them returns to `target`."""
    try:
        found = [p for p in place.iterdir() if p.name.startswith(_prefix(name)) and is_stage(p.name)]
    except PermissionError:
        return  # a folder that one may enter and not list
    for path in found:
        with suppress(BlockingIOError):  # its run lives
            lock = _lock(path)
            if lock is not None:
                try:
                    _discard(path, target)
                finally:
                    os.close(lock)


def _prefix(name: str) -> str:
    return f".{name}.saltus-"


def is_stage(name: str) -> bool:
    """Say whether a name is that of a temporary folder."""
    return _STAGE.fullmatch(name) is not None


def _is_folder(path: Path) -> bool:
    return path.is_dir() and not path.is_symlink()


def _lock(folder: Path) -> int | None:
    """Lock a folder and return the open file; None on a network file system without locks, where nobody can tell.

    Raises:
        BlockingIOError: another process holds it.
    """
    file = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(file)
        if isinstance(error, BlockingIOError):
            raise
        return None
    return file


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Wait until no other run moves files in the folder, where the file system has locks."""
    file = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        with suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_EX)
        yield
    finally:
        os.close(file)


def _read_manifest(folder: Path) -> _Manifest:
    """Read which files are whose; a list that Saltus did not write lays claim to nothing."""
    try:
        told = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
        return _Manifest({kind: _plain(names) for kind, names in told["sets"].items()}, _plain(told["kept"]))
    except (FileNotFoundError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return _Manifest({}, set())


def _plain(names: object) -> set[str]:
    """Return the names of files in the folder itself, whatever else a list of another's making holds."""
    texts = [name for name in names if isinstance(name, str)] if isinstance(names, list) else []
    return {name for name in texts if name == Path(name).name and name not in ("", "..") and "\0" not in name}


def _write_manifest(folder: Path, manifest: _Manifest) -> None:
    sets = {kind: sorted(names) for kind, names in sorted(manifest.sets.items()) if names}
    text = json.dumps({"sets": sets, "kept": sorted(manifest.kept)}, indent=2)
    (folder / MANIFEST).write_text(text + "\n", encoding="utf-8")


def _flush(path: Path) -> None:
    """Have a file on its medium before the older one goes, so that a power cut leaves one of them too."""
    file = os.open(path, os.O_RDONLY)
    try:
        os.fsync(file)
    finally:
        os.close(file)


def _exchange(stage: Path, target: Path, own: list[Path]) -> bool:
    """Let the stage and the target change names; return whether that could be, else everything is as before."""
    if any(_is_folder(p) for p in own) or _in_use(target):
        return False
    swap = target.with_name(stage.name.removesuffix(".tmp") + ".swap.tmp")
    linked = []
    try:
        for path in own:
            os.link(path, stage / path.name, follow_symlinks=False)
            linked.append(stage / path.name)
        _dress(stage, target)
        os.rename(stage, swap)
        _swap_names(swap, target)
    except BaseException as error:
        if swap.exists():
            os.rename(swap, stage)
        for path in linked:
            path.unlink()
        if isinstance(error, OSError):
            return False
        raise
    with suppress(OSError):  # the new set stands; what cannot be removed now goes with the next run
        _discard(swap, target)
    return True


def _dress(stage: Path, target: Path) -> None:
    """Give the stage the owner and the mode of the folder whose place it takes."""
    wanted, made = target.stat(), stage.stat()
    if (wanted.st_uid, wanted.st_gid) != (made.st_uid, made.st_gid):
        os.chown(stage, wanted.st_uid, wanted.st_gid)
    stage.chmod(stat.S_IMODE(wanted.st_mode))


def _swap_names(one: Path, other: Path) -> None:
    """Exchange two names in one step (renameat2 of Linux).

    Raises:
        OSError: the system or the file system cannot do that.
    """
    library = ctypes.CDLL(None, use_errno=True)
    if not hasattr(library, "renameat2"):
        raise OSError(f"{sys.platform} cannot exchange two names.")
    sys.audit("os.rename", str(one), str(other), -1, -1)
    if library.renameat2(_AT_FDCWD, os.fsencode(one), _AT_FDCWD, os.fsencode(other), _RENAME_EXCHANGE):
        code = ctypes.get_errno()
        raise OSError(code, os.strerror(code), str(one), None, str(other))


def _discard(folder: Path, target: Path) -> None:
    """Remove a temporary folder; what of the user's own is only there, or newer there, moves to `target` first."""
    if folder.name.endswith(".swap.tmp") and target.is_dir():
        old, new = _read_manifest(folder), _read_manifest(target)
        ours = {MANIFEST}.union(new.kept, *old.sets.values(), *new.sets.values())
        for path in [p for p in folder.iterdir() if p.name not in ours]:
            there = target / path.name
            if not os.path.lexists(there):
                os.rename(path, there)
            elif not path.is_dir() and path.lstat().st_mtime_ns > there.lstat().st_mtime_ns:
                os.replace(path, there)
        # Its list may go first; what a kill then leaves must not be taken for the user's own.
        folder = folder.rename(folder.with_name(folder.name.replace(".swap.tmp", ".tmp")))
    shutil.rmtree(folder)


def _in_use(folder: Path) -> bool:
    """Say whether this process works in the folder: whoever started it would find themselves in one that is gone."""
    try:
        return Path.cwd().is_relative_to(folder)
    except FileNotFoundError:
        return False


def _replace_in_place(stage: Path, target: Path) -> None:
    with _alone(target):
        _roll(target)
        os.rename(stage, target / _DECIDED)
        try:
            _roll(target)
        except KeyboardInterrupt:
            _roll(target)  # what is decided is done
            raise


def _roll(target: Path) -> None:
    """Put a decided set into its place: all that is old goes, its list last; then the new files come, their list last.

    Begun anew after a kill it does the rest: what is still in the decided folder has no new file of its name outside.
    """
    decided = target / _DECIDED
    if not decided.is_dir():
        return
    coming = {p.name for p in decided.iterdir()} - {MANIFEST}
    if (decided / MANIFEST).exists():
        old, new = _read_manifest(target).sets, _read_manifest(decided).sets
        for name in sorted(coming.union(*(names - new.get(kind, set()) for kind, names in old.items()))):
            if not _is_folder(target / name):
                (target / name).unlink(missing_ok=True)
        (target / MANIFEST).unlink(missing_ok=True)
        for name in [*sorted(coming), MANIFEST]:
            os.rename(decided / name, target / name)
    decided.rmdir()
