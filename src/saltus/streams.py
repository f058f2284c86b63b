"""The standard streams and the signals of a process, whatever they are connected to."""

import errno
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import NoReturn, TextIO

__all__ = ["Stopped", "silence", "stoppable", "usable_streams", "what_failed"]

_MEND = {
    errno.EMFILE: "; raise the limit on open files (ulimit -n)",
    errno.ENFILE: "; the system has too many files open",
}


class Stopped(KeyboardInterrupt):
    """A signal asked the program to end: what is half-written goes, as after Ctrl-C."""

    def __init__(self, number: int) -> None:
        """Take the number of the signal."""
        super().__init__(signal.Signals(number).name)
        self.number = number


@contextmanager
def stoppable() -> Iterator[None]:
    """Let the signals that end a program (SIGTERM, SIGHUP) unwind it as Ctrl-C does, while the block lasts."""

    def stop(number: int, frame: FrameType | None) -> NoReturn:
        del frame
        raise Stopped(number)

    # One that is ignored stays so, as SIGHUP under nohup; only the main thread may set any.
    main = threading.current_thread() is threading.main_thread()
    mine = [s for s in (signal.SIGTERM, signal.SIGHUP) if main and signal.getsignal(s) == signal.SIG_DFL]
    for number in mine:
        signal.signal(number, stop)
    try:
        yield
    finally:
        for number in mine:
            signal.signal(number, signal.SIG_DFL)


def usable_streams() -> None:
    """Let anything be printed: to a stream that was closed, and in letters that the terminal does not know.

    A descriptor that was closed at the start (`>&-`) would be given to the next file opened, and what a library prints
    would land in that file.
    """
    while True:
        file = os.open(os.devnull, os.O_RDWR)
        if file > 2:
            os.close(file)
            break
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "r" if name == "stdin" else "w", encoding="utf-8"))
    if hasattr(sys.stdout, "reconfigure"):
        sys.stdout.reconfigure(errors="backslashreplace")  # as Python does for standard error


def silence(stream: TextIO) -> None:
    """Send a stream that nobody reads, or that cannot be written, nowhere: Python flushes it once more at the end."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)


def what_failed(error: OSError) -> str:
    """Say what happened, and to which file; libraries raise some with nothing but a path."""
    if error.strerror is None:
        kinds = {FileNotFoundError: "no such file", PermissionError: "permission denied"}
        what = next((text for kind, text in kinds.items() if isinstance(error, kind)), "reading or writing failed")
        return f"{what}: {error}"
    where = "" if error.filename is None else f": {os.fsdecode(error.filename)}"
    return f"{error.strerror}{where}{_MEND.get(error.errno or 0, '')}"
