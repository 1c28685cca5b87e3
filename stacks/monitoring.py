"""What is watched: a dashboard over every service that a message passes."""

from __future__ import annotations

from typing import Any

from aws_cdk import Duration, Stack
from aws_cdk import aws_budgets as budgets
from aws_cdk import aws_cloudwatch as cloudwatch
from aws_cdk import aws_lambda as lambda_
from constructs import Construct

from contract import METRIC_DEPLOYMENT, METRIC_FUNCTION, METRIC_NAMESPACE, METRICS, RULES, rule_name
from stacks.fleet import Fleet
from stacks.processing import Processing
from stacks.quarantine import Quarantine
from stacks.settings import Settings
from stacks.storage import Storage

# The action each rule runs, as IoT Core names it in the dimension ActionType of its metrics.
_ACTION_TYPES = dict.fromkeys(RULES, "Lambda") | {"record": "DynamoDBv2", "pong": "Republish"}
_PERIOD = Duration.minutes(1)


class Monitoring(Stack):
    """One dashboard, a row a service in the order of the path."""

    def __init__(
        self,
        scope: Construct,
        construct_id: str,
        *,
        settings: Settings,
        storage: Storage,
        quarantine: Quarantine,
        processing: Processing,
        fleet: Fleet,
        **kwargs: Any,
    ) -> None:
        super().__init__(scope, construct_id, **kwargs)
        self._namespace = settings.namespace
        dashboard = cloudwatch.Dashboard(
            self,
            "Platform",
            default_interval=Duration.hours(3),
            period_override=cloudwatch.PeriodOverride.AUTO,
        )
        dashboard.add_widgets(*self._broker(), *self._rules())
        dashboard.add_widgets(*self._storage(storage))
        dashboard.add_widgets(*self._functions(processing, fleet))
        dashboard.add_widgets(*self._own(), self._queues(quarantine))
        if settings.budget_usd:
            self._budget(settings)

    def _budget(self, settings: Settings) -> None:
        """Of the whole account: a budget by tag counts nothing until somebody activates the tag."""

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

    def _broker(self) -> list[cloudwatch.GraphWidget]:
        return [
            _graph(
                "Broker: connections and messages",
                [_metric("AWS/IoT", f"{name}.Success", Protocol="MQTT") for name in ("Connect", "PublishIn")],
                right=[
                    _metric("AWS/IoT", name, Protocol="MQTT")
                    for name in ("Connect.AuthError", "PublishIn.AuthError", "PublishIn.Throttle")
                ],
            )
        ]

    def _rules(self) -> list[cloudwatch.GraphWidget]:
        matched, failed = [], []
        for rule in RULES:
            name = rule_name(rule, self._namespace)
            matched.append(_metric("AWS/IoT", "TopicMatch", label=rule, RuleName=name))
            action = {"RuleName": name, "ActionType": _ACTION_TYPES[rule]}
            failed.append(_metric("AWS/IoT", "Failure", label=f"{rule} failed", **action))
            failed.append(_metric("AWS/IoT", "ParseError", label=f"{rule} unparsable", RuleName=name))
        return [_graph("Rules: matches", matched), _graph("Rules: failures", failed)]

    @staticmethod
    def _storage(storage: Storage) -> list[cloudwatch.GraphWidget]:
        tables = {"telemetry": storage.telemetry, "summary": storage.summary}
        units = [
            metric
            for name, table in tables.items()
            for metric in (
                table.metric_consumed_write_capacity_units(period=_PERIOD, label=f"{name} written"),
                table.metric_consumed_read_capacity_units(period=_PERIOD, label=f"{name} read"),
            )
        ]
        throttled = [
            _metric("AWS/DynamoDB", event, label=f"{name} {event}", TableName=table.table_name)
            for name, table in tables.items()
            for event in ("WriteThrottleEvents", "ReadThrottleEvents")
        ]
        return [_graph("Tables: capacity units", units), _graph("Tables: throttled", throttled)]

    @staticmethod
    def _functions(processing: Processing, fleet: Fleet) -> list[cloudwatch.GraphWidget]:
        named = dict(zip(("live", "summarize", "echo", "upload", "query"), processing.functions, strict=True))
        named |= {"admit": fleet.admit, "presence": fleet.presence}

        def each(
            title: str, metric: str, statistic: str, *also: cloudwatch.IMetric
        ) -> cloudwatch.GraphWidget:
            lines = [
                function.metric(metric, statistic=statistic, period=_PERIOD, label=name)
                for name, function in named.items()
            ]
            return _graph(title, [*lines, *also])

        behind: lambda_.Function = processing.summarize
        age = behind.metric("IteratorAge", statistic="max", period=_PERIOD, label="summarize is behind by")
        return [
            each("Functions: duration p95, ms", "Duration", "p95"),
            each("Functions: concurrency", "ConcurrentExecutions", "max"),
            each("Functions: errors", "Errors", "sum"),
            each("Functions: throttles", "Throttles", "sum"),
            _graph("Stream: iterator age, ms", [age]),
        ]

    def _own(self) -> list[cloudwatch.GraphWidget]:
        return [
            _graph(
                f"{function}: {METRIC_NAMESPACE} metrics",
                [
                    _metric(
                        METRIC_NAMESPACE,
                        name,
                        statistic="p95" if name.endswith("Ms") else "sum",
                        **{METRIC_DEPLOYMENT: self._namespace, METRIC_FUNCTION: function},
                    )
                    for name in names
                ],
            )
            for function, names in METRICS.items()
        ]

    @staticmethod
    def _queues(quarantine: Quarantine) -> cloudwatch.GraphWidget:
        queues = {"on the way in": quarantine.rejected, "not kept": quarantine.last}
        waiting = [
            queue.metric_approximate_number_of_messages_visible(period=_PERIOD, label=label)
            for label, queue in queues.items()
        ]
        return _graph("Quarantine: messages waiting", waiting)


def _metric(
    namespace: str, name: str, *, label: str | None = None, statistic: str = "sum", **dimensions: str
) -> cloudwatch.Metric:
    return cloudwatch.Metric(
        namespace=namespace,
        metric_name=name,
        dimensions_map=dimensions,
        statistic=statistic,
        period=_PERIOD,
        label=label or name,
    )


def _graph(
    title: str, left: list[cloudwatch.IMetric], right: list[cloudwatch.IMetric] | None = None
) -> cloudwatch.GraphWidget:
    return cloudwatch.GraphWidget(title=title, left=left, right=right or [], width=8, height=6)
