"""`iort cost`: dollars for a robot-hour and a month, and the quotas of a larger fleet."""

from __future__ import annotations

import os
from dataclasses import asdict, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from iort_station.cli.console import out, print_json
from iort_station.cli.options import AsJson, CloudOptions, examples
from iort_station.cost import model, report
from iort_station.cost.model import deployment_dollars_per_month
from iort_station.cost.prices import API_REGION, AS_OF, PRICES, REGION, Listed, keep, kept_at, load, read
from iort_station.cost.usage import TRANSPORTS, Usage, as_configured, as_deployed

commands = typer.Typer()
_DEFAULT = Usage()


@commands.command("cost", epilog=examples("cost --robots 20 --hours-per-day 2"))
def cost_(
    context: typer.Context,
    robots: Annotated[int, typer.Option(help="How many robots.")] = 1,
    rate_hz: Annotated[
        float | None, typer.Option(help=f"Samples a second, of each stream. Default: {_DEFAULT.rate_hz:g}.")
    ] = None,
    streams: Annotated[
        int | None, typer.Option(help=f"Streams from a robot's sources. Default: {_DEFAULT.streams}.")
    ] = None,
    live_hz: Annotated[
        float | None, typer.Option(help=f"Live messages a second. Default: {_DEFAULT.live_hz:g}.")
    ] = None,
    batch_s: Annotated[
        float | None,
        typer.Option(
            help=f"Seconds that a batch spans; 0 sends each sample alone. Default: {_DEFAULT.batch_s:g}."
        ),
    ] = None,
    ping_hz: Annotated[
        float | None, typer.Option(help=f"Pings a second over each path. Default: {_DEFAULT.ping_hz:g}.")
    ] = None,
    hours_per_day: Annotated[
        float, typer.Option(help="Hours a robot drives a day.")
    ] = _DEFAULT.hours_per_day,
    watched_hours: Annotated[
        float | None,
        typer.Option(help="Hours of them that somebody looks at a robot live. Default: all of them."),
    ] = None,
    live_transport: Annotated[
        str | None,
        typer.Option(
            help=f"The way to viewers: {' or '.join(TRANSPORTS)}. Default: {_DEFAULT.live_transport}."
        ),
    ] = None,
    viewers: Annotated[int, typer.Option(help="People who watch the fleet.")] = _DEFAULT.viewers,
    retention_days: Annotated[int, typer.Option(help="Days that items are kept.")] = _DEFAULT.retention_days,
    archive_days: Annotated[
        int, typer.Option(help="Days that the archive keeps them, for this estimate; 0 for no archive.")
    ] = _DEFAULT.archive_days,
    drive_minutes: Annotated[
        float, typer.Option(help="Minutes of a drive, which is analysed at night; 0 for no analysis.")
    ] = _DEFAULT.drive_minutes,
    live_ms: Annotated[float, typer.Option(help="Billed milliseconds of Lambda 1.")] = _DEFAULT.live_ms,
    summarize_ms: Annotated[
        float, typer.Option(help="Billed milliseconds of Lambda 2.")
    ] = _DEFAULT.summarize_ms,
    connects_per_hour: Annotated[
        float, typer.Option(help="Connections of a robot in an hour.")
    ] = _DEFAULT.connects_per_hour,
    command_hz: Annotated[float, typer.Option(help="Commands a second to a robot.")] = _DEFAULT.command_hz,
    questions_per_hour: Annotated[
        float, typer.Option(help="Questions of a robot to the cloud in an hour.")
    ] = _DEFAULT.questions_per_hour,
    dashboard_hours: Annotated[
        float, typer.Option(help="Hours a month that the live page shows CloudWatch.")
    ] = _DEFAULT.dashboard_hours,
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
    given = {
        "rate_hz": rate_hz,
        "streams": streams,
        "live_hz": live_hz,
        "batch_s": batch_s,
        "ping_hz": ping_hz,
        "live_transport": live_transport,
        **_watched(usage, watched_hours, hours_per_day),
    }
    rates: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    usage = replace(
        usage,
        robots=robots,
        hours_per_day=hours_per_day,
        viewers=viewers,
        retention_days=retention_days,
        archive_days=archive_days,
        drive_minutes=drive_minutes,
        live_ms=live_ms,
        summarize_ms=summarize_ms,
        connects_per_hour=connects_per_hour,
        command_hz=command_hz,
        questions_per_hour=questions_per_hour,
        dashboard_hours=dashboard_hours,
        **rates,
    ).check()
    if as_json:
        print_json(_as_json(usage, listed))
        return
    if refresh and listed is not None:
        out.print(_table("AWS' price list", report.differences(listed)))
        for name, why in listed.kept.items():
            out.print(f"{name}: the built-in price is kept. {why}")
    out.print(
        f"{_dated(listed)}: "
        f"{usage.robots:,} robot{'s' * (usage.robots != 1)} at {usage.rate_hz:g} Hz"
        f"{f' in each of {usage.streams} streams' if usage.streams > 1 else ''}, "
        f"live {usage.live_hz:g} Hz {_looking(usage)}, {usage.hours_per_day:g} h a day, "
        f"kept {usage.retention_days} days.",
    )
    out.print()
    for title, rows in (
        ("A robot-hour", report.robot_hour(usage, prices)),
        ("A month", report.month(usage, prices)),
        ("A robot-year in DynamoDB beside one in the archive", report.robot_year(usage, prices)),
        ("What if", report.what_if(usage, prices)),
        ("What it needs of the default quotas", report.quotas(report.on_paper(usage, prices))),
    ):
        out.print(_table(title, rows))


def _watched(usage: Usage, hours: float | None, of_hours: float) -> dict[str, float]:
    """The hours that somebody looks; a car.yaml that sends always needs nobody."""
    return (
        {}
        if hours is None and usage.watched_hours is None
        else {"watched_hours": of_hours if hours is None else hours}
    )


def _prices(options: CloudOptions, *, refresh: bool) -> Listed | None:
    """AWS' price list of now or of the last --refresh; None for the built-in prices."""
    path = kept_at(os.environ)
    if not refresh:
        return load(path)
    cloud = options.account(region=REGION)
    listed = read(
        cloud.client("pricing", API_REGION), str(cloud.region_name), datetime.now(timezone.utc).date()
    )
    keep(listed, path)
    return listed


def _looking(usage: Usage) -> str:
    """When the live lane sends at its rate."""
    return (
        "always" if usage.watched_hours is None else f"while somebody looks, {usage.watched:.0%} of the time"
    )


def _dated(listed: Listed | None) -> str:
    """The date and the region of the prices."""
    if listed is None:
        return f"List prices of {AS_OF} in US dollars, {REGION}"
    kept = f"; built-in prices of {AS_OF} for {', '.join(listed.kept)}" if listed.kept else ""
    return f"AWS' price list as read on {listed.read_on}, {listed.region}{kept}; PubNub's prices of {AS_OF}"


def _as_json(usage: Usage, listed: Listed | None) -> dict[str, Any]:
    prices = PRICES if listed is None else listed.prices()
    paper = report.on_paper(usage, prices)
    ours, thesis = model.bill(usage, prices), model.thesis_bill(usage, prices)

    def items(found: list[model.LineItem]) -> list[dict[str, Any]]:
        return [{**item._asdict(), "dollars_per_robot_hour": item.dollars} for item in found]

    return {
        "prices_as_of": AS_OF if listed is None else listed.read_on,
        "prices_kept": {} if listed is None else listed.kept,
        "prices_changed": {} if listed is None else listed.changed(),
        "region": REGION if listed is None else listed.region,
        "usage": asdict(usage),
        "items": items(ours),
        "thesis_items": items(thesis),
        "pubnub_items": items(model.pubnub_bill(usage, prices)),
        "dollars_per_robot_hour": model.total(ours),
        "thesis_dollars_per_robot_hour": model.total(thesis),
        "deployment_dollars_per_month": deployment_dollars_per_month(usage, prices),
        "robot_year": [place._asdict() for place in model.robot_year(usage, prices)],
        "fleet_dollars_per_month": paper.aws_dollars_per_month,
        "pubnub_mau_dollars_per_month": model.pubnub_mau_dollars_per_month(usage),
        "quotas": [
            {"name": n.name, "needed": n.needed, "quota": n.quota.value, "robots_at_quota": n.robots_at_quota}
            for n in paper.needs
        ],
    }


def _table(title: str, rows: report.Rows) -> Table:
    table = Table(title=title, title_justify="left", title_style="bold")
    for i, name in enumerate(rows.head):
        table.add_column(name, justify="right" if i else "left")
    for row in rows.body:
        table.add_row(*row, style="bold" if row[0].startswith("total") else "")
    return table
