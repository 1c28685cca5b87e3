"""The dashboards: the platform, a row per service in the order of a message's path, the services, the robots.

A dashboard of up to fifty metrics is free, three per account. A metric with an alarm that is normally zero is
therefore not drawn again, and no widget uses SEARCH (decision 34).
"""

from __future__ import annotations

from collections.abc import Sequence

from aws_cdk import Duration
from aws_cdk import aws_cloudwatch as cloudwatch
from constructs import Construct

from iort_contract.catalog.metrics import (
    LIVE_CHART,
    METRICS,
    QUEUES_CHART,
    ROBOT_CHARTS,
    SERVICE_CHARTS,
    Chart,
)
from stacks.monitoring import metrics
from stacks.monitoring.watched import Watched
from stacks.settings import Settings

# The functions and tables that every sample passes; without PubNub there is no Live.
_FUNCTIONS_OF_SAMPLES, _TABLES_OF_SAMPLES = ("Live", "Summarize"), ("Batches", "Summary")
# Nobody waits for these, and fifty metrics are free.
_IN_THE_BACKGROUND = {"Plan", "Analyse", "Evaluate", "Present"}


class Dashboards(Construct):
    """``<namespace>-platform``, which starts with the state of every alarm, ``-services`` and ``-robots``."""

    def __init__(
        self,
        scope: Construct,
        settings: Settings,
        *,
        watched: Watched,
        alarms: Sequence[cloudwatch.IAlarm],
    ) -> None:
        super().__init__(scope, "Dashboards")
        self._namespace, self._rules = settings.namespace, settings.rules
        platform = self._dashboard("Platform")
        platform.add_widgets(
            cloudwatch.AlarmStatusWidget(title="Alarms", alarms=list(alarms), width=24, height=4)
        )
        platform.add_widgets(_warnings(watched))
        platform.add_widgets(*self._broker_and_rules(), _tables(watched))
        platform.add_widgets(*_functions(watched))
        platform.add_widgets(_iterator_age(watched), self._queues(watched))
        platform.add_widgets(self._chart(LIVE_CHART))
        services = self._dashboard("Services")
        for row in SERVICE_CHARTS:
            services.add_widgets(*map(self._chart, row))
        robots = self._dashboard("Robots")
        for row in ROBOT_CHARTS:
            robots.add_widgets(*map(self._chart, row))
        if settings.robot_metrics:
            robots.add_widgets(
                *(
                    _graph(f"{metric.name}, each robot", [metrics.each_robot(metric, self._namespace)])
                    for metric in METRICS.values()
                    if metric.of_a_robot
                )
            )

    def _dashboard(self, name: str) -> cloudwatch.Dashboard:
        return cloudwatch.Dashboard(
            self,
            name,
            dashboard_name=f"{self._namespace}-{name.lower()}",
            default_interval=Duration.hours(3),
            period_override=cloudwatch.PeriodOverride.INHERIT,
        )

    def _chart(self, chart: Chart) -> cloudwatch.GraphWidget:
        return _graph(chart.title, self._ours(chart, right=False), self._ours(chart, right=True))

    def _ours(self, chart: Chart, *, right: bool) -> list[cloudwatch.IMetric]:
        shown = [one for one in METRICS.values() if one.chart == chart and one.right == right]
        return [metrics.ours(metric, self._namespace) for metric in shown]

    def _broker_and_rules(self) -> list[cloudwatch.GraphWidget]:
        refused = [metrics.broker(f"{what}.AuthError") for what in ("Connect", "PublishIn", "Subscribe")]
        matched = [
            metrics.rule("TopicMatch", rule.physical_name(self._namespace), label=rule.name)
            for rule in self._rules
        ]
        return [
            _graph(
                "Broker: connections and messages, all of the account",
                [metrics.broker(f"{what}.Success") for what in ("Connect", "PublishIn", "PublishOut")],
                right=[*refused, metrics.broker("PublishIn.Throttle")],
            ),
            _graph("Rules: messages matched", matched),
        ]

    def _queues(self, watched: Watched) -> cloudwatch.GraphWidget:
        waiting = [metrics.waiting(queue, label=label) for label, queue in watched.queues.items()]
        return _graph(QUEUES_CHART.title, waiting, self._ours(QUEUES_CHART, right=True))


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


def _functions(watched: Watched) -> list[cloudwatch.GraphWidget]:
    running = "ConcurrentExecutions"
    durations = [
        metrics.function("Duration", of, label=label)
        for label, of in watched.functions.items()
        if label not in _IN_THE_BACKGROUND
    ]
    concurrency = [
        metrics.function(running, watched.functions[name], label=name)
        for name in _FUNCTIONS_OF_SAMPLES
        if name in watched.functions
    ]
    return [
        _graph("Functions: duration p95, ms", durations),
        _graph(
            "Functions: concurrency",
            [metrics.function(running, label="all of the account"), *concurrency],
        ),
        _graph(
            "Functions: errors and throttles, all of the account",
            [metrics.function("Errors"), metrics.function("Throttles")],
        ),
    ]


def _iterator_age(watched: Watched) -> cloudwatch.GraphWidget:
    return _graph(
        "Streams: iterator age, ms",
        [metrics.function("IteratorAge", of, label=label) for label, of in watched.readers.items()],
    )


def _graph(
    title: str, left: Sequence[cloudwatch.IMetric], right: Sequence[cloudwatch.IMetric] = ()
) -> cloudwatch.GraphWidget:
    return cloudwatch.GraphWidget(
        title=title, left=list(left), right=list(right), width=8, height=6, period=metrics.PERIOD
    )
