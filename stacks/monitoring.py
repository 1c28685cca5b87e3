"""Dashboards over every service that a message passes, alarms, and the budget."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

from aws_cdk import App, Duration, Stack
from aws_cdk import aws_budgets as budgets
from aws_cdk import aws_cloudwatch as cloudwatch
from aws_cdk import aws_cloudwatch_actions as actions
from aws_cdk import aws_dynamodb as dynamodb
from aws_cdk import aws_lambda as lambda_
from aws_cdk import aws_sns as sns
from aws_cdk import aws_sqs as sqs
from aws_cdk import aws_stepfunctions as stepfunctions
from constructs import Construct

from iort_contract.catalog.alarms import OF_THE_ACCOUNT
from iort_contract.catalog.metrics import (
    LIVE_CHART,
    METRICS,
    QUEUES_CHART,
    ROBOT_CHARTS,
    SERVICE_CHARTS,
    Chart,
    alarm_of,
)
from stacks import metrics
from stacks.parts import PlatformStack
from stacks.settings import Settings

_R = TypeVar("_R", bound=Construct)


@dataclass(frozen=True)
class Watched:
    """Functions, tables and queues by their construct's name; ``readers`` are the functions that read a
    stream. ``machines`` are state machines by their stack's name."""

    functions: Mapping[str, lambda_.Function]
    tables: Mapping[str, dynamodb.Table]
    queues: Mapping[str, sqs.Queue]
    readers: Mapping[str, lambda_.Function]
    machines: Mapping[str, stepfunctions.StateMachine]

    @classmethod
    def of(cls, stacks: Iterable[Stack]) -> Watched:
        """All resources of the stacks, in order."""
        made = [construct for stack in stacks for construct in stack.node.find_all()]

        def named(kind: type[_R]) -> dict[str, _R]:
            return {one.node.id: one for one in made if isinstance(one, kind)}

        mappings = (one.node.scope for one in made if isinstance(one, lambda_.EventSourceMapping))
        readers = {one.node.id: one for one in mappings if isinstance(one, lambda_.Function)}
        machines = {
            type(Stack.of(one)).__name__: one for one in made if isinstance(one, stepfunctions.StateMachine)
        }
        functions, tables, queues = named(lambda_.Function), named(dynamodb.Table), named(sqs.Queue)
        return cls(functions, tables, queues, readers, machines)


_FIVE_MINUTES = Duration.minutes(5)


class Alarms(Construct):
    """An alarm notifies the topic when it goes off, not when it ends. Missing data is no alarm: a fleet that
    is switched off sends none. ``every`` lists all alarms, the most urgent first."""

    def __init__(self, scope: Construct, settings: Settings, *, watched: Watched, topic: sns.ITopic) -> None:
        super().__init__(scope, "Alarms")
        self.every: list[cloudwatch.IAlarm] = []
        self._settings = settings
        self._tell = actions.SnsAction(topic)
        for name, queue in watched.queues.items():
            self._add(f"{name}Waiting", metrics.of(queue, metrics.WAITING))
        for name, function in watched.functions.items():
            self._add(f"{name}Errors", metrics.of(function, "Errors").with_(period=_FIVE_MINUTES))
        for name, table in watched.tables.items():
            throttled = metrics.of(table, "WriteThrottleEvents").with_(period=_FIVE_MINUTES)
            self._add(f"{name}Throttled", throttled)
        written = metrics.of(watched.tables["Batches"], "ConsumedWriteCapacityUnits")
        self._add("BatchesVolume", written.with_(period=Duration.hours(1)))
        for name, reader in watched.readers.items():
            self._add(f"{name}Behind", metrics.of(reader, "IteratorAge"))
        for name, machine in watched.machines.items():
            self._add(f"{name}Failed", metrics.of(machine, "ExecutionsFailed"))
        for metric in METRICS.values():
            if metric.alarm:
                self._add(metric.name, metrics.ours(metric, settings.namespace))
        # The embedded cloud has no Metrics Insights.
        if not settings.embedded:
            for namespace, name in OF_THE_ACCOUNT:
                self._add(name, metrics.of_the_account(namespace, name))

    def _add(self, name: str, metric: cloudwatch.IMetric) -> None:
        alarm = alarm_of(name)
        if alarm is None:
            raise ValueError(f"the catalogue has no alarm for {name}")
        limit = alarm.threshold
        if isinstance(limit, str):
            limit = getattr(self._settings, limit)
        operator = cloudwatch.ComparisonOperator
        made = cloudwatch.Alarm(
            self,
            name,
            alarm_name=f"{self._settings.namespace}-{name}",
            alarm_description=f"{alarm.meaning}. What to do: {alarm.advice}",
            metric=metric,
            threshold=limit * alarm.factor,
            comparison_operator=operator.LESS_THAN_THRESHOLD
            if alarm.below
            else operator.GREATER_THAN_THRESHOLD,
            evaluation_periods=alarm.within or alarm.periods,
            datapoints_to_alarm=alarm.periods,
            treat_missing_data=cloudwatch.TreatMissingData.NOT_BREACHING,
        )
        made.add_alarm_action(self._tell)
        self.every.append(made)


