"""Words to the operator: on standard error, where they do not get into a pipe, and in the help."""

from __future__ import annotations

import sys

from iort_station.texts import visible


def say(text: str) -> None:
    """Print a line."""
    print(visible(f"iort: {text}"), file=sys.stderr, flush=True)


def examples(*commands: str) -> str:
    """The end of a verb's help: commands that work as they are. Tests run them."""
    # The first line keeps click from joining the others.
    return "\n".join(["\b", "Examples:", *(f"  iort {command}" for command in commands)])
