"""The metrics that the functions write, each with its unit, chart and alarm.

Log lines, dashboards, alarms and the tables of docs/cloud.md are made from these entries, in this order.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from iort_contract.catalog.alarms import Alarm

METRIC_NAMESPACE = "iort"
# The dimensions of every metric: the deployment's namespace and the function.
METRIC_DEPLOYMENT, METRIC_FUNCTION = "Deployment", "Function"
# The third dimension, with `robot_metrics`: AWS bills each robot's metrics.
METRIC_ROBOT = "Robot"


@dataclass(frozen=True)
class Chart:
    """A chart of a dashboard: it shows the metrics that name it."""

    title: str


QUEUES = Chart("Queues: messages waiting")
LIVE = Chart("PubNub: live samples published")
REPORTS = Chart("Agents: reports a minute, six from each")
BATCHES = Chart("Samples and batches a minute")
GAPS = Chart("Gaps: holes between samples, missing and refused batches")
BACKLOG = Chart("Backlog: batches waiting in the fullest car")
HOPS = Chart("Delay of live samples by hop, p95 ms")
ROUND_TRIPS = Chart("Round trips of the cars' pings, p95 ms")
BATTERY = Chart("Battery of the weakest car, V")
TEMPERATURE = Chart("Temperature of the hottest controller, degC")
FAULTS = Chart("Samples with a fault code, and alerts sent")
PRESENCE = Chart("Robots: who comes and goes")
ADMISSION = Chart("Robots: admitted and refused, and pongs sent")
FILES = Chart("Robots: files")
# The rows of the robots' dashboard. QUEUES and LIVE are on the platform's.
ROBOT_CHARTS: tuple[tuple[Chart, ...], ...] = (
    (REPORTS, BATCHES, GAPS, BACKLOG),
    (HOPS, ROUND_TRIPS),
    (BATTERY, TEMPERATURE, FAULTS),
    (PRESENCE, ADMISSION, FILES),
)


@dataclass(frozen=True)
class Metric:
    """A metric, with its statistic of a minute.

    ``function`` is its dimension; ``right`` is the chart's second axis. A metric ``of_a_robot`` has a chart
    of every robot, with `robot_metrics`.
    """

    name: str
    function: str
    chart: Chart
    right: bool = False
    unit: str = "Count"
    statistic: str = "Sum"
    alarm: Alarm | None = None
    of_a_robot: bool = False


_delay = partial(Metric, unit="Milliseconds", statistic="p95")

METRICS = {
    metric.name: metric
    for metric in (
        Metric(
            "Quarantined",
            "quarantine",
            QUEUES,
            right=True,
            alarm=Alarm(
                "messages that could not be processed are in quarantine",
                "`iort errors` lists them with their reasons; remove the cause, then `iort replay-errors`",
            ),
        ),
        Metric("LivePublished", "live", LIVE),
        Metric(
            "PubNubFailed",
            "live",
            LIVE,
            right=True,
            # Of five minutes: a live lane at 0.01 Hz, the slowest allowed, sends in three of them.
            alarm=Alarm(
                "live samples did not reach PubNub",
                "its keys (`iort pubnub`), its status page; the record lane is not touched",
                periods=3,
                within=5,
            ),
        ),
        Metric("LiveStale", "live", LIVE, right=True),
        Metric("LiveRefused", "live", LIVE, right=True),
        Metric("LiveCutOff", "live", LIVE, right=True),
        _delay("InCarMs", "live", HOPS),
        _delay("UplinkMs", "live", HOPS),
        _delay("ToLambdaMs", "live", HOPS),
        _delay(
            "CarToLambdaMs",
            "live",
            HOPS,
            alarm=Alarm(
                "live samples are late",
                "the car's network; the hops on the robots' dashboard say which part of the way. Samples too "
                "old to be shown count; only cars that know their clock's offset do",
                threshold="car_to_lambda_ms",
                periods=3,
                within=5,
            ),
        ),
        Metric("SampleGaps", "health", GAPS),
        Metric(
            "BatchesMissing",
            "summarize",
            GAPS,
            alarm=Alarm(
                "batches of a car are missing",
                "[`iort audit`](audit.md) says which; a late one fills the hole, a dropped one does not",
            ),
        ),
        Metric(
            "BatchesRefused",
            "summarize",
            GAPS,
            alarm=Alarm(
                "batches cannot be decoded",
                "an agent of another version, or not ours: they are in quarantine with their bytes",
            ),
        ),
        Metric("BatchesPutOff", "summarize", GAPS),
        Metric("SamplesSummarized", "summarize", BATCHES),
        Metric("BatchesSummarized", "summarize", BATCHES),
        Metric("AgentReports", "health", REPORTS),
        # The worst car counts; a mean would hide it. From the record lane, which is lossless; the rules fault
        # and battery are faster and name the car.
        Metric(
            "FaultSamples",
            "health",
            FAULTS,
            of_a_robot=True,
            alarm=Alarm(
                "a car reports a fault",
                "stop it and look; `iort query` with a condition on `fault_code` finds the car",
            ),
        ),
        Metric(
            "TemperatureDegC",
            "health",
            TEMPERATURE,
            unit="None",
            statistic="Maximum",
            of_a_robot=True,
            alarm=Alarm(
                "a car's controller is hot",
                "let it cool; a VESC throttles by itself from 85 degC",
                threshold="high_temperature_degc",
            ),
        ),
        Metric(
            "BatteryVolts",
            "health",
            BATTERY,
            unit="None",
            statistic="Minimum",
            of_a_robot=True,
            alarm=Alarm(
                "a car's battery is low",
                "change it: a lithium cell below 3 V is damaged",
                threshold="low_voltage_v",
                below=True,
            ),
        ),
        Metric("BacklogBatches", "health", BACKLOG, statistic="Maximum", of_a_robot=True),
        _delay("RoundTripBrokerMs", "health", ROUND_TRIPS),
        _delay("RoundTripRuleMs", "health", ROUND_TRIPS),
        _delay("RoundTripLambdaMs", "health", ROUND_TRIPS),
        Metric("AlertsSent", "alert", FAULTS, right=True),
        Metric("AlertsHeld", "alert", FAULTS, right=True),
        Metric("RobotsConnected", "presence", PRESENCE),
        Metric("RobotsDisconnected", "presence", PRESENCE),
        Metric("PresenceIgnored", "presence", PRESENCE),
        Metric("RobotsAdmitted", "admit", ADMISSION),
        Metric("RobotsRefused", "admit", ADMISSION),
        Metric("PongsSent", "echo", ADMISSION, right=True),
        Metric("FilesAsked", "upload", FILES),
        Metric("FilesStored", "upload", FILES),
        Metric("FilesRefused", "upload", FILES),
        Metric("StoredBytes", "upload", FILES, unit="Bytes"),
    )
}


def metrics_of(function: str) -> tuple[str, ...]:
    """The names of a function's metrics."""
    return tuple(metric.name for metric in METRICS.values() if metric.function == function)
