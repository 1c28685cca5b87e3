"""`iort errors` and `iort replay-errors`: what was refused, and putting it back."""

from __future__ import annotations

import base64
import json
import sys
from collections import Counter
from dataclasses import asdict
from datetime import datetime, timezone
from typing import Annotated, Any

import typer
from rich.progress import Progress
from rich.text import Text

from iort_station.cli.console import Console
from iort_station.cli.options import since_us
from iort_station.operations import quarantine, replay
from iort_station.operations.quarantine import DeadLetter
from iort_station.operations.replay import Fate

commands = typer.Typer()
_out = Console()
_notes = Console(stderr=True)
_HEX_WIDTH = 16

Robot = Annotated[str | None, typer.Option(help="Of this robot alone.")]
Since = Annotated[str | None, typer.Option(help="Last seen since: 10m, 2h, 3d, or ISO 8601.")]
AsJson = Annotated[bool, typer.Option("--json", help="As JSON.")]


@commands.command("errors")
def errors(
    context: typer.Context,
    entry_id: Annotated[
        str | None, typer.Argument(metavar="ID", help="Show this message with its bytes.")
    ] = None,
    robot: Robot = None,
    since: Since = None,
    as_json: AsJson = False,
) -> None:
    """List the messages that were refused or could not be processed, or show one."""
    cloud = context.obj.cloud()
    if entry_id is not None:
        _show(quarantine.find(cloud, entry_id), as_json=as_json)
        return
    found = sorted(
        quarantine.entries(cloud, robot=robot, since_ms=_since_ms(since)), key=lambda e: (e.last_ms, e.id)
    )
    waiting = quarantine.waiting(cloud)
    if as_json:
        _out.print_json(
            json.dumps({"entries": [_as_json(entry) for entry in found], "waiting": asdict(waiting)})
        )
        return
    for entry in found:
        _print(entry)
    if not found:
        _out.print("nothing in quarantine" + (f" of {robot}" if robot else ""))
    if waiting.rejected:
        _notes.print(f"{waiting.rejected} more on the way into the table")
    if waiting.last:
        _notes.print(f"{waiting.last} that the table did not take: `iort replay-errors` tries again")


@commands.command("replay-errors")
def replay_errors(
    context: typer.Context,
    robot: Robot = None,
    since: Since = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only say what would be done.")] = False,
    again: Annotated[
        bool, typer.Option("--again", help=f"Also what was replayed {replay.MAX_REPLAYS} times already.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Put the record lane's messages back, and delete those that arrive; status 1 if any fails again."""
    cloud = context.obj.cloud()
    if not dry_run and (moved := quarantine.recover(cloud)):
        _notes.print(f"{moved} messages that the table did not take are on the way to it again")
    found = sorted(
        quarantine.entries(cloud, robot=robot, since_ms=_since_ms(since)), key=lambda e: (e.first_ms, e.id)
    )
    outcomes = []
    with Progress(console=_notes, transient=True, disable=not _notes.is_terminal) as bar:
        task = bar.add_task("putting back", total=len(found))
        for outcome in replay.replay(cloud, found, dry_run=dry_run, again=again):
            outcomes.append(outcome)
            bar.advance(task)
    if as_json:
        rows = [{**_as_json(o.letter), "fate": o.fate.value, "detail": o.detail} for o in outcomes]
        _out.print_json(json.dumps(rows))
    else:
        for outcome in outcomes:
            if outcome.fate not in (Fate.REPLAYED, Fate.NOT_FOR_REPLAY):
                detail = f": {outcome.detail}" if outcome.detail else ""
                line = f"{outcome.letter.id}  {outcome.letter.robot}  {outcome.fate.value}{detail}"
                _out.print(_one_line(line), soft_wrap=True)
        counts = Counter(outcome.fate for outcome in outcomes)
        _out.print(", ".join(f"{n} {fate.value}" for fate, n in counts.items()) or "nothing in quarantine")
    if any(outcome.fate is Fate.FAILED for outcome in outcomes):
        sys.exit(1)


def _since_ms(text: str | None) -> int:
    """The time in ms since the epoch; raises `StationError` for what is none."""
    return 0 if text is None else since_us(text) // 1000


def _print(entry: DeadLetter) -> None:
    """Two lines, which no terminal is too narrow for: reasons are long."""
    times = f"{entry.seen} times" + (f", {entry.replays} replays" if entry.replays else "")
    head = f"  {_utc(entry.last_ms)}  {entry.robot}  {times}"
    _out.print(Text.assemble((entry.id, "bold"), head), soft_wrap=True)
    where = " ".join(filter(None, (entry.source, entry.topic)))
    _out.print(f"    {where}: {_one_line(entry.reason)}", soft_wrap=True)


def _one_line(text: str) -> str:
    return "".join(character if character.isprintable() else " " for character in text)


def _show(entry: DeadLetter, *, as_json: bool) -> None:
    payload = entry.payload or b""
    if as_json:
        base64_payload = base64.b64encode(payload).decode()
        _out.print_json(json.dumps({**_as_json(entry), "payload_base64": base64_payload}))
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
        _out.print(Text.assemble((f"{name:<11}", "bold"), value), soft_wrap=True)
    _out.print()
    _out.print(as_text(payload), soft_wrap=True)


def as_text(payload: bytes) -> str:
    """The bytes as the text that they are, or in hexadecimal, 16 a line, with what is ASCII beside."""
    try:
        text = payload.decode()
    except UnicodeDecodeError:
        text = "\0"
    # Control characters would be obeyed by the terminal.
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
    return datetime.fromtimestamp(ms / 1000, timezone.utc).strftime("%Y-%m-%d %H:%M:%S")
