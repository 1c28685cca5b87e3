"""How a fleet is driven, with everything that affects its bill: as given, from a car.yaml, as deployed."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import mean
from typing import Any

import yaml

from iort_contract.cloud import IOT, PUBNUB
from iort_contract.limits import LIVE_BROKER_EVERY_S
from iort_contract.messages.account import ACCOUNT_EVERY_S
from iort_contract.messages.live import VIEW_RENEW_S
from iort_contract.messages.shadow import ALWAYS, WATCHED
from iort_contract.tables import DEFAULT_RETENTION_DAYS
from iort_station.cloud import Cloud
from iort_station.cost.prices import MONTH_DAYS
from iort_station.errors import StationError, UsageError
from iort_station.fleet.roles import transport
from iort_station.operations import cloudwatch

TRANSPORTS = (PUBNUB, IOT)
# A car without round-trip pings still pings for its clock offset; a test compares this with the agent.
CLOCK_PING_S = 30.0


@dataclass(frozen=True, kw_only=True)
class Usage:
    """How a fleet is driven. The defaults are the agent's and the stacks' own.

    Of a robot: it has ``streams`` of ``rate_hz`` samples a second each, sends ``live_hz`` live messages and
    ``ping_hz`` pings per path a second, gets ``command_hz`` commands a second and asks the cloud
    ``questions_per_hour``. A batch spans ``batch_s``.
    The agent sends its metrics ``agent_every_s``.

    Of a deployment: items are kept ``retention_days``, and are ``recoverable`` to a point in time in stage
    prod. The archive's are counted for ``archive_days``, 0 for none. Every night drives of ``drive_minutes``
    are analysed, 0 for none. Each of ``alarms`` watches a metric; the alarms by Metrics Insights analyse
    ``insights_metrics`` together. ``dashboards`` has the number of metrics on each; ``robot_metrics`` adds to
    the last. They are open on the live page for ``dashboard_hours`` a month. ``function_logs`` "all" adds
    Lambda's own log lines.

    Somebody looks at a robot for ``watched_hours`` of its hours a day; at other times it sends a live message
    of each stream every `LIVE_BROKER_EVERY_S`. None is for ``live.when: always``. Live messages reach their
    viewers by ``live_transport``, AWS IoT or PubNub.

    Only AWS knows the billed milliseconds; ``live_ms``, ``summarize_ms`` and ``summarize_batch_ms`` (for each
    batch in an event) are assumptions. Each of ``viewers`` watches the whole fleet in those hours.
    """

    robots: int = 1
    rate_hz: float = 50.0
    streams: int = 1
    live_hz: float = 10.0
    batch_s: float = 1.0
    ping_hz: float = 0.0
    agent_every_s: float = 60.0
    connects_per_hour: float = 1.0
    command_hz: float = 0.0
    questions_per_hour: float = 0.0
    hours_per_day: float = 2.0
    watched_hours: float | None = 2.0
    live_transport: str = IOT
    viewers: int = 1
    retention_days: int = DEFAULT_RETENTION_DAYS
    archive_days: int = 365
    drive_minutes: float = 10.0
    live_memory_mb: int = 256
    live_ms: float = 20.0
    live_concurrency: int = 0
    summarize_memory_mb: int = 512
    summarize_ms: float = 20.0
    summarize_batch_ms: float = 5.0
    function_logs: str = "own"
    alarms: int = 41
    insights_metrics: int = 63
    dashboards: tuple[int, ...] = (49, 20, 22)
    dashboard_hours: float = 20.0
    robot_metrics: bool = False
    recoverable: bool = False
    customer_key: bool = False
    device_defender: bool = False

    def check(self) -> Usage:
        """Return itself; raises `UsageError` for an impossible value."""
        for name, value in vars(self).items():
            if isinstance(value, (int, float)) and value < 0:
                raise UsageError(f"{name} must be at least 0, got {value}")
        for name, holds, allowed in (
            ("robots", self.robots >= 1, "at least 1"),
            ("streams", self.streams >= 1, "at least 1"),
            ("rate_hz", 0 < self.rate_hz <= 2000, "more than 0 and at most 2000"),
            ("batch_s", self.batch_s <= 1, "0 to 1; 0 sends each sample by itself"),
            ("hours_per_day", 0 < self.hours_per_day <= 24, "more than 0 and at most 24"),
            ("live_transport", self.live_transport in TRANSPORTS, f"one of {', '.join(TRANSPORTS)}"),
        ):
            if not holds:
                raise UsageError(f"{name} must be {allowed}, got {getattr(self, name)}")
        return self

    @property
    def batches_per_s(self) -> float:
        return self.streams * self.stream_batches_per_s

    @property
    def samples_per_s(self) -> float:
        return self.streams * self.rate_hz

    @property
    def stream_batches_per_s(self) -> float:
        return min(self.rate_hz, max(1.0, 1 / self.batch_s)) if self.batch_s else self.rate_hz

    @property
    def own_batches_per_s(self) -> float:
        """Batches a second of the agent's own streams: metrics, accounts, and round trips if it measures
        them."""
        figures = 1 / self.agent_every_s if self.agent_every_s else 0.0
        return figures + 1 / ACCOUNT_EVERY_S + min(1.0, 3 * self.ping_hz)

    @property
    def own_streams(self) -> int:
        return bool(self.agent_every_s) + 1 + bool(self.ping_hz)

    @property
    def watched(self) -> float:
        """The share of its hours that somebody looks at a robot, or that it sends as if."""
        return 1.0 if self.watched_hours is None else min(1.0, self.watched_hours / self.hours_per_day)

    @property
    def live_per_s(self) -> float:
        """A robot's live messages a second, on average."""
        return self.watched * self.live_hz + (1 - self.watched) * self._idle_hz

    @property
    def live_at_broker_per_s(self) -> float:
        """A robot's live messages a second that pass the broker while its fault code does not change."""
        return self.live_per_s if self.live_transport == IOT else self._idle_hz

    @property
    def leases_per_s(self) -> float:
        """The leases a second that a robot hears from its viewers."""
        if self.watched_hours is None or not self.live_hz:
            return 0.0
        return self.watched * self.viewers / VIEW_RENEW_S

    @property
    def _idle_hz(self) -> float:
        return min(self.live_hz, self.streams / LIVE_BROKER_EVERY_S)

    @property
    def clock_pings_per_s(self) -> float:
        """A robot's pings a second that measure its clock offset."""
        return 0.0 if self.ping_hz else 1 / CLOCK_PING_S

    @property
    def robot_hours_per_month(self) -> float:
        """Robot-hours of the whole fleet."""
        return self.robots * self.hours_per_day * MONTH_DAYS


