"""The options that several verbs have: each has one name and one meaning, in every verb."""

from __future__ import annotations

import functools
import inspect
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

import typer

from iort_contract.catalog.derived import DERIVED
from iort_station import kept
from iort_station.cli import completion
from iort_station.cli.words import say
from iort_station.errors import UsageError
from iort_station.times import duration_us, has_zone, is_clock, time_us
from iort_station.upkeep.snapshot import VERSION

Robot = Annotated[str, typer.Argument(help="The robot's name.", autocompletion=completion.robots)]
Stream = Annotated[
    str, typer.Argument(help="The stream, for example vesc.", autocompletion=completion.streams)
]
OneRobot = Annotated[
    str | None, typer.Option("--robot", help="Only this robot.", autocompletion=completion.robots)
]
Fields = Annotated[
    str | None,
    typer.Option(
        "--fields",
        help=f"Only these fields, separated by commas; {' and '.join(DERIVED)} are derived.",
        autocompletion=completion.fields,
    ),
]
Where = Annotated[
    str | None, typer.Option("--where", help="Filter, for example 'speed_mps > 1.2 and fault_code == 0'.")
]
Every = Annotated[str | None, typer.Option("--every", help="Combine samples: 100ms, 1s, 1m.")]
From = Annotated[
    str | None,
    typer.Option(
        "--from", help="Start time: -10m, 20:04, 2026-05-04T10:00:00Z. With --to alone: the beginning."
    ),
]
To = Annotated[str | None, typer.Option("--to", help="End time (exclusive). With --from alone: now.")]
Last = Annotated[str | None, typer.Option("--last", help="The time up to now: 5m, 2h, 7d; or all.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Only say what would be done.")]
Force = Annotated[bool, typer.Option("--force", help="Overwrite what is there.")]
Yes = Annotated[bool, typer.Option("--yes", help="Do not ask. A script must give it.")]
State = Annotated[
    Path | None,
    typer.Option(
        envvar="IORT_STATE", metavar="FOLDER", help="The state folder of `make up`. Default: the user's own."
    ),
]
Token = Annotated[
    str, typer.Option(envvar="PUBNUB_ACCESS_TOKEN", help="PubNub's access token for reading, if needed.")
]
LiveWay = Annotated[
    Literal["pubnub", "iot"] | None,
    typer.Option(
        "--live", help="The way of live messages: PubNub, or AWS IoT's own. Default: the deployment's."
    ),
]
TrackFile = Annotated[
    Path | None,
    typer.Option("--track", metavar="FILE", help="A CSV file of the cars' track, which the page shows."),
]

# The range of a verb that would otherwise read years.
SHORT = "5m"


def to_file(help_text: str) -> Any:
    """The option --out, where a verb writes; its help says what."""
    return typer.Option("--out", "-o", help=help_text)


def state_folder(context: typer.Context, state: Path | None) -> Path:
    """The state folder of the kept cloud that is meant: --state, that of --embedded, or the user's own."""
    embedded: Path | None = context.obj.embedded
    if state is None and embedded is not None and (embedded.parent / VERSION).exists():
        state = embedded.parent
    return (state or kept.folder()).expanduser().absolute()


def running_state(context: typer.Context, state: Path | None) -> Path:
    """The state folder of the cloud that every other verb would use, or of --state.

    Raises `UsageError` if that cloud is one that is thrown away.
    """
    file: Path | None = context.obj.file()
    if state is None and file is not None and not (file.parent / VERSION).exists():
        raise UsageError(
            f"the cloud here is that of {file}, which is thrown away at its end: --state names the folder of "
            f"one of `make up`, by default {kept.folder()}"
        )
    return state_folder(context, file.parent if state is None and file is not None else state)


def agreed(question: str, *, yes: bool) -> None:
    """Ask before something is destroyed; a no ends the command.

    Raises `UsageError` where nobody can answer.
    """
    if yes:
        return
    if not sys.stdin.isatty():
        raise UsageError(f"{question} Nobody can answer here: give --yes")
    typer.confirm(question, abort=True, err=True)


def names(fields: str | None) -> list[str] | None:
    """The names in a comma-separated list; None for an empty one."""
    return [name.strip() for name in (fields or "").split(",") if name.strip()] or None


@dataclass(frozen=True)
class Range:
    """From a time (inclusive) to a time (exclusive), in microseconds; None for an open side."""

    start_us: int | None
    end_us: int | None


@dataclass(frozen=True)
class When:
    """The options --from, --to and --last, as they were given; a verb has them by `ranged`."""

    start: From = None
    end: To = None
    last: Last = None

    def range(self, usual: str = "all") -> Range:
        """The range of the options; ``usual`` is the --last of a verb that got none of them.

        Raises `UsageError` for a text that is not a time, and if the options contradict one another.
        """
        now_us = time.time_ns() // 1000
        if self.start is None and self.end is None:
            if self.last is None and usual != "all":
                say(f"no range is given: the last {usual}; --last all reads everything")
            last = self.last or usual
            return Range(None, None) if last == "all" else Range(now_us - duration_us(last), now_us)
        if self.last is not None:
            raise UsageError("give --last, or --from and --to")
        start_us = None if self.start is None else _time_us(self.start, now_us)
        end_us = now_us if self.end is None else _time_us(self.end, now_us)
        if start_us is not None and start_us > end_us and self.end is not None and is_clock(self.end):
            # That time of day after the start.
            end_us += duration_us("1d")
        if start_us is not None and start_us > end_us:
            raise UsageError("the range ends before it starts")
        return Range(start_us, end_us)


def _time_us(text: str, now_us: int) -> int:
    """Parse a time, and say in which zone if it has none."""
    t_us = time_us(text, now_us)
    if not has_zone(text):
        # Another season may have another offset than today.
        zone = datetime.fromtimestamp(t_us / 1e6).astimezone()
        day = f"{zone:%Y-%m-%d} " if is_clock(text) else ""
        say(f"{text} is read as {day}{zone.tzname()} (UTC{zone.strftime('%z')}), this machine's zone")
    return t_us


def ranged(verb: Callable[..., None]) -> Callable[..., None]:
    """Give a verb the options of its parameter ``when``, which typer does not know how to read."""
    hints = get_type_hints(When, include_extras=True)
    options = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=hint)
        for name, hint in hints.items()
    ]

    @functools.wraps(verb)
    def called(**given: Any) -> None:
        verb(when=When(*(given.pop(name) for name in hints)), **given)

    signature = inspect.signature(verb, eval_str=True)
    parameters: list[inspect.Parameter] = []
    for one in signature.parameters.values():
        parameters += options if one.name == "when" else [one.replace(kind=inspect.Parameter.KEYWORD_ONLY)]
    called.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]  # read by inspect
    called.__annotations__ = {one.name: one.annotation for one in parameters}
    return called
