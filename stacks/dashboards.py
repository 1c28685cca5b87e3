"""The two dashboards: the platform, a row per service in the order of a message's path, and the robots.

A dashboard of up to fifty metrics is free, three per account. A metric with an alarm that is normally zero is
therefore not drawn again, and no widget uses SEARCH (docs/decisions/0034-dashboards-of-fifty-metrics.md).
"""

from __future__ import annotations

from collections.abc import Sequence

from aws_cdk import Duration
from aws_cdk import aws_cloudwatch as cloudwatch
from constructs import Construct

from iort_contract.cloud import METRICS
from iort_contract.topics import RULES, rule_name
from stacks import metrics
from stacks.settings import Settings
from stacks.watched import Watched

# The hops of every sample.
_FUNCTIONS_OF_SAMPLES, _TABLES_OF_SAMPLES = ("Live", "Summarize"), ("Batches", "Summary")
_HOPS = ("InCarMs", "UplinkMs", "ToLambdaMs", "CarToLambdaMs")
_ROUND_TRIPS = ("RoundTripBrokerMs", "RoundTripRuleMs", "RoundTripLambdaMs")


class Dashboards(Construct):
    """``<namespace>-platform``, which starts with the state of every alarm, and ``<namespace>-robots``."""

    def __init__(
        self,
        scope: Construct,
        construct_id: str,
        *,
        settings: Settings,
        watched: Watched,
        alarms: Sequence[cloudwatch.IAlarm],
    ) -> None:
        super().__init__(scope, construct_id)
        self._namespace = settings.namespace
        platform = self._dashboard("Platform")
        status = cloudwatch.AlarmStatusWidget(title="Alarms", alarms=list(alarms), width=24, height=4)
        platform.add_widgets(status)
        platform.add_widgets(_warnings(watched))
        platform.add_widgets(*self._iot(), self._tables(watched))
        platform.add_widgets(*self._functions(watched))
        platform.add_widgets(*self._streams_and_queues(watched))
        platform.add_widgets(self._live())
        robots = self._dashboard("Robots")
        robots.add_widgets(*self._seen())
        robots.add_widgets(*self._delays())
        robots.add_widgets(*self._health())
        robots.add_widgets(*self._asked())
        if settings.robot_metrics:
            robots.add_widgets(*self._one_by_one())

    def _dashboard(self, name: str) -> cloudwatch.Dashboard:
        return cloudwatch.Dashboard(
            self,
            name,
            dashboard_name=f"{self._namespace}-{name.lower()}",
            default_interval=Duration.hours(3),
            period_override=cloudwatch.PeriodOverride.INHERIT,
        )

    def _ours(self, function: str, *names: str) -> list[cloudwatch.IMetric]:
        return [metrics.ours(function, name, namespace=self._namespace) for name in names]

    # --- platform ----------------------------------------------------------------------------------

    def _iot(self) -> list[cloudwatch.GraphWidget]:
        matched = [metrics.rule("TopicMatch", rule_name(rule, self._namespace), label=rule) for rule in RULES]
        refused = [metrics.broker(f"{what}.AuthError") for what in ("Connect", "PublishIn", "Subscribe")]
        return [
            _graph(
                "Broker: connections and messages, all of the account",
                [metrics.broker(f"{what}.Success") for what in ("Connect", "PublishIn", "PublishOut")],
                right=[*refused, metrics.broker("PublishIn.Throttle")],
            ),
            _graph("Rules: messages matched", matched),
        ]

    @staticmethod
    def _tables(watched: Watched) -> cloudwatch.GraphWidget:
        units = {"ConsumedWriteCapacityUnits": "written", "ConsumedReadCapacityUnits": "read"}
        return _graph(
            "Tables: capacity units",
            [
                metrics.table(name, watched.tables[table], label=f"{table} {what}")
                for name, what in units.items()
                for table in _TABLES_OF_SAMPLES
            ],
        )

    @staticmethod
    def _functions(watched: Watched) -> list[cloudwatch.GraphWidget]:
        running = "ConcurrentExecutions"
        return [
            _graph(
                "Functions: duration p95, ms",
                [metrics.function("Duration", of, label=label) for label, of in watched.functions.items()],
            ),
            _graph(
                "Functions: concurrency",
                [
                    metrics.all_functions(running, label="all of the account"),
                    *(
                        metrics.function(running, watched.functions[name], label=name)
                        for name in _FUNCTIONS_OF_SAMPLES
                    ),
                ],
            ),
            _graph(
                "Functions: errors and throttles, all of the account",
                [metrics.all_functions("Errors"), metrics.all_functions("Throttles")],
            ),
        ]

    def _streams_and_queues(self, watched: Watched) -> list[cloudwatch.GraphWidget]:
        return [
            _graph(
                "Streams: iterator age, ms",
                [metrics.function("IteratorAge", of, label=label) for label, of in watched.readers.items()],
            ),
            _graph(
                "Queues: messages waiting",
                [metrics.waiting(queue, label=label) for label, queue in watched.queues.items()],
                right=self._ours("quarantine", "Quarantined"),
            ),
        ]

    def _live(self) -> cloudwatch.GraphWidget:
        return _graph(
            "PubNub: live samples published",
            self._ours("live", "LivePublished"),
            right=self._ours("live", "PubNubFailed", "LiveStale", "LiveRefused", "LiveCutOff"),
        )

    # --- robots ------------------------------------------------------------------------------------

    def _seen(self) -> list[cloudwatch.GraphWidget]:
        return [
            _graph("Agents: reports a minute, six from each", self._ours("health", "AgentReports")),
            _graph(
                "Samples and batches a minute",
                self._ours("summarize", "SamplesSummarized", "BatchesSummarized"),
            ),
            _graph(
                "Gaps: holes between samples, missing and refused batches",
                [
                    *self._ours("health", "SampleGaps"),
                    *self._ours("summarize", "BatchesMissing", "BatchesRefused", "BatchesPutOff"),
                ],
            ),
            _graph("Backlog: batches waiting in the fullest car", self._ours("health", "BacklogBatches")),
        ]

    def _delays(self) -> list[cloudwatch.GraphWidget]:
        return [
            _graph("Delay of live samples by hop, p95 ms", self._ours("live", *_HOPS)),
            _graph("Round trips of the cars' pings, p95 ms", self._ours("health", *_ROUND_TRIPS)),
        ]

    def _health(self) -> list[cloudwatch.GraphWidget]:
        return [
            _graph("Battery of the weakest car, V", self._ours("health", "BatteryVolts")),
            _graph("Temperature of the hottest controller, degC", self._ours("health", "TemperatureDegC")),
            _graph(
                "Samples with a fault code, and alerts sent",
                self._ours("health", "FaultSamples"),
                right=self._ours("alert", *METRICS["alert"]),
            ),
        ]

    def _asked(self) -> list[cloudwatch.GraphWidget]:
        """Requests of robots to the cloud: presence, files, and round trips through a function."""
        return [
            _graph("Robots: who comes and goes", self._ours("presence", *METRICS["presence"])),
            _graph(
                "Robots: admitted and refused, and pongs sent",
                self._ours("admit", *METRICS["admit"]),
                right=self._ours("echo", *METRICS["echo"]),
            ),
            _graph("Robots: files", self._ours("upload", *METRICS["upload"])),
        ]

    def _one_by_one(self) -> list[cloudwatch.GraphWidget]:
        return [
            _graph(f"{name}, each robot", [metrics.each_robot("health", name, namespace=self._namespace)])
            for name in ("BatteryVolts", "TemperatureDegC", "FaultSamples", "BacklogBatches")
        ]


def _warnings(watched: Watched) -> cloudwatch.LogQueryWidget:
    """The newest warnings of functions, and of Lambda about them."""
    return cloudwatch.LogQueryWidget(
        title="Warnings and errors in the functions' logs, newest first",
        log_group_names=[function.log_group.log_group_name for function in watched.functions.values()],
        # Log levels of Python and of Lambda, in text and in JSON lines, and the traces of a crash.
        query_lines=[
            "fields @timestamp, @log, @message",
            "filter @message like /WARN|ERROR|CRITICAL|FATAL|Traceback|Task timed out/",
            "sort @timestamp desc",
            "limit 20",
        ],
        width=24,
        height=6,
    )


def _graph(
    title: str, left: list[cloudwatch.IMetric], right: list[cloudwatch.IMetric] | None = None
) -> cloudwatch.GraphWidget:
    return cloudwatch.GraphWidget(
        title=title, left=left, right=right or [], width=8, height=6, period=metrics.PERIOD
    )
