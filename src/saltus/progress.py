"""Progress of long jobs: a bar on a terminal, nothing elsewhere."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from saltus.text import shown

if TYPE_CHECKING:
    import rich.progress

__all__ = ["Progress", "progress_bar"]


class Progress:
    """One line per stage of a job; shows nothing when made without a display."""

    def __init__(self, display: "rich.progress.Progress | None" = None) -> None:
        """Draw on a display, or not at all."""
        self._display = display
        self._tasks: dict[str, rich.progress.TaskID] = {}

    def reading(self, file: str, share: float) -> None:
        """Show that a share (0 to 1) of a file is read."""
        self.working(f"reading {file}", share)

    def working(self, stage: str, share: float) -> None:
        """Show that a share (0 to 1) of a stage is done."""
        if self._display is None:
            return
        if stage not in self._tasks:
            from rich.markup import escape

            self._tasks[stage] = self._display.add_task(escape(shown(stage)), total=1.0)
        self._display.update(self._tasks[stage], completed=share)


@contextmanager
def progress_bar() -> Iterator[Progress]:
    """Give a `Progress` that draws on the terminal of standard error, if there is one."""
    if not sys.stderr.isatty():
        yield Progress()
        return
    import rich.console
    import rich.progress

    with rich.progress.Progress(console=rich.console.Console(stderr=True), transient=True) as display:
        yield Progress(display)
