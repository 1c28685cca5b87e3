"""`iort cost`: dollars a robot-hour and a month, and what a larger fleet needs."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, replace
from pathlib import Path
from statistics import mean
from typing import Annotated, Any

import typer
from rich.table import Table

from device.config import Config, load_config
from device.errors import AgentError
from station import cost, cost_tables, scale
from station.at_rest import deployment_dollars_per_month
from station.cloud import Cloud
from station.console import Console
from station.errors import StationError
from station.prices import AS_OF, REGION
from station.usage import Usage

commands = typer.Typer()
_out = Console()
_DEFAULT = Usage()


@commands.command("cost")
def cost_(
    context: typer.Context,
    robots: Annotated[int, typer.Option(help="How many robots.")] = 1,
    rate_hz: Annotated[float | None, typer.Option(help="Samples a second, of each stream.")] = None,
    streams: Annotated[int | None, typer.Option(help="Streams that a robot's sources bring.")] = None,
    live_hz: Annotated[float | None, typer.Option(help="Live messages a second.")] = None,
    batch_s: Annotated[
        float | None, typer.Option(help="Seconds a batch spans; 0 sends each sample by itself.")
    ] = None,
    ping_hz: Annotated[float | None, typer.Option(help="Pings a second over each path.")] = None,
    hours_per_day: Annotated[
        float, typer.Option(help="Hours a robot drives a day.")
    ] = _DEFAULT.hours_per_day,
    viewers: Annotated[int, typer.Option(help="People who watch the fleet.")] = _DEFAULT.viewers,
    retention_days: Annotated[int, typer.Option(help="Days that items are kept.")] = _DEFAULT.retention_days,
    live_ms: Annotated[float, typer.Option(help="Billed milliseconds of Lambda 1.")] = _DEFAULT.live_ms,
    summarize_ms: Annotated[
        float, typer.Option(help="Billed milliseconds of Lambda 2.")
    ] = _DEFAULT.summarize_ms,
    config: Annotated[
        Path | None, typer.Option(help="A car.yaml: its rates, where no option says another.")
    ] = None,
    deployed: Annotated[
        bool,
        typer.Option(
            "--deployed", help="Memory, concurrency, logs, alarms, recovery and key as they are deployed."
        ),
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="As JSON.")] = False,
) -> None:
    """What a fleet costs, by service and lane, beside the thesis' layout; list prices of one date."""
    usage = _configured(_DEFAULT, config)
    if deployed:
        usage = _as_deployed(usage, context.obj.cloud())
    said: dict[str, Any] = {
        "rate_hz": rate_hz,
        "streams": streams,
        "live_hz": live_hz,
        "batch_s": batch_s,
        "ping_hz": ping_hz,
    }
    usage = replace(
        usage,
        robots=robots,
        hours_per_day=hours_per_day,
        viewers=viewers,
        retention_days=retention_days,
        live_ms=live_ms,
        summarize_ms=summarize_ms,
        **{name: value for name, value in said.items() if value is not None},
    ).check()
    if as_json:
        _out.print_json(json.dumps(_as_json(usage)))
        return
    _out.print(
        f"List prices of {AS_OF} in US dollars, {REGION}: "
        f"{usage.robots:,} robot{'s' * (usage.robots != 1)} at {usage.rate_hz:g} Hz"
        f"{f' in each of {usage.streams} streams' if usage.streams > 1 else ''}, "
        f"live {usage.live_hz:g} Hz, {usage.hours_per_day:g} h a day, kept {usage.retention_days} days.\n"
    )
    for title, rows in (
        ("A robot-hour", cost_tables.robot_hour(usage)),
        ("A month", cost_tables.month(usage)),
        ("What if", cost_tables.what_if(usage)),
        ("What it needs of the default quotas", cost_tables.quotas(scale.on_paper(usage))),
    ):
        _out.print(_table(title, rows))


def _configured(usage: Usage, config: Path | None) -> Usage:
    if config is None:
        return usage
    try:
        car = load_config(config)
    except AgentError as error:
        raise StationError(str(error)) from error
    return replace(usage, **_rates(car))


