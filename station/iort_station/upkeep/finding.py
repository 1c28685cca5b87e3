"""What the doctor says: one line for each thing that it looked at."""

from __future__ import annotations

from typing import NamedTuple

OK, WARN, FAIL = "ok", "warn", "fail"


class Finding(NamedTuple):
    """One line; ``todo`` says what to do unless all is well."""

    what: str
    level: str
    text: str
    todo: str = ""


def graded(what: str, text: str, todo: str, *, warn: bool, fail: bool = False) -> Finding:
    """A finding whose level two conditions decide."""
    return Finding(what, FAIL if fail else WARN if warn else OK, text, todo if warn or fail else "")
