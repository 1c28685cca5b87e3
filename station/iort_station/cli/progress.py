"""A progress bar on standard error for what takes longer than a second; nothing where nobody looks."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

from rich.progress import BarColumn, Progress, TextColumn

from iort_station.cli.console import Console, visible
from iort_station.data.batches import PageProgress

_PATIENCE_S = 1.0


@contextmanager
def reading(what: str, start_us: int | None, end_us: int | None) -> Iterator[PageProgress]:
    """What a reader tells of its pages, shown as the part of the range that has been read."""
    console = Console(stderr=True)
    bar = Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TextColumn("{task.fields[items]:,} items"),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )
    known = start_us is not None and end_us is not None
    task = bar.add_task(what, total=1.0 if known else None, items=0)
    began, items, shown = time.monotonic(), 0, False

    def tell(more: int, last_us: int) -> None:
        nonlocal items, shown
        items += more
        if start_us is not None and end_us is not None:
            done = (last_us - start_us) / max(1, end_us - start_us)
            bar.update(task, completed=min(1.0, max(0.0, done)), items=items)
        else:
            bar.update(task, items=items)
        if not shown and time.monotonic() - began > _PATIENCE_S:
            shown = True
            bar.start()

    try:
        yield tell
    finally:
        if shown:
            bar.stop()


def say(text: str) -> None:
    """A line on standard error, where it does not get into what is piped on."""
    print(visible(f"iort: {text}"), file=sys.stderr, flush=True)