def _rates(car: Config) -> dict[str, Any]:
    # What a source alone does not say, such as the rate of a ROS topic, is as in a `Usage`.
    rates = [
        (getattr(source, "rate_hz", _DEFAULT.rate_hz), getattr(source, "rate_hz", math.inf))
        for source in car.sources
        for _ in range(max(1, len(set(source.streams()))))
    ]
    # The live lane's rate is of each stream, which sends no more than its source brings.
    live_hz = sum(min(car.live.rate_hz, most_hz) for _, most_hz in rates)
    return {
        "live_hz": live_hz if car.live.enabled else 0.0,
        "batch_s": car.record.batch_s,
        "ping_hz": car.ping.rate_hz,
        "agent_every_s": car.metrics.every_s if car.metrics.enabled else 0.0,
        "streams": len(rates),
        "rate_hz": mean(rate_hz for rate_hz, _ in rates),
    }


def _as_deployed(usage: Usage, cloud: Cloud) -> Usage:
    found: dict[str, Any] = {}
    client = cloud.client("lambda")
    for name, key in (("Live", "live_memory_mb"), ("Summarize", "summarize_memory_mb")):
        function = cloud.output("processing", f"{name}Function")
        configured = client.get_function_configuration(FunctionName=function)
        found[key] = configured["MemorySize"]
        if name == "Live":
            reserved = client.get_function_concurrency(FunctionName=function)
            level = configured.get("LoggingConfig", {}).get("SystemLogLevel")
            found["function_logs"] = "own" if level == "WARN" else "all"
            found["live_concurrency"] = reserved.get("ReservedConcurrentExecutions", 0)
    pages = cloud.client("cloudwatch").get_paginator("describe_alarms").paginate()
    found["alarms"] = sum(len(page.get("MetricAlarms", [])) for page in pages)
    table, dynamodb = cloud.output("storage", "TelemetryTable"), cloud.client("dynamodb")
    encryption = dynamodb.describe_table(TableName=table)["Table"].get("SSEDescription", {})
    found["customer_key"] = encryption.get("SSEType") == "KMS"
    backups = dynamodb.describe_continuous_backups(TableName=table)["ContinuousBackupsDescription"]
    recovery = backups.get("PointInTimeRecoveryDescription", {})
    found["recoverable"] = recovery.get("PointInTimeRecoveryStatus") == "ENABLED"
    return replace(usage, **found)


def _as_json(usage: Usage) -> dict[str, Any]:
    paper = scale.on_paper(usage)

    def items(found: list[cost.Item]) -> list[dict[str, Any]]:
        return [{**item._asdict(), "dollars_per_robot_hour": item.dollars} for item in found]

    return {
        "prices_as_of": AS_OF,
        "region": REGION,
        "usage": asdict(usage),
        "items": items(cost.bill(usage)),
        "thesis_items": items(cost.thesis_bill(usage)),
        "pubnub_items": items(cost.pubnub_bill(usage)),
        "dollars_per_robot_hour": cost.total(cost.bill(usage)),
        "thesis_dollars_per_robot_hour": cost.total(cost.thesis_bill(usage)),
        "deployment_dollars_per_month": deployment_dollars_per_month(usage),
        "fleet_dollars_per_month": paper.aws_dollars_per_month,
        "pubnub_mau_dollars_per_month": cost.pubnub_mau_dollars_per_month(usage),
        "quotas": [
            {"name": n.name, "needed": n.needed, "quota": n.quota.value, "robots_at_quota": n.robots_at_quota}
            for n in paper.needs
        ],
    }


def _table(title: str, rows: cost_tables.Rows) -> Table:
    table = Table(title=title, title_justify="left", title_style="bold")
    for i, name in enumerate(rows.head):
        table.add_column(name, justify="right" if i else "left")
    for row in rows.body:
        table.add_row(*row, style="bold" if row[0].startswith("total") else "")
    return table
