"""What commands share: progress, confirmation, an orderly end, and tables."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass

import rich.table
from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.prompt import Confirm

Row = Sequence[str]
_INTERRUPTS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def progress(console: Console) -> Progress:
    """Bars of what is done, how long it took and how long the rest takes."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    return Progress(*columns, TimeRemainingColumn(), console=console)


def confirm(console: Console, text: str, error: type[Exception]) -> None:
    """Say what the run will do, and ask. Raises the error without a terminal, or if the answer is no."""
    console.print(text, highlight=False)
    if not sys.stdin.isatty():
        raise error("no terminal to ask for confirmation: use --yes (`make ... YES=1`)")
    if not Confirm.ask("Go on?", console=console, default=False):
        raise error("not confirmed: nothing was done")


@contextmanager
def wound_up(console: Console) -> Iterator[Callable[[], None]]:
    """Let the first interrupt stop the work in good order, and ignore further ones during the cleanup.

    Yields a function that announces the cleanup: after its call even the first interrupt is ignored.
    """
    asked = False

    def putting_back() -> None:
        nonlocal asked
        asked = True

    def interrupt(_number: int, _frame: object) -> None:
        nonlocal asked
        if asked:
            # The terminal may have gone.
            with suppress(OSError):
                console.print("still cleaning up", style="yellow")
            return
        asked = True
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in _INTERRUPTS}
    try:
        yield putting_back
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@dataclass(frozen=True)
class Table:
    """A table: cells are text. ``**text**`` is bold in Markdown, and makes a row red on a terminal."""

    title: str
    head: Row
    rows: Sequence[Row]

    def as_markdown(self) -> str:
        """Return the table without its title."""
        lines = [self.head, ["---", *["---:"] * (len(self.head) - 1)], *self.rows]
        return "\n".join(
            "| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines
        )

    def show(self, console: Console) -> None:
        shown = rich.table.Table(title=self.title, title_justify="left", title_style="bold")
        for i, name in enumerate(self.head):
            shown.add_column(name, justify="right" if i else "left")
        for row in self.rows:
            cells = [escape(cell.replace("**", "")) for cell in row]
            shown.add_row(*cells, style="red" if any(cell.startswith("**") for cell in row) else "")
        console.print(shown)