def variations(usage: Usage) -> Iterator[tuple[str, Usage]]:
    """The usage with one setting changed at a time."""
    yield "as configured", usage
    for share, name in ((0.0, "nobody looks"), (0.1, "somebody looks a tenth of the time")):
        yield name, replace(usage, watched_hours=share * usage.hours_per_day)
    yield "live messages by PubNub", replace(usage, live_transport=PUBNUB)
    for live_hz in (5.0, 2.0, 1.0, 0.0):
        if live_hz != usage.live_hz:
            name = f"live lane at {live_hz:g} Hz" if live_hz else "no live lane"
            yield name, replace(usage, live_hz=live_hz)
    for batch_s in (0.2, 0.0):
        name = f"batches of {batch_s:g} s" if batch_s else "one sample a batch"
        yield name, replace(usage, batch_s=batch_s)
    yield "round trips measured at 1 Hz", replace(usage, ping_hz=1.0)
    yield "commands at 10 Hz", replace(usage, command_hz=10.0)
    yield "a question to the cloud every minute", replace(usage, questions_per_hour=60.0)
    yield "reconnecting every minute", replace(usage, connects_per_hour=60.0)
    yield "with Lambda's own log lines", replace(usage, function_logs="all")
    yield "kept for 30 days", replace(usage, retention_days=30)
    yield "without an archive", replace(usage, archive_days=0)
    yield "kept for ten years in the archive", replace(usage, archive_days=3653)
    yield "without the nightly analysis", replace(usage, drive_minutes=0.0)
    yield "tables recoverable to a point in time (`prod`)", replace(usage, recoverable=True)
    yield "a thousand robots", replace(usage, robots=1000)


