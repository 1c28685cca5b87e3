"""The metrics that the functions write, each with its unit, chart and alarm.

Log lines, dashboards, alarms and the tables of docs/ are made from these entries, in this order.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Iterator

from iort_contract.catalog.alarms import OF_ONE_RESOURCE, OF_RESOURCES, OF_THE_ACCOUNT, Alarm
from iort_contract.tables import ALERT_FAULT, ALERT_LOW_VOLTAGE

METRIC_NAMESPACE = "iort"
# The dimensions of every metric: the deployment's namespace and the function.
METRIC_DEPLOYMENT, METRIC_FUNCTION = "Deployment", "Function"
# The third dimension, with `robot_metrics`: AWS bills each robot's metrics.
METRIC_ROBOT = "Robot"


# The title of a dashboard's chart, which shows the metrics that name it.
Chart = str
QUEUES_CHART = "Queues: messages waiting"
LIVE_CHART = "PubNub: live samples published"
REPORTS_CHART = "Agents: reports a minute, six from each"
BATCHES_CHART = "Samples and batches a minute"
GAPS_CHART = "Gaps: holes between samples, missing and refused batches"
BACKLOG_CHART = "Backlog: batches waiting in the fullest car"
HOPS_CHART = "Delay of live samples by hop, p95 ms"
ROUND_TRIPS_CHART = "Round trips of the cars' pings, p95 ms"
BATTERY_CHART = "Battery of the weakest car, V"
TEMPERATURE_CHART = "Temperature of the hottest controller, degC"
FAULTS_CHART = "Samples with a fault code, and alerts sent"
PRESENCE_CHART = "Robots: who comes and goes"
ADMISSION_CHART = "Robots: admitted and refused, and pongs sent"
FILES_CHART = "Robots: files"
ARCHIVE_CHART = "Archive: hours a minute, and what is overdue or was put off"
INCIDENTS_CHART = "Recorder: incidents told, and what failed"
ASKS_CHART = "Robots: questions, and the time of an answer, p95 ms"
# What the robots ask of the cloud, and what it does by itself: the rows of the services' dashboard.
SERVICE_CHARTS: tuple[tuple[Chart, ...], ...] = (
    (PRESENCE_CHART, ADMISSION_CHART, INCIDENTS_CHART),
    (FILES_CHART, ARCHIVE_CHART, ASKS_CHART),
)
# The rows of the robots' dashboard. QUEUES_CHART and LIVE_CHART are on the platform's.
ROBOT_CHARTS: tuple[tuple[Chart, ...], ...] = (
    (REPORTS_CHART, BATCHES_CHART, GAPS_CHART, BACKLOG_CHART),
    (HOPS_CHART, ROUND_TRIPS_CHART),
    (BATTERY_CHART, TEMPERATURE_CHART, FAULTS_CHART),
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


def _counts(function: str, chart: Chart, *names: str, right: bool = False) -> Iterator[Metric]:
    return (Metric(name, function, chart, right=right) for name in names)


METRICS = {
    metric.name: metric
    for metric in (
        Metric(
            "Quarantined",
            "quarantine",
            QUEUES_CHART,
            right=True,
            alarm=Alarm(
                "messages that could not be processed are in quarantine",
                "`iort errors` lists them with their reasons; remove the cause, then `iort replay-errors`",
                evidence="quarantine",
            ),
        ),
        Metric("LivePublished", "live", LIVE_CHART),
        Metric(
            "PubNubFailed",
            "live",
            LIVE_CHART,
            right=True,
            # Of five minutes: a live lane at 0.01 Hz, the slowest allowed, sends in three of them.
            alarm=Alarm(
                "live samples did not reach PubNub",
                "its keys (`iort pubnub`), its status page; the record lane is not touched",
                periods=3,
                within=5,
            ),
        ),
        # Without PubNub's keys there is nothing to be alarmed at.
        *_counts(
            "live", LIVE_CHART, "LiveNotConfigured", "LiveStale", "LiveRefused", "LiveCutOff", right=True
        ),
        *(_delay(name, "live", HOPS_CHART) for name in ("InCarMs", "UplinkMs", "ToLambdaMs")),
        _delay(
            "CarToLambdaMs",
            "live",
            HOPS_CHART,
            alarm=Alarm(
                "live samples are late",
                "the car's network; the hops on the robots' dashboard say which part of the way. Samples too "
                "old to be shown count; only cars that know their clock's offset do",
                threshold="car_to_lambda_ms",
                periods=3,
                within=5,
                evidence="cars",
            ),
        ),
        Metric("SampleGaps", "health", GAPS_CHART),
        Metric(
            "BatchesMissing",
            "summarize",
            GAPS_CHART,
            alarm=Alarm(
                "batches of a car are missing",
                "[`iort audit`](../reference/audit.md) says which; a late one fills the hole, a "
                "dropped one does not",
                evidence="cars",
            ),
        ),
        Metric(
            "BatchesRefused",
            "summarize",
            GAPS_CHART,
            alarm=Alarm(
                "batches cannot be decoded",
                "an agent of another version, or not ours: they are in quarantine with their bytes",
                evidence="quarantine",
            ),
        ),
        Metric("BatchesPutOff", "summarize", GAPS_CHART),
        Metric(
            "RobotsOverVolume",
            "summarize",
            BATCHES_CHART,
            right=True,
            alarm=Alarm(
                "a robot has recorded more than its bytes of a day",
                "nothing is refused, and it costs money: Lambda 2's log names the robot; mend what it sends "
                "(`record` in car.yaml), raise `record_gb_a_day`, or `iort robots remove`",
            ),
        ),
        *_counts("summarize", BATCHES_CHART, "SamplesSummarized", "BatchesSummarized"),
        Metric("AgentReports", "health", REPORTS_CHART),
        Metric(
            "ThreadErrors",
            "health",
            REPORTS_CHART,
            right=True,
            alarm=Alarm(
                "a part of a car's agent failed by a mistake in its code, and was started again",
                "`iort-agent status` on the car names the thread, its stream `log` has the error: report it. "
                "Until it runs again the car may take no commands, or send late",
                evidence="cars",
            ),
        ),
        # The worst car counts; a mean would hide it. From the record lane, which is lossless; the rules fault
        # and battery are faster and name the car.
        Metric(
            "FaultSamples",
            "health",
            FAULTS_CHART,
            of_a_robot=True,
            alarm=Alarm(
                "a car reports a fault",
                "stop it and look; `iort query` with a condition on `fault_code` finds the car",
                evidence="cars",
                alert=ALERT_FAULT,
            ),
        ),
        Metric(
            "TemperatureDegC",
            "health",
            TEMPERATURE_CHART,
            unit="None",
            statistic="Maximum",
            of_a_robot=True,
            alarm=Alarm(
                "a car's controller is hot",
                "let it cool; a VESC throttles by itself from 85 degC",
                threshold="high_temperature_degc",
                evidence="cars",
            ),
        ),
        Metric(
            "BatteryVolts",
            "health",
            BATTERY_CHART,
            unit="None",
            statistic="Minimum",
            of_a_robot=True,
            alarm=Alarm(
                "a car's battery is low",
                "change it: a lithium cell below 3 V is damaged",
                threshold="low_voltage_v",
                below=True,
                evidence="cars",
                alert=ALERT_LOW_VOLTAGE,
            ),
        ),
        Metric("BacklogBatches", "health", BACKLOG_CHART, statistic="Maximum", of_a_robot=True),
        *(
            _delay(name, "health", ROUND_TRIPS_CHART)
            for name in ("RoundTripBrokerMs", "RoundTripRuleMs", "RoundTripLambdaMs")
        ),
        *_counts("alert", FAULTS_CHART, "AlertsSent", "AlertsHeld", right=True),
        *_counts("incident", INCIDENTS_CHART, "IncidentMails", "WebhooksSent"),
        # Over a robot's mails of an hour.
        *_counts("incident", INCIDENTS_CHART, "IncidentsHeld", right=True),
        Metric(
            "WebhooksFailed",
            "incident",
            INCIDENTS_CHART,
            right=True,
            alarm=Alarm(
                "the webhook's receiver did not take incidents",
                "`iort webhook test` says why. Each is tried nine times within some minutes, and is then in "
                "quarantine: `iort errors`; mend the receiver, then `iort replay-errors`",
                evidence="quarantine",
            ),
        ),
        Metric("FindingTakes", "present", INCIDENTS_CHART),
        *_counts("presence", PRESENCE_CHART, "RobotsConnected", "RobotsDisconnected", "PresenceIgnored"),
        *_counts("admit", ADMISSION_CHART, "RobotsAdmitted", "RobotsRefused"),
        Metric("PongsSent", "echo", ADMISSION_CHART, right=True),
        *_counts("upload", FILES_CHART, "FilesAsked", "FilesStored", "FilesRefused"),
        Metric("StoredBytes", "upload", FILES_CHART, unit="Bytes"),
        *_counts("archive", ARCHIVE_CHART, "HoursArchived", "DaysJoined"),
        Metric("SamplesArchived", "archive", ARCHIVE_CHART, right=True),
        Metric("BytesArchived", "archive", ARCHIVE_CHART, right=True, unit="Bytes"),
        Metric("ItemsSetAside", "archive", ARCHIVE_CHART),
        Metric(
            "TasksOverdue",
            "archive",
            ARCHIVE_CHART,
            statistic="Maximum",
            alarm=Alarm(
                "hours of telemetry wait for the archive for more than three hours",
                "nothing is lost: the archive's function failed, and its log says why. It tries again every "
                "hour; `iort archive verify` lists what is missing ([the archive](../reference/archive.md))",
            ),
        ),
        Metric(
            "ExpiriesPutOff",
            "archive",
            ARCHIVE_CHART,
            alarm=Alarm(
                "telemetry would have expired before it was archived, and was given 30 more days",
                "the archive has failed for long: its function's log says why. Mend it within the 30 days, "
                "then `iort archive run`",
            ),
        ),
        *_counts("answer", ASKS_CHART, "QuestionsAnswered", "QuestionsRefused"),
        # From the rule's receipt to the answer's publish.
        _delay("AnswerMs", "answer", ASKS_CHART, right=True),
    )
}


def metrics_of(function: str) -> tuple[str, ...]:
    """The names of a function's metrics."""
    return tuple(metric.name for metric in METRICS.values() if metric.function == function)


def alarm_of(name: str) -> Alarm | None:
    """The entry of an alarm, by the alarm's name without the deployment's; None if it is not ours."""
    metric = METRICS.get(name)
    if metric is not None:
        return metric.alarm
    named = {**OF_ONE_RESOURCE, **{metric: alarm for (_, metric), alarm in OF_THE_ACCOUNT.items()}}
    endings = (alarm for ending, alarm in OF_RESOURCES.items() if name.endswith(ending))
    return named.get(name) or next(endings, None)
