"""Progress on standard error: a bar, if somebody looks."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from iort_station.cli.console import errors

if TYPE_CHECKING:
    from rich.progress import Progress, ProgressColumn

    from iort_analysis.archive.stored import PageProgress

# A bar that would be gone sooner is not shown.
_PATIENCE_S = 1.0


@contextmanager
def bar(title: str, total: float | None, *columns: ProgressColumn) -> Iterator[Callable[[float], None]]:
    """Show a bar; the function given adds to what is done."""
    progress = _progress(*columns)
    task = progress.add_task(title, total=total)
    try:
        if errors.is_terminal:
            progress.start()
        yield lambda more: progress.advance(task, more)
    finally:
        _stop(progress)


@contextmanager
def reading(title: str, start_us: int | None, end_us: int | None) -> Iterator[PageProgress]:
    """Show how much of a range has been read, if that takes longer than a second."""
    if not errors.is_terminal:
        yield lambda _more, _last_us: None
        return
    # It takes longer to load than a minute of samples to read.
    from rich.progress import TextColumn  # noqa: PLC0415 - see above

    progress = _progress(TextColumn("{task.fields[items]:,} items"))
    range_us = (start_us, end_us - start_us) if start_us is not None and end_us is not None else None
    task = progress.add_task(title, total=1.0 if range_us else None, items=0)
    began, items = time.monotonic(), 0

    def tell(more: int, last_us: int) -> None:
        nonlocal items
        items += more
        share = (last_us - range_us[0]) / max(1, range_us[1]) if range_us else 0.0
        progress.update(task, completed=min(1.0, max(0.0, share)), items=items)
        if time.monotonic() - began > _PATIENCE_S:
            progress.start()

    try:
        yield tell
    finally:
        _stop(progress)


def _progress(*columns: ProgressColumn) -> Progress:
    from rich.progress import BarColumn, Progress, TextColumn  # noqa: PLC0415 - as above

    shown = (TextColumn("{task.description}", markup=False), BarColumn(), *columns)
    return Progress(*shown, console=errors, transient=True)


def _stop(progress: Progress) -> None:
    # Where nothing was shown, rich would print an empty line.
    if progress.live.is_started:
        progress.stop()
