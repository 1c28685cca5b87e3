"""Handles Ctrl-C and a closed terminal while changes must still be restored."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from rich.console import Console

_INTERRUPTS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


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
                console.print("still restoring the changes", style="yellow")
            return
        asked = True
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in _INTERRUPTS}
    try:
        yield putting_back
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
