"""`iort alarms`: what is wrong, since when, what to do; and who has seen it."""

from __future__ import annotations

import time
from typing import Annotated, Any

import typer
from rich.text import Text

from iort_contract.messages.page import AlarmEntry
from iort_station.cli.console import out, print_json
from iort_station.cli.options import AsJson
from iort_station.cli.words import examples, say
from iort_station.errors import StationError
from iort_station.operations import alarms
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
    every: Annotated[bool, typer.Option("--all", help="Also the alarms that are not raised.")] = False,
    acknowledge: Annotated[
        str | None, typer.Option(metavar="NAME", help="Note that somebody has seen this alarm.")
    ] = None,
    by: Annotated[str, typer.Option(help="Who has seen it. Default: this machine's user.")] = "",
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
    shown = found if every else raised
    if as_json:
        print_json([_as_json(alarm) for alarm in shown])
        return
    for alarm in shown:
        _print(alarm)
    if not raised:
        say(f"none of {len(found)} alarms is raised")


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