# --- from a robot's car.yaml; `iort-agent check` judges the whole file

# Sources that take samples at a rate of their own, with its default; a test compares them with the agent's.
_OWN_RATE_HZ = {"sim": 50.0, "vesc": 50.0}
# A simulated car's poses, a stream beside its samples.
_POSE_RATE_HZ = 20.0


def as_configured(usage: Usage, file: Path) -> Usage:
    """The usage with the rates of a car.yaml; raises `StationError` for an invalid file.

    The file does not tell the rates of ROS topics and recordings; these stay as in ``usage``.
    """
    car = _Section(file, "", _content(file))
    rates = [rate for source in car.items("sources") for rate in _rates_hz(source)]
    live, metrics = car.section("live"), car.section("metrics")
    live_hz = live.number("rate_hz", usage.live_hz)
    when = live.choice("when", (WATCHED, ALWAYS), WATCHED)
    transport = live.choice("transport", TRANSPORTS, usage.live_transport)
    return replace(
        usage,
        # The limit applies to each stream, which sends at most what its source delivers.
        live_hz=sum(min(live_hz, rate_hz or math.inf) for rate_hz in rates) if live.enabled() else 0.0,
        batch_s=car.section("record").number("batch_s", usage.batch_s),
        watched_hours=None if when == ALWAYS else usage.watched_hours,
        live_transport=transport if when == ALWAYS else usage.live_transport,
        ping_hz=car.section("ping").number("rate_hz", usage.ping_hz),
        agent_every_s=metrics.number("every_s", usage.agent_every_s) if metrics.enabled() else 0.0,
        streams=len(rates),
        rate_hz=mean(rate_hz or usage.rate_hz for rate_hz in rates),
    )


def _rates_hz(source: _Section) -> list[float | None]:
    """The rate of each stream of a source; None if the file does not tell it."""
    kind = source.values.get("type")
    if kind in _OWN_RATE_HZ:
        rate_hz = source.number("rate_hz", _OWN_RATE_HZ[kind])
        poses_hz = source.section("pose").number("rate_hz", _POSE_RATE_HZ) if kind == "sim" else 0.0
        return [rate_hz, min(rate_hz, poses_hz)] if poses_hz else [rate_hz]
    topics = source.section("topics").values.values()
    names = {str(topic.get("stream") if isinstance(topic, dict) else topic) for topic in topics}
    return [None] * max(1, len(names))


class _Section:
    """A mapping in the file; errors name the file and the key."""

    def __init__(self, file: Path, name: str, values: Any) -> None:
        self._file, self._name = file, name
        self.values: Mapping[Any, Any] = values or {}
        if not isinstance(self.values, Mapping):
            raise self._error("", "a mapping", values)

    def section(self, key: str) -> _Section:
        return _Section(self._file, self._path(key), self.values.get(key))

    def items(self, key: str) -> list[_Section]:
        found = self.values.get(key)
        if not isinstance(found, list) or not found:
            raise self._error(key, "a list of at least one item", found)
        return [_Section(self._file, self._path(f"{key}[{i}]"), item) for i, item in enumerate(found)]

    def number(self, key: str, default: float) -> float:
        found = self.values.get(key, default)
        if isinstance(found, bool) or not isinstance(found, (int, float)) or not 0 <= found < math.inf:
            raise self._error(key, "a number of at least 0", found)
        return float(found)

    def choice(self, key: str, allowed: Sequence[str], default: str) -> str:
        found = self.values.get(key, default)
        if found not in allowed:
            raise self._error(key, f"one of {', '.join(allowed)}", found)
        return str(found)

    def enabled(self) -> bool:
        found = self.values.get("enabled", True)
        if not isinstance(found, bool):
            raise self._error("enabled", "true or false", found)
        return found

    def _path(self, key: str) -> str:
        return f"{self._name}.{key}".strip(".")

    def _error(self, key: str, allowed: str, found: Any) -> StationError:
        path = self._path(key)
        return StationError(f"{self._file}: {path}{': ' * bool(path)}must be {allowed}, got {found!r}")