# A dashboard of up to fifty metrics is free, three per account. A metric with an alarm that is normally zero
# is therefore not drawn again, and no widget uses SEARCH (decision 34).

# The functions and tables that every sample passes; without PubNub there is no Live.
_FUNCTIONS_OF_SAMPLES, _TABLES_OF_SAMPLES = ("Live", "Summarize"), ("Batches", "Summary")
# Nobody waits for these, and fifty metrics are free.
_IN_THE_BACKGROUND = {"Incident", "Plan", "Analyse", "Evaluate", "Present"}


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
        return _graph(chart, self._ours(chart, right=False), self._ours(chart, right=True))

    def _ours(self, chart: Chart, *, right: bool) -> list[cloudwatch.IMetric]:
        shown = [one for one in METRICS.values() if one.chart == chart and one.right == right]
        return [metrics.ours(metric, self._namespace) for metric in shown]

    def _broker_and_rules(self) -> list[cloudwatch.GraphWidget]:
        names = {rule.name: {"RuleName": rule.physical_name(self._namespace)} for rule in self._rules}
        matched = [metrics.aws("AWS/IoT", "TopicMatch", of, label=label) for label, of in names.items()]

        def broker(name: str) -> cloudwatch.Metric:
            return metrics.aws("AWS/IoT", name, {"Protocol": "MQTT"})

        refused = [broker(f"{what}.AuthError") for what in ("Connect", "PublishIn", "Subscribe")]
        return [
            _graph(
                "Broker: connections and messages, all of the account",
                [broker(f"{what}.Success") for what in ("Connect", "PublishIn", "PublishOut")],
                right=[*refused, broker("PublishIn.Throttle")],
            ),
            _graph("Rules: messages matched", matched),
        ]

    def _queues(self, watched: Watched) -> cloudwatch.GraphWidget:
        waiting = [metrics.of(queue, metrics.WAITING, label=label) for label, queue in watched.queues.items()]
        return _graph(QUEUES_CHART, waiting, self._ours(QUEUES_CHART, right=True))


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
            metrics.of(watched.tables[table], name, label=f"{table} {what}")
            for name, what in units.items()
            for table in _TABLES_OF_SAMPLES
        ],
    )


def _functions(watched: Watched) -> list[cloudwatch.GraphWidget]:
    running = "ConcurrentExecutions"
    durations = [
        metrics.of(of, "Duration", label=label)
        for label, of in watched.functions.items()
        if label not in _IN_THE_BACKGROUND
    ]
    concurrency = [
        metrics.of(watched.functions[name], running, label=name)
        for name in _FUNCTIONS_OF_SAMPLES
        if name in watched.functions
    ]
    return [
        _graph("Functions: duration p95, ms", durations),
        _graph(
            "Functions: concurrency",
            [metrics.aws("AWS/Lambda", running, label="all of the account"), *concurrency],
        ),
        _graph(
            "Functions: errors and throttles, all of the account",
            [metrics.aws("AWS/Lambda", name) for name in ("Errors", "Throttles")],
        ),
    ]


def _iterator_age(watched: Watched) -> cloudwatch.GraphWidget:
    return _graph(
        "Streams: iterator age, ms",
        [metrics.of(of, "IteratorAge", label=label) for label, of in watched.readers.items()],
    )


def _graph(
    title: str, left: Sequence[cloudwatch.IMetric], right: Sequence[cloudwatch.IMetric] = ()
) -> cloudwatch.GraphWidget:
    return cloudwatch.GraphWidget(
        title=title, left=list(left), right=list(right), width=8, height=6, period=metrics.PERIOD
    )


class Monitoring(PlatformStack):
    """Watches every function, table and queue of ``stacks``; alarms notify ``topic``."""

    def __init__(self, app: App, settings: Settings, *, stacks: Sequence[Stack], topic: sns.ITopic) -> None:
        super().__init__(app, "monitoring", settings)
        watched = Watched.of(stacks)
        alarms = Alarms(self, settings, watched=watched, topic=topic)
        Dashboards(self, settings, watched=watched, alarms=alarms.every)
        if settings.budget_usd:
            self._budget(settings)

    def _budget(self, settings: Settings) -> None:
        """For the whole account: a budget by tag counts nothing until somebody activates the tag."""

        def told(kind: str, percent: float) -> budgets.CfnBudget.NotificationWithSubscribersProperty:
            return budgets.CfnBudget.NotificationWithSubscribersProperty(
                notification=budgets.CfnBudget.NotificationProperty(
                    notification_type=kind,
                    comparison_operator="GREATER_THAN",
                    threshold=percent,
                    threshold_type="PERCENTAGE",
                ),
                subscribers=[
                    budgets.CfnBudget.SubscriberProperty(
                        subscription_type="EMAIL", address=settings.alarm_email or ""
                    )
                ],
            )

        budgets.CfnBudget(
            self,
            "Budget",
            budget=budgets.CfnBudget.BudgetDataProperty(
                budget_type="COST",
                time_unit="MONTHLY",
                budget_limit=budgets.CfnBudget.SpendProperty(amount=settings.budget_usd, unit="USD"),
            ),
            notifications_with_subscribers=[told("ACTUAL", 80), told("FORECASTED", 100)],
        )
