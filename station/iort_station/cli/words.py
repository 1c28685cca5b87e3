"""Words to the operator: on standard error, where they do not get into a pipe, and in the help."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from iort_station.texts import one_line
from iort_station.times import iso_s

if TYPE_CHECKING:
    from iort_contract.messages.page import Archived


def say(*lines: str) -> None:
    """Print a text, or several lines. What a robot has said begins no line of its own."""
    print("iort: " + "\n".join(map(one_line, lines)), file=sys.stderr, flush=True)


def examples(*commands: str) -> str:
    """The end of a verb's help: commands that work as they are. Tests run them."""
    # The first line keeps click from joining the others.
    return "\n".join(["\b", "Examples:", *(f"  iort {command}" for command in commands)])


def say_refused(count: int, reason: str) -> None:
    """Say what is stored and cannot be read, if there is something; ``reason`` names the first."""
    if count:
        say(f"{count:,} stored items cannot be read and are left out; the first: {reason}")


def say_archived(archived: Archived | None) -> None:
    """Say what came from the archive, if something did."""
    if archived is not None:
        hours = "an hour" if archived["hours"] == 1 else f"{archived['hours']:,} hours"
        say(f"{hours} from the archive, {iso_s(archived['from_us'])} to {iso_s(archived['to_us'])}")
