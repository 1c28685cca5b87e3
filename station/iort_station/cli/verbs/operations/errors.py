"""`iort errors`: the messages that were rejected."""

from __future__ import annotations

import base64
from dataclasses import asdict
from typing import Annotated, Any

import typer
from rich.text import Text

from iort_contract.tables import NO_ROBOT
from iort_station.cli.console import Lines, errors, out, print_json
from iort_station.cli.options import AsJson, OneRobot, Range, When, ranged
from iort_station.cli.words import examples
from iort_station.cloud import Cloud
from iort_station.fleet import registry
from iort_station.operations import quarantine
from iort_station.operations.quarantine import DeadLetter
from iort_station.texts import one_line
from iort_station.times import iso_s, stamped

commands = typer.Typer()
_HEX_WIDTH = 16


@commands.command("errors", epilog=examples("errors --robot car7 --last 1h"))
@ranged
def errors_(
    context: typer.Context,
    when: When,
    entry_id: Annotated[
        str | None, typer.Argument(metavar="ID", help="Show this message with its bytes.")
    ] = None,
    robot: OneRobot = None,
    as_json: AsJson = False,
) -> None:
    """List the messages that were rejected or could not be processed, or show one."""
    within = when.range()
    cloud = context.obj.cloud()
    if entry_id is not None:
        _show(quarantine.find(cloud, entry_id), as_json=as_json)
        return
    found = sorted(entries(cloud, robot, within), key=lambda entry: (entry.last_ms, entry.id))
    waiting = quarantine.waiting(cloud)
    if as_json:
        print_json({"entries": [as_fields(entry) for entry in found], "waiting": asdict(waiting)})
        return
    for entry in found:
        _print(entry)
    if not found:
        out.print("nothing in quarantine" + (f" of {robot}" if robot else ""))
    if waiting.rejected:
        errors.print(f"{waiting.rejected} more on the way into the table")
    if waiting.last:
        errors.print(f"{waiting.last} that the table did not take: `iort replay-errors` tries again")


def entries(cloud: Cloud, robot: str | None, within: Range) -> list[DeadLetter]:
    """The rejected messages that were seen in a range; raises `StationError` for an unknown robot."""
    found = list(quarantine.entries(cloud, robot=robot, since_ms=(within.start_us or 0) // 1000))
    if not found and robot not in {None, NO_ROBOT}:
        registry.get(cloud, str(robot))
    return [entry for entry in found if within.end_us is None or entry.first_ms * 1000 < within.end_us]


def _print(entry: DeadLetter) -> None:
    """Print two lines: reasons are too long for a table in a narrow terminal."""
    times = f"{entry.seen} times" + (f", {entry.replays} replays" if entry.replays else "")
    out.print(
        Text.assemble((entry.id, "bold"), f"  {_utc(entry.last_ms)}  {entry.robot}  {times}"), soft_wrap=True
    )
    where = " ".join(filter(None, (entry.source, entry.topic)))
    out.print(f"    {where}: {entry.reason}", soft_wrap=True)


def _show(entry: DeadLetter, *, as_json: bool) -> None:
    payload = entry.payload or b""
    if as_json:
        print_json({**as_fields(entry), "payload_base64": base64.b64encode(payload).decode()})
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
    out.print(Lines(as_text(payload)), soft_wrap=True)


def as_text(payload: bytes) -> str:
    """The bytes as text, or if they are not text, in hexadecimal with ASCII beside it."""
    try:
        text = payload.decode()
    except UnicodeDecodeError:
        text = "\0"
    # A terminal would obey control characters.
    if all(character.isprintable() or character in "\n\t" for character in text):
        return one_line(text)
    lines = []
    for start in range(0, len(payload), _HEX_WIDTH):
        line = payload[start : start + _HEX_WIDTH]
        shown = "".join(chr(byte) if 32 <= byte < 127 else "." for byte in line)
        lines.append(f"{start:06x}  {line.hex(' '):<{3 * _HEX_WIDTH}} {shown}")
    return "\n".join(lines)


def as_fields(entry: DeadLetter) -> dict[str, Any]:
    """What is printed of a message as JSON."""
    told = {name: value for name, value in asdict(entry).items() if name != "payload"}
    return {**told, **stamped("first", entry.first_ms * 1000), **stamped("last", entry.last_ms * 1000)}


def _utc(ms: int) -> str:
    return iso_s(ms * 1000)
