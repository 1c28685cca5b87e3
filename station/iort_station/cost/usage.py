"""How a fleet is driven, as far as it makes a bill."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from iort_contract.limits import LIVE_BROKER_EVERY_S
from iort_contract.messages.account import ACCOUNT_EVERY_S
from iort_station.cost.prices import MONTH_DAYS
from iort_station.errors import StationError

# A car that measures no round trips still pings a rule for its clock's offset; a test holds it to the agent.
CLOCK_PING_S = 30.0


@dataclass(frozen=True, kw_only=True)
class Usage:
    """How the fleet is driven. The defaults are the agent's and the stacks' own.

    A robot has ``streams``, each of ``rate_hz`` samples a second; ``live_hz`` are the live messages of all
    of them and ``ping_hz`` the pings a path, a second and robot; a batch spans ``batch_s``;
    ``agent_every_s`` between the agent's own figures; robots drive ``hours_per_day``; each of ``viewers``
    watches the whole fleet all that time; items are kept ``retention_days``, ``recoverable`` to a point in
    time in stage prod. A robot connects ``connects_per_hour`` and is sent ``command_hz`` commands a second.
    ``alarms`` watch a metric each; those by Metrics Insights analyse up to ``insights_metrics`` together.
    ``dashboards`` are the metrics on each; ``robot_metrics``, a deployment's parameter, adds to the last.
    Somebody has them open on the live page ``dashboard_hours`` a month.
    ``function_logs`` is the deployment's parameter: "all" adds Lambda's own lines about every invocation.
    What only AWS can say, the billed milliseconds of an invocation, and of each batch that Lambda 2 finds
    in one, are assumptions and named so.
    """

    robots: int = 1
    rate_hz: float = 50.0
    streams: int = 1
    live_hz: float = 10.0
    batch_s: float = 1.0
    ping_hz: float = 0.0
    agent_every_s: float = 10.0
    connects_per_hour: float = 1.0
    command_hz: float = 0.0
    hours_per_day: float = 2.0
    viewers: int = 1
    retention_days: int = 90
    live_memory_mb: int = 256
    live_ms: float = 20.0
    live_concurrency: int = 0
    summarize_memory_mb: int = 512
    summarize_ms: float = 20.0
    summarize_batch_ms: float = 5.0
    function_logs: str = "own"
    alarms: int = 26
    insights_metrics: int = 48
    dashboards: tuple[int, ...] = (45, 30)
    dashboard_hours: float = 20.0
    robot_metrics: bool = False
    recoverable: bool = False
    customer_key: bool = False
    device_defender: bool = False

    def check(self) -> Usage:
        """Itself; raises `StationError` for what no fleet can do."""
        for name, value in vars(self).items():
            if isinstance(value, (int, float)) and value < 0:
                raise StationError(f"{name} {value}: allowed is 0 or more")
        if self.robots < 1:
            raise StationError(f"robots {self.robots}: allowed is 1 or more")
        if self.streams < 1:
            raise StationError(f"streams {self.streams}: allowed is 1 or more")
        if not 0 < self.rate_hz <= 2000:
            raise StationError(f"rate {self.rate_hz} Hz: allowed is more than 0 and up to 2000")
        if self.batch_s > 1:
            raise StationError(f"batch of {self.batch_s} s: allowed is 0 to 1, 0 sends each sample by itself")
        if not 0 < self.hours_per_day <= 24:
            raise StationError(f"{self.hours_per_day} hours a day: allowed is more than 0 and up to 24")
        return self

    @property
    def batches_per_s(self) -> float:
        """Batches of the sources' streams, a robot."""
        return self.streams * self.stream_batches_per_s

    @property
    def samples_per_s(self) -> float:
        """Samples of the sources' streams, a robot."""
        return self.streams * self.rate_hz

    @property
    def stream_batches_per_s(self) -> float:
        """Batches of one of the sources' streams."""
        return min(self.rate_hz, max(1.0, 1 / self.batch_s)) if self.batch_s else self.rate_hz

    @property
    def own_batches_per_s(self) -> float:
        """Batches of the agent's own streams: its figures, its accounts, and round trips where it measures
        them."""
        figures = 1 / self.agent_every_s if self.agent_every_s else 0.0
        return figures + 1 / ACCOUNT_EVERY_S + min(1.0, 3 * self.ping_hz)

    @property
    def live_at_broker_per_s(self) -> float:
        """Live messages that pass the broker, a robot, while its fault code stays what it is."""
        return min(self.live_hz, self.streams / LIVE_BROKER_EVERY_S)

    @property
    def clock_pings_per_s(self) -> float:
        """Pings through a rule, a robot, by which it knows the cloud's clock."""
        return 0.0 if self.ping_hz else 1 / CLOCK_PING_S

    @property
    def robot_hours_per_month(self) -> float:
        """Of the whole fleet."""
        return self.robots * self.hours_per_day * MONTH_DAYS


def variations(usage: Usage) -> Iterator[tuple[str, Usage]]:
    """The settings that change the bill, one at a time."""
    yield "as configured", usage
    for live_hz in (5.0, 2.0, 1.0, 0.0):
        if live_hz != usage.live_hz:
            name = f"live lane at {live_hz:g} Hz" if live_hz else "no live lane"
            yield name, replace(usage, live_hz=live_hz)
    for batch_s in (0.2, 0.0):
        name = f"batches of {batch_s:g} s" if batch_s else "one sample a batch"
        yield name, replace(usage, batch_s=batch_s)
    yield "round trips measured at 1 Hz", replace(usage, ping_hz=1.0)
    yield "commands at 10 Hz", replace(usage, command_hz=10.0)
    yield "connecting anew every minute", replace(usage, connects_per_hour=60.0)
    yield "with Lambda's own log lines", replace(usage, function_logs="all")
    yield "kept for 30 days", replace(usage, retention_days=30)
    yield "tables recoverable to a point in time (`prod`)", replace(usage, recoverable=True)
    yield "a thousand robots", replace(usage, robots=1000)