def _content(file: Path) -> Any:
    try:
        return yaml.safe_load(file.read_text())
    except (OSError, UnicodeDecodeError) as error:
        raise StationError(f"{file} cannot be read: {error}") from error
    except yaml.YAMLError as error:
        raise StationError(f"{file} is not YAML: {error}") from error


# --- from the deployment

_INSIGHTS = re.compile(r'SELECT SUM\((?P<metric>\w+)\) FROM "(?P<namespace>[\w/]+)"')


def as_deployed(usage: Usage, cloud: Cloud) -> Usage:
    """The usage with live messages, memory, concurrency, logs, alarms, dashboards, recovery and key as
    deployed.

    Alarms and dashboards are the whole account's, like CloudWatch's free allowances.
    """
    deployed = {**_functions(cloud), **watching(cloud), **_tables(cloud)}
    return replace(usage, live_transport=transport(cloud), **deployed)


def _functions(cloud: Cloud) -> dict[str, Any]:
    client = cloud.client("lambda")
    names = [cloud.output("processing", f"{name}Function") for name in ("Live", "Summarize")]
    live, summarize = (client.get_function_configuration(FunctionName=name) for name in names)
    reserved = client.get_function_concurrency(FunctionName=names[0])
    level = live.get("LoggingConfig", {}).get("SystemLogLevel")
    return {
        "live_memory_mb": live["MemorySize"],
        "summarize_memory_mb": summarize["MemorySize"],
        "function_logs": "own" if level == "WARN" else "all",
        "live_concurrency": reserved.get("ReservedConcurrentExecutions", 0),
    }


def watching(cloud: Cloud) -> dict[str, Any]:
    """The alarms and dashboards."""
    client = cloud.client("cloudwatch")
    pages = client.get_paginator("describe_alarms").paginate()
    alarms = [alarm for page in pages for alarm in page.get("MetricAlarms", [])]
    matches = (
        [_INSIGHTS.match(query.get("Expression", "")) for query in alarm.get("Metrics", [])]
        for alarm in alarms
    )
    queries = [query for query in (next(filter(None, found), None) for found in matches) if query]
    # The robots' dashboard comes last, where `dashboard_metrics` counts what its searches find.
    names = sorted(cloudwatch.dashboards(cloud), key=lambda name: name == f"{cloud.namespace}-robots")
    counted = [cloudwatch.count(cloudwatch.body_of(cloud, name)) for name in names]
    return {
        "alarms": len(alarms) - len(queries),
        "insights_metrics": sum(_metrics(client, query) for query in queries),
        "dashboards": tuple(one.metrics for one in counted),
        "robot_metrics": bool(counted and counted[-1].searches),
    }


def _metrics(client: Any, query: re.Match[str]) -> int:
    """The number of metrics that a query analyses."""
    pages = client.get_paginator("list_metrics").paginate(
        Namespace=query["namespace"], MetricName=query["metric"], RecentlyActive="PT3H"
    )
    return sum(len(page["Metrics"]) for page in pages)


def _tables(cloud: Cloud) -> dict[str, Any]:
    table, dynamodb = cloud.output("storage", "TelemetryTable"), cloud.client("dynamodb")
    encryption = dynamodb.describe_table(TableName=table)["Table"].get("SSEDescription", {})
    backups = dynamodb.describe_continuous_backups(TableName=table)["ContinuousBackupsDescription"]
    recovery = backups.get("PointInTimeRecoveryDescription", {})
    return {
        "customer_key": encryption.get("SSEType") == "KMS",
        "recoverable": recovery.get("PointInTimeRecoveryStatus") == "ENABLED",
    }
