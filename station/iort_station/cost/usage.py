"""How a fleet is driven, with everything that affects its bill: as given, or from a car.yaml."""

from __future__ import annotations

import math
from collections.abc import Mapping
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
from iort_station.errors import StationError, UsageError

TRANSPORTS = (PUBNUB, IOT)
# A car without round-trip pings still pings for its clock offset; a test compares this with the agent.
CLOCK_PING_S = 30.0


@dataclass(frozen=True, kw_only=True)
class Usage:
    """How a fleet is driven. The defaults are the agent's and the stacks' own.

    A robot has ``streams`` of ``rate_hz`` samples a second each, in batches of ``batch_s``. Somebody looks at
    it for ``watched_hours`` of its hours a day; at other times it sends a live message of each stream every
    `LIVE_BROKER_EVERY_S`. None is for ``live.when: always``. Each of ``viewers`` watches the whole fleet in
    those hours. The archive's items are counted for ``archive_days``, 0 for none; every night drives of
    ``drive_minutes`` are analysed, 0 for none. Only AWS knows the billed milliseconds ``live_ms`` and
    ``summarize_ms``: they are assumptions.

    Each viewer looks through a robot's camera for ``video_minutes`` of its hour, at ``video_kbps``. The share
    ``video_relayed`` of that passes a relay, and ``video_broker`` goes as pictures over the broker,
    ``picture_hz`` of ``picture_bytes``; the rest goes directly.

    Alarms by Metrics Insights analyse ``insights_metrics`` together. ``dashboards`` has the metrics on each;
    ``robot_metrics`` adds to the last. ``function_logs`` "all" adds Lambda's own log lines.
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
    incidents_per_hour: float = 0.0
    video_minutes: float = 0.0
    video_relayed: float = 0.0
    video_broker: float = 0.0
    video_kbps: float = 1000.0
    picture_hz: float = 4.0
    picture_bytes: int = 20_000
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
    function_logs: str = "own"
    alarms: int = 43
    insights_metrics: int = 65
    dashboards: tuple[int, ...] = (49, 25, 22)
    dashboard_hours: float = 20.0
    robot_metrics: bool = False
    recoverable: bool = False
    customer_key: bool = False

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
            ("video_minutes", self.video_minutes <= 60, "0 to 60"),
            (
                "video_relayed and video_broker",
                self.video_relayed + self.video_broker <= 1,
                "shares of at most 1 together",
            ),
            ("live_transport", self.live_transport in TRANSPORTS, f"one of {', '.join(TRANSPORTS)}"),
        ):
            if not holds:
                got = " and ".join(str(getattr(self, one)) for one in name.split(" and "))
                raise UsageError(f"{name} must be {allowed}, got {got}")
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


# --- from a robot's car.yaml; `iort-agent check` judges the whole file

# Sources that take samples at a rate of their own, with its default, and that of a simulated car's poses, a
# stream beside its samples; a test compares them with the agent's.
_OWN_RATE_HZ, _POSE_RATE_HZ = {"sim": 50.0, "vesc": 50.0}, 20.0


def as_configured(usage: Usage, file: Path) -> Usage:
    """The usage with the rates of a car.yaml; raises `StationError` for an invalid file.

    The file does not tell the rates of ROS topics and recordings; these stay as in ``usage``.
    """
    try:
        car = yaml.safe_load(file.read_text())
        rates = [rate for source in car["sources"] for rate in _rates_hz(source)]
        live, metrics = ({"enabled": True, **(car.get(name) or {})} for name in ("live", "metrics"))
        live_hz = float(live.get("rate_hz", usage.live_hz))
        always = live.get("when", WATCHED) == ALWAYS
        return replace(
            usage,
            # The limit applies to each stream, which sends at most what its source delivers.
            live_hz=live["enabled"] * sum(min(live_hz, rate_hz or math.inf) for rate_hz in rates),
            batch_s=float((car.get("record") or {}).get("batch_s", usage.batch_s)),
            watched_hours=None if always else usage.watched_hours,
            live_transport=live.get("transport", usage.live_transport) if always else usage.live_transport,
            ping_hz=float((car.get("ping") or {}).get("rate_hz", usage.ping_hz)),
            agent_every_s=metrics["enabled"] * float(metrics.get("every_s", usage.agent_every_s)),
            streams=len(rates),
            rate_hz=mean(rate_hz or usage.rate_hz for rate_hz in rates),
        ).check()
    except (AttributeError, KeyError, OSError, TypeError, ValueError, yaml.YAMLError, UsageError) as error:
        raise StationError(
            f"{file} must be as `iort-agent check` accepts it, got {type(error).__name__}: {error}"
        ) from error


def _rates_hz(source: Mapping[str, Any]) -> list[float | None]:
    """The rate of each stream of a source; None if the file does not tell it."""
    kind = source.get("type", "")
    if kind not in _OWN_RATE_HZ:
        topics = (source.get("topics") or {}).values()
        names = {str(topic.get("stream") if isinstance(topic, dict) else topic) for topic in topics}
        return [None] * max(1, len(names))
    rate_hz = float(source.get("rate_hz", _OWN_RATE_HZ[kind]))
    poses = source.get("pose") or {}
    poses_hz = float(poses.get("rate_hz", _POSE_RATE_HZ)) if kind == "sim" else 0.0
    return [rate_hz, min(rate_hz, poses_hz)] if poses_hz else [rate_hz]
