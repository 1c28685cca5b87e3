"""Words to the operator on standard error, where they do not get into a pipe."""

from __future__ import annotations

import sys

from iort_station.texts import visible


def say(text: str) -> None:
    """Print a line."""
    print(visible(f"iort: {text}"), file=sys.stderr, flush=True)
