"""`iort cost`: dollars for a robot-hour and a month, and the quotas of a larger fleet."""

# ruff: noqa: ARG001 - the settings are read by name from the context, as they were given

from __future__ import annotations

import os
from dataclasses import asdict, fields, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from iort_station.cli.console import out, print_json
from iort_station.cli.options import AsJson, CloudOptions, examples
from iort_station.cost import model, report
from iort_station.cost.prices import API_REGION, AS_OF, PRICES, REGION, Listed, keep, kept_at, load, read
from iort_station.cost.usage import TRANSPORTS, Usage, as_configured, as_deployed

commands = typer.Typer()
_DEFAULT = Usage()
_SETTINGS = frozenset(field.name for field in fields(Usage))


def _of(name: str, meaning: str) -> Any:
    """An option that sets a field of `Usage`; its default may come from a car.yaml."""
    default = getattr(_DEFAULT, name)
    shown = default if isinstance(default, str) else f"{default:g}"
    return typer.Option(help=f"{meaning} Default: {shown}.")


@commands.command("cost", epilog=examples("cost --robots 20 --hours-per-day 2"))
def cost_(
    context: typer.Context,
    robots: Annotated[int | None, _of("robots", "How many robots.")] = None,
    rate_hz: Annotated[float | None, _of("rate_hz", "Samples a second, of each stream.")] = None,
    streams: Annotated[int | None, _of("streams", "Streams from a robot's sources.")] = None,
    live_hz: Annotated[float | None, _of("live_hz", "Live messages a second.")] = None,
    batch_s: Annotated[
        float | None, _of("batch_s", "Seconds that a batch spans; 0 sends each sample alone.")
    ] = None,
    ping_hz: Annotated[float | None, _of("ping_hz", "Pings a second over each path.")] = None,
    hours_per_day: Annotated[float | None, _of("hours_per_day", "Hours a robot drives a day.")] = None,
    watched_hours: Annotated[
        float | None,
        typer.Option(help="Hours of them that somebody looks at a robot live. Default: all of them."),
    ] = None,
    live_transport: Annotated[
        str | None, _of("live_transport", f"The way to viewers: {' or '.join(TRANSPORTS)}.")
    ] = None,
    viewers: Annotated[int | None, _of("viewers", "People who watch the fleet.")] = None,
    retention_days: Annotated[int | None, _of("retention_days", "Days that items are kept.")] = None,
    archive_days: Annotated[
        int | None,
        _of("archive_days", "Days that the archive keeps them, for this estimate; 0 for no archive."),
    ] = None,
    drive_minutes: Annotated[
        float | None,
        _of("drive_minutes", "Minutes of a drive, which is analysed at night; 0 for no analysis."),
    ] = None,
    live_ms: Annotated[float | None, _of("live_ms", "Billed milliseconds of Lambda 1.")] = None,
    summarize_ms: Annotated[float | None, _of("summarize_ms", "Billed milliseconds of Lambda 2.")] = None,
    connects_per_hour: Annotated[
        float | None, _of("connects_per_hour", "Connections of a robot in an hour.")
    ] = None,
    command_hz: Annotated[float | None, _of("command_hz", "Commands a second to a robot.")] = None,
    questions_per_hour: Annotated[
        float | None, _of("questions_per_hour", "Questions of a robot to the cloud in an hour.")
    ] = None,
    dashboard_hours: Annotated[
        float | None, _of("dashboard_hours", "Hours a month that the live page shows CloudWatch.")
    ] = None,
    config: Annotated[
        Path | None, typer.Option(help="Take the rates of a car.yaml, except those given as options.")
    ] = None,
    deployed: Annotated[
        bool,
        typer.Option(
            "--deployed",
            help="Take memory, concurrency, logs, alarms, dashboards, recovery and key from the deployment.",
        ),
    ] = False,
    refresh: Annotated[
        bool,
        typer.Option(
            "--refresh",
            help="Read AWS' price list with your credentials, print the changes, and keep it.",
        ),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Print the cost of a fleet by service and lane, beside the thesis' layout, at list prices."""
    usage = _DEFAULT if config is None else as_configured(_DEFAULT, config)
    listed = _prices(context.obj, refresh=refresh)
    prices = PRICES if listed is None else listed.prices()
    if deployed:
        usage = as_deployed(usage, context.obj.cloud())
    given = {name: value for name, value in context.params.items() if name in _SETTINGS and value is not None}
    if usage.watched_hours is not None:
        # Somebody looks all day; a car.yaml that sends always needs nobody.
        given.setdefault("watched_hours", given.get("hours_per_day", usage.hours_per_day))
    usage = replace(usage, **given).check()
    if as_json:
        print_json(_as_json(usage, listed))
        return
    if refresh and listed is not None:
        out.print(_table("AWS' price list", report.differences(listed)))
        for name, why in listed.kept.items():
            out.print(f"{name}: the built-in price is kept. {why}")
    of_each = f" in each of {usage.streams} streams" if usage.streams > 1 else ""
    looks = f"while somebody looks, {usage.watched:.0%} of the time"
    out.print(
        f"{_dated(listed)}: {report.robots(usage.robots)} at {usage.rate_hz:g} Hz{of_each}, "
        f"live {usage.live_hz:g} Hz {'always' if usage.watched_hours is None else looks}, "
        f"{usage.hours_per_day:g} h a day, kept {usage.retention_days} days.",
    )
    out.print()
    for title, rows in (
        ("A robot-hour", report.robot_hour(usage, prices)),
        ("A month", report.month(usage, prices)),
        ("A robot-year in DynamoDB beside one in the archive", report.robot_year(usage, prices)),
        ("What if", report.what_if(usage, prices)),
        ("What it needs of the default quotas", report.quotas(usage)),
    ):
        out.print(_table(title, rows))


def _prices(options: CloudOptions, *, refresh: bool) -> Listed | None:
    """AWS' price list of now or of the last --refresh; None for the built-in prices."""
    path = kept_at(os.environ)
    if not refresh:
        return load(path)
    cloud = options.account(region=REGION)
    today = datetime.now(timezone.utc).date()
    listed = read(cloud.client("pricing", API_REGION), str(cloud.region_name), today)
    keep(listed, path)
    return listed


def _dated(listed: Listed | None) -> str:
    """The date and the region of the prices."""
    if listed is None:
        return f"List prices of {AS_OF} in US dollars, {REGION}"
    kept = f"; built-in prices of {AS_OF} for {', '.join(listed.kept)}" if listed.kept else ""
    return f"AWS' price list as read on {listed.read_on}, {listed.region}{kept}; PubNub's prices of {AS_OF}"


def _as_json(usage: Usage, listed: Listed | None) -> dict[str, Any]:
    prices = PRICES if listed is None else listed.prices()
    ours, thesis, pubnub = (
        bill(usage, prices) for bill in (model.bill, model.thesis_bill, model.pubnub_bill)
    )

    def items(bill: list[model.LineItem]) -> list[dict[str, Any]]:
        return [{**item._asdict(), "dollars_per_robot_hour": item.dollars} for item in bill]

    return {
        "prices_as_of": AS_OF if listed is None else listed.read_on,
        "prices_kept": {} if listed is None else listed.kept,
        "prices_changed": {} if listed is None else listed.changed(),
        "region": REGION if listed is None else listed.region,
        "usage": asdict(usage),
        "items": items(ours),
        "thesis_items": items(thesis),
        "pubnub_items": items(pubnub),
        "dollars_per_robot_hour": model.total(ours),
        "thesis_dollars_per_robot_hour": model.total(thesis),
        "deployment_dollars_per_month": model.deployment_dollars_per_month(usage, prices),
        "robot_year": [place._asdict() for place in model.robot_year(usage, prices)],
        "fleet_dollars_per_month": model.dollars_per_month(ours, usage),
        "pubnub_mau_dollars_per_month": model.pubnub_mau_dollars_per_month(usage),
        "quotas": [
            {"name": n.name, "needed": n.needed, "quota": n.quota.value, "robots_at_quota": n.robots_at_quota}
            for n in report.needs(usage)
        ],
    }


def _table(title: str, rows: report.Rows) -> Table:
    table = Table(title=title, title_justify="left", title_style="bold")
    for i, name in enumerate(rows.head):
        table.add_column(name, justify="right" if i else "left")
    for row in rows.body:
        table.add_row(*row, style="bold" if row[0].startswith("total") else "")
    return table
