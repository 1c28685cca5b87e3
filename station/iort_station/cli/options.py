"""Options that several commands have, and the ranges of time that they name."""

from __future__ import annotations

import time
from dataclasses import dataclass
from datetime import datetime
from typing import Annotated

import typer
from typing_extensions import Self

from iort_station.cli.progress import say
from iort_station.errors import StationError
from iort_station.times import duration_us, has_zone, time_us

AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Only say what would be done.")]
OneRobot = Annotated[str | None, typer.Option("--robot", help="Only this robot.")]
Token = Annotated[
    str, typer.Option(envvar="PUBNUB_ACCESS_TOKEN", help="PubNub's access token for reading, if needed.")
]
Robot = Annotated[str, typer.Argument(help="The robot's name.")]
Stream = Annotated[str, typer.Argument(help="The stream, for example vesc.")]
Every = Annotated[str | None, typer.Option(help="Combine samples: 100ms, 1s, 1m.")]
From = Annotated[
    str | None,
    typer.Option("--from", help="Start time: -10m, 2026-05-04T10:00:00Z. With --to alone: the beginning."),
]
To = Annotated[str | None, typer.Option("--to", help="End time (exclusive). With --from alone: now.")]
Last = Annotated[str | None, typer.Option("--last", help="The time up to now: 5m, 2h, 7d; or all.")]

_USUAL = "5m"


def names(fields: str | None) -> list[str] | None:
    """The names in a comma-separated list; None for an empty one."""
    return [name.strip() for name in (fields or "").split(",") if name.strip()] or None


def since_us(text: str) -> int:
    """A time in microseconds from ``10m`` (ago) or ISO 8601; raises `StationError`."""
    now_us = time.time_ns() // 1000
    if text[:1].isdigit() and text[-1:].isalpha() and "T" not in text:
        return now_us - duration_us(text)
    return time_us(text, now_us)


def bounds(
    start: str | None, end: str | None, last: str | None, now_us: int
) -> tuple[int | None, int | None]:
    """The range of --from, --to and --last in microseconds; None for an open side.

    Raises `StationError` for a text that is not a time, and if the options contradict one another.
    """
    if last is not None:
        if start is not None or end is not None:
            raise StationError("give --last, or --from and --to")
        return now_us - duration_us(last), None
    start_us = None if start is None else time_us(start, now_us)
    end_us = None if end is None else time_us(end, now_us)
    if start_us is not None and end_us is not None and start_us > end_us:
        raise StationError("the range ends before it starts")
    return start_us, end_us


@dataclass(frozen=True)
class Range:
    """From a time (inclusive) to a time (exclusive), in microseconds; None for an open side."""

    start_us: int | None
    end_us: int | None

    @classmethod
    def of(cls, start: str | None, end: str | None, last: str | None) -> Self:
        """The range of the options; raises `StationError` if they contradict one another."""
        now_us = time.time_ns() // 1000
        if start is None and end is None:
            if last == "all":
                return cls(None, None)
            if last is None:
                say(f"no range is given: the last {_USUAL}; --last all reads everything")
                last = _USUAL
        elif end is None and last is None:
            end = "now"
        for text in (start, end):
            if text is not None and not has_zone(text):
                zone = datetime.now().astimezone()
                say(f"{text} is read as {zone.tzname()} (UTC{zone.strftime('%z')}), this machine's zone")
        start_us, end_us = bounds(start, end, last, now_us)
        return cls(start_us, now_us if end_us is None else end_us)
