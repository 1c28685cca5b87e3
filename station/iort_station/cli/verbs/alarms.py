"""`iort alarms`, `errors` and `replay-errors`: what is wrong, what was rejected, and put back."""

from __future__ import annotations

import base64
import time
from collections import Counter
from dataclasses import asdict
from typing import Annotated, Any

import typer
from rich.text import Text

from iort_contract.messages.page import AlarmEntry
from iort_contract.tables import NO_ROBOT
from iort_station.cli import options
from iort_station.cli.console import Lines, bar, errors, listing, out, print_json
from iort_station.cli.options import AsJson, DryRun, OneRobot, Range, When, argument, examples, option, ranged
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.fleet import registry
from iort_station.operations import alarms, quarantine
from iort_station.operations.quarantine import DeadLetter, Fate
from iort_station.output import one_line
from iort_station.times import iso_s, stamped

commands = typer.Typer()
_STATES = {"ALARM": "raised", "INSUFFICIENT_DATA": "no data", "OK": "quiet"}
_MORE = {
    "quarantine": "`iort errors`, `iort errors ID`",
    "logs": "the functions' newest warnings and errors: `iort dashboard`, view CloudWatch",
    "cars": "`iort query ROBOT`, `iort audit ROBOT`, and the page's view of the past",
}


@commands.command("alarms", epilog=examples("alarms", "alarms --all"))
def alarms_(
    context: typer.Context,
    every: Annotated[bool, option("Also the alarms that are not raised.", "--all")] = False,
    acknowledge: Annotated[
        str | None, option("Note that somebody has seen this alarm.", metavar="NAME")
    ] = None,
    by: Annotated[str, option("Who has seen it. Default: this machine's user.")] = "",
    as_json: AsJson = False,
) -> None:
    """List the raised alarms: since when, what they mean and what to do."""
    cloud = context.obj.cloud()
    found = alarms.alarms(cloud)
    raised = [alarm for alarm in found if alarm["state"] == alarms.RAISED]
    if acknowledge is not None:
        alarm = next((alarm for alarm in raised if alarm["key"] == acknowledge), None)
        if alarm is None:
            names = ", ".join(alarm["key"] for alarm in raised) or "none"
            raise StationError(f"alarm {acknowledge} is not raised; raised are: {names}")
        alarm["acknowledged"] = alarms.acknowledge(cloud, alarm["key"], alarm["since_s"], by)
        found = raised = [alarm]
    listing(found if every else raised, _as_json, _print, as_json=as_json)
    if not raised and not as_json:
        options.say(f"none of {len(found)} alarms is raised")


def _print(alarm: AlarmEntry) -> None:
    raised = alarm["state"] == alarms.RAISED
    since = f"  {_STATES[alarm['state']]} since {_utc(alarm['since_s'])}, {alarm['meaning']}"
    out.print(Text.assemble((alarm["key"], "bold red" if raised else "bold"), since), soft_wrap=True)
    if not raised:
        return
    out.print(f"    what to do: {alarm['advice']}", soft_wrap=True)
    out.print(f"    look at: {_MORE[alarm['evidence']]}", soft_wrap=True)
    if alarm["robots"]:
        said = "cars" if alarm["named"] else "cars that were connected"
        out.print(f"    {said}: {', '.join(alarm['robots'])}", soft_wrap=True)
    if seen := alarm["acknowledged"]:
        out.print(f"    acknowledged by {seen['by']} at {_utc(seen['at_s'])}", soft_wrap=True)


def _as_json(alarm: AlarmEntry) -> dict[str, Any]:
    seen = alarm["acknowledged"]
    return {
        **{name: value for name, value in alarm.items() if name not in {"about", "named", "since_s"}},
        **stamped("since", round(alarm["since_s"] * 1e6)),
        "for_s": round(time.time() - alarm["since_s"]),
        "acknowledged": seen and {"by": seen["by"], **stamped("at", round(seen["at_s"] * 1e6))},
    }


def _utc(at_s: float) -> str:
    return iso_s(round(at_s * 1_000_000))


# `iort errors`: the messages that were rejected.

_HEX_WIDTH = 16


@commands.command("errors", epilog=examples("errors --robot car7 --last 1h"))
@ranged
def errors_(
    context: typer.Context,
    when: When,
    entry_id: Annotated[str | None, argument("Show this message with its bytes.", metavar="ID")] = None,
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
        _print_errors(entry)
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


def _print_errors(entry: DeadLetter) -> None:
    """Print two lines: reasons are too long for a table in a narrow terminal."""
    times = f"{entry.seen} times" + (f", {entry.replays} replays" if entry.replays else "")
    out.print(
        Text.assemble((entry.id, "bold"), f"  {_iso_ms(entry.last_ms)}  {entry.robot}  {times}"),
        soft_wrap=True,
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
        ("first", _iso_ms(entry.first_ms)),
        ("last", f"{_iso_ms(entry.last_ms)}, {entry.seen} times, {entry.replays} replays"),
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


def _iso_ms(ms: int) -> str:
    return iso_s(ms * 1000)


# `iort replay-errors`: put rejected messages back.


@commands.command("replay-errors", epilog=examples("replay-errors --robot car7 --dry-run"))
@ranged
def replay_errors(
    context: typer.Context,
    when: When,
    robot: OneRobot = None,
    dry_run: DryRun = False,
    again: Annotated[
        bool, option(f"Also messages replayed {quarantine.MAX_REPLAYS} times already.", "--again")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Process rejected recordings again, and delete those that arrive.

    Exit status 1 if any fails again.
    """
    within = when.range()
    cloud = context.obj.cloud()
    if not dry_run and (moved := quarantine.recover(cloud)):
        errors.print(f"{moved} messages that the table did not take are on the way to it again")
    found = sorted(entries(cloud, robot, within), key=lambda entry: (entry.first_ms, entry.id))
    outcomes = []
    with bar("putting back", len(found)) as progress:
        for outcome in quarantine.replay(cloud, found, dry_run=dry_run, again=again):
            outcomes.append(outcome)
            progress(1)
    if as_json:
        print_json([{**as_fields(o.letter), "fate": o.fate.value, "detail": o.detail} for o in outcomes])
    else:
        for outcome in outcomes:
            if outcome.fate not in (Fate.REPLAYED, Fate.NOT_FOR_REPLAY):
                detail = f": {outcome.detail}" if outcome.detail else ""
                line = f"{outcome.letter.id}  {outcome.letter.robot}  {outcome.fate.value}{detail}"
                out.print(line, soft_wrap=True)
        counts = Counter(outcome.fate for outcome in outcomes)
        out.print(", ".join(f"{n} {fate.value}" for fate, n in counts.items()) or "nothing in quarantine")
    if any(outcome.fate is Fate.FAILED for outcome in outcomes):
        raise typer.Exit(1)
