"""`iort errors` and `iort replay-errors`: rejected messages, and putting them back."""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict
from typing import Annotated, Any

import typer
from rich.text import Text

from iort_station.cli.console import errors, out, print_json
from iort_station.cli.options import AsJson, DryRun, OneRobot, since_us
from iort_station.cli.progress import bar
from iort_station.cloud import Cloud
from iort_station.operations import quarantine, replay
from iort_station.operations.quarantine import DeadLetter
from iort_station.operations.replay import Fate
from iort_station.times import iso_s

commands = typer.Typer()
_HEX_WIDTH = 16
Since = Annotated[str | None, typer.Option(help="Last seen since: 10m, 2h, 3d, or ISO 8601.")]


@commands.command("errors")
def errors_(
    context: typer.Context,
    entry_id: Annotated[
        str | None, typer.Argument(metavar="ID", help="Show this message with its bytes.")
    ] = None,
    robot: OneRobot = None,
    since: Since = None,
    as_json: AsJson = False,
) -> None:
    """List the messages that were rejected or could not be processed, or show one."""
    cloud = context.obj.cloud()
    if entry_id is not None:
        _show(quarantine.find(cloud, entry_id), as_json=as_json)
        return
    found = _entries(cloud, robot, since, lambda entry: entry.last_ms)
    waiting = quarantine.waiting(cloud)
    if as_json:
        print_json({"entries": [_as_json(entry) for entry in found], "waiting": asdict(waiting)})
        return
    for entry in found:
        _print(entry)
    if not found:
        out.print("nothing in quarantine" + (f" of {robot}" if robot else ""))
    if waiting.rejected:
        errors.print(f"{waiting.rejected} more on the way into the table")
    if waiting.last:
        errors.print(f"{waiting.last} that the table did not take: `iort replay-errors` tries again")


@commands.command("replay-errors")
def replay_errors(
    context: typer.Context,
    robot: OneRobot = None,
    since: Since = None,
    dry_run: DryRun = False,
    again: Annotated[
        bool, typer.Option("--again", help=f"Also messages replayed {replay.MAX_REPLAYS} times already.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Put the record lane's messages back, and delete those that arrive. Exit status 1 if any fails again."""
    cloud = context.obj.cloud()
    if not dry_run and (moved := quarantine.recover(cloud)):
        errors.print(f"{moved} messages that the table did not take are on the way to it again")
    found = _entries(cloud, robot, since, lambda entry: entry.first_ms)
    outcomes = []
    with bar("putting back", len(found)) as progress:
        for outcome in replay.replay(cloud, found, dry_run=dry_run, again=again):
            outcomes.append(outcome)
            progress(1)
    if as_json:
        print_json([{**_as_json(o.letter), "fate": o.fate.value, "detail": o.detail} for o in outcomes])
    else:
        for outcome in outcomes:
            if outcome.fate not in (Fate.REPLAYED, Fate.NOT_FOR_REPLAY):
                detail = f": {outcome.detail}" if outcome.detail else ""
                line = f"{outcome.letter.id}  {outcome.letter.robot}  {outcome.fate.value}{detail}"
                out.print(_one_line(line), soft_wrap=True)
        counts = Counter(outcome.fate for outcome in outcomes)
        out.print(", ".join(f"{n} {fate.value}" for fate, n in counts.items()) or "nothing in quarantine")
    if any(outcome.fate is Fate.FAILED for outcome in outcomes):
        raise typer.Exit(1)


def _entries(
    cloud: Cloud, robot: str | None, since: str | None, at: Callable[[DeadLetter], int]
) -> list[DeadLetter]:
    since_ms = 0 if since is None else since_us(since) // 1000
    return sorted(quarantine.entries(cloud, robot=robot, since_ms=since_ms), key=lambda e: (at(e), e.id))


def _print(entry: DeadLetter) -> None:
    """Print two lines: reasons are too long for a table in a narrow terminal."""
    times = f"{entry.seen} times" + (f", {entry.replays} replays" if entry.replays else "")
    out.print(
        Text.assemble((entry.id, "bold"), f"  {_utc(entry.last_ms)}  {entry.robot}  {times}"), soft_wrap=True
    )
    where = " ".join(filter(None, (entry.source, entry.topic)))
    out.print(f"    {where}: {_one_line(entry.reason)}", soft_wrap=True)


def _one_line(text: str) -> str:
    return "".join(character if character.isprintable() else " " for character in text)


def _show(entry: DeadLetter, *, as_json: bool) -> None:
    payload = entry.payload or b""
    if as_json:
        print_json({**_as_json(entry), "payload_base64": base64.b64encode(payload).decode()})
        return
    for name, value in (
        ("id", entry.id),
        ("robot", entry.robot),
        ("topic", entry.topic),
        ("refused by", entry.source),
        ("reason", entry.reason),
        ("first", _utc(entry.first_ms)),
        ("last", f"{_utc(entry.last_ms)}, {entry.seen} times, {entry.replays} replays"),
        ("bytes", str(len(payload))),
    ):
        out.print(Text.assemble((f"{name:<11}", "bold"), value), soft_wrap=True)
    out.print()
    out.print(as_text(payload), soft_wrap=True)


def as_text(payload: bytes) -> str:
    """The bytes as text, or if they are not text, in hexadecimal with ASCII beside it."""
    try:
        text = payload.decode()
    except UnicodeDecodeError:
        text = "\0"
    # A terminal would obey control characters.
    if all(character.isprintable() or character in "\n\t" for character in text):
        return text
    lines = []
    for start in range(0, len(payload), _HEX_WIDTH):
        line = payload[start : start + _HEX_WIDTH]
        shown = "".join(chr(byte) if 32 <= byte < 127 else "." for byte in line)
        lines.append(f"{start:06x}  {line.hex(' '):<{3 * _HEX_WIDTH}} {shown}")
    return "\n".join(lines)


def _as_json(entry: DeadLetter) -> dict[str, Any]:
    return {name: value for name, value in asdict(entry).items() if name != "payload"}


def _utc(ms: int) -> str:
    return iso_s(ms * 1000)
