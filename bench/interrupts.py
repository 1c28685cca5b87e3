"""Ctrl-C, or the end of the terminal, while something must still be put back."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from rich.console import Console

_INTERRUPTS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@contextmanager
def wound_up(console: Console) -> Iterator[Callable[[], None]]:
    """An interrupt ends what runs now, in good order; another one does not end the putting in order. Nor
    does the first one once the function that this gives was called: what is put back then has begun."""
    asked = False

    def putting_back() -> None:
        nonlocal asked
        asked = True

    def interrupt(_number: int, _frame: object) -> None:
        nonlocal asked
        if asked:
            # The terminal may have gone.
            with suppress(OSError):
                console.print("still putting back what was changed", style="yellow")
            return
        asked = True
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in _INTERRUPTS}
    try:
        yield putting_back
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
