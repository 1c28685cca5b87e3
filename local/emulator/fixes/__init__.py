"""The differences between ministack and AWS for which no small patch exists (local/patches/).

A fix is a function `close_<name>` of a module here, which closes the difference in this process; its
docstring says what AWS does, what ministack does instead, which test shows it, and why it has no patch. The
code wraps private functions of ministack, which is pinned. tests/local/emulator/test_fixes.py fails when a
new release has changed one of them, so that somebody looks whether the fix is still needed. It uses the
contract and the ledger, nothing else of this project.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib import import_module

# In the order of their installation, as are the functions of each: a later wrapper is around an earlier one.
_MODULES = ("broker", "invocations", "stream_retries", "tables", "storage", "metrics", "alarms")


def every() -> Iterator[tuple[str, Callable[[], None]]]:
    """The name of each difference, and what closes it in this process. Only here is ministack imported."""
    for module in _MODULES:
        for name, value in vars(import_module(f"{__name__}.{module}")).items():
            if name.startswith("close_"):
                yield f"{module}.{name.removeprefix('close_')}", value


def install() -> None:
    """Close every difference in this process, before the emulator starts."""
    for _, close in every():
        close()
