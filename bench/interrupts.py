"""Ctrl-C, or the end of the terminal, while something must still be put back."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console

_INTERRUPTS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@contextmanager
def wound_up(console: Console) -> Iterator[None]:
    """An interrupt ends what runs now, in good order; another one does not end the putting in order."""
    asked = False

    def interrupt(_number: int, _frame: object) -> None:
        nonlocal asked
        if asked:
            console.print("still putting back what was changed", style="yellow")
            return
        asked = True
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in _INTERRUPTS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
