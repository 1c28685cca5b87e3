"""What can go wrong at the operator's station: every error it raises on purpose is one of these."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

_NEAREST = 3


class StationError(Exception):
    """The station cannot do what was asked; the text says why and, where it can, what helps. Several
    arguments are a line each. ``nearest`` are known names that an unknown one may have meant."""

    nearest: tuple[str, ...] = ()

    def __str__(self) -> str:
        return "\n".join(map(str, self.args))


class UsageError(StationError):
    """Nobody could do what was asked: a text that is no time, or options that contradict one another."""


def unknown(problem: str, names: Iterable[str], known: Iterable[str], all_of: str) -> StationError:
    """The error for names that do not exist, with the nearest of the ``known`` ones.

    ``all_of`` is the command that lists all of them.
    """
    there = sorted(set(known))
    near = dict.fromkeys(
        found for name in names for found in difflib.get_close_matches(name, there, n=_NEAREST, cutoff=0)
    )
    hint = f"the nearest: {', '.join(near)}; " if near else ""
    error = StationError(f"{problem}; {hint}`{all_of}` lists all")
    error.nearest = tuple(near)
    return error
