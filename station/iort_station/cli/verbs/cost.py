"""`iort cost`: dollars for a robot-hour and a month, and the quotas of a larger fleet."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

from iort_station.cli.console import out, print_json, table
from iort_station.cli.options import AsJson, examples, option, spread
from iort_station.cost import report
from iort_station.cost.prices import AS_OF, REGION
from iort_station.cost.usage import TRANSPORTS, Usage, as_configured

commands = typer.Typer()
# An option each; the default may come from a car.yaml.
_SETTINGS = {
    "robots": "How many robots.",
    "rate_hz": "Samples a second, of each stream.",
    "streams": "Streams from a robot's sources.",
    "live_hz": "Live messages a second.",
    "batch_s": "Seconds that a batch spans; 0 sends each sample alone.",
    "ping_hz": "Pings a second over each path.",
    "hours_per_day": "Hours a robot drives a day.",
    "watched_hours": "Hours of them that somebody looks at a robot live. Default: all of them.",
    "live_transport": f"The way to viewers: {' or '.join(TRANSPORTS)}.",
    "viewers": "People who watch the fleet.",
    "retention_days": "Days that items are kept.",
    "archive_days": "Days that the archive keeps them, for this estimate; 0 for no archive.",
    "drive_minutes": "Minutes of a drive, which is analysed at night; 0 for no analysis.",
    "live_ms": "Billed milliseconds of Lambda 1.",
    "summarize_ms": "Billed milliseconds of Lambda 2.",
    "connects_per_hour": "Connections of a robot in an hour.",
    "command_hz": "Commands a second to a robot.",
    "questions_per_hour": "Questions of a robot to the cloud in an hour.",
    "incidents_per_hour": "Incidents of a robot's event recorder in an hour that are told.",
    "video_minutes": "Minutes of an hour that each viewer looks through a robot's camera.",
    "video_relayed": "Share of them by a relay (TURN), 0 to 1.",
    "video_broker": "Share of them as pictures over the broker, 0 to 1.",
    "video_kbps": "Bitrate of the video in kbit/s.",
    "picture_hz": "Pictures a second over the broker.",
    "picture_bytes": "Bytes of such a picture.",
    "dashboard_hours": "Hours a month that the live page shows CloudWatch.",
}


def _option(name: str, meaning: str) -> Any:
    default = getattr(Usage(), name)
    shown = default if isinstance(default, str) else f"{default:g}"
    text = meaning if "Default" in meaning else f"{meaning} Default: {shown}."
    return Annotated[get_type_hints(Usage)[name] | None, option(text)]


@commands.command("cost", epilog=examples("cost --robots 20 --hours-per-day 2"))
@spread("settings", {name: _option(name, meaning) for name, meaning in _SETTINGS.items()}, dict)
def cost_(
    settings: dict[str, Any],
    config: Annotated[
        Path | None, option("Take the rates of a car.yaml, except those given as options.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Print the cost of a fleet by service and lane, beside the thesis' layout, at list prices."""
    usage = Usage() if config is None else as_configured(Usage(), config)
    given = {name: value for name, value in settings.items() if value is not None}
    if usage.watched_hours is not None:
        # Somebody looks all day; a car.yaml that sends always needs nobody.
        given.setdefault("watched_hours", given.get("hours_per_day", usage.hours_per_day))
    usage = replace(usage, **given).check()
    if as_json:
        print_json(report.facts(usage))
        return
    of_each = f" in each of {usage.streams} streams" if usage.streams > 1 else ""
    looks = f"while somebody looks, {usage.watched:.0%} of the time"
    out.print(
        f"List prices of {AS_OF} in US dollars, {REGION}: {report.robots(usage.robots)} at "
        f"{usage.rate_hz:g} Hz{of_each}, live {usage.live_hz:g} Hz "
        f"{'always' if usage.watched_hours is None else looks}, "
        f"{usage.hours_per_day:g} h a day, kept {usage.retention_days} days.",
    )
    for title, rows in (
        ("A robot-hour", report.robot_hour(usage)),
        ("A month", report.month(usage)),
        ("What if", report.what_if(usage)),
        ("What it needs of the default quotas", report.quotas(usage)),
    ):
        out.print()
        shown = table(*rows.head, left=rows.head[:1], title=title, wrap=True)
        for row in rows.body:
            shown.add_row(*row, style="bold" if row[0].startswith("total") else "")
        out.print(shown)
