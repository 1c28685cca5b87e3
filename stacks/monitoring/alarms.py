"""Every alarm: the catalogue's entries, tied to the resources that they watch."""

from __future__ import annotations

from aws_cdk import Duration
from aws_cdk import aws_cloudwatch as cloudwatch
from aws_cdk import aws_cloudwatch_actions as actions
from aws_cdk import aws_sns as sns
from constructs import Construct

from iort_contract.catalog.alarms import OF_THE_ACCOUNT
from iort_contract.catalog.metrics import METRICS, alarm_of
from stacks.monitoring import metrics
from stacks.monitoring.watched import Watched
from stacks.settings import Settings

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
            self._add(f"{name}Waiting", metrics.waiting(queue))
        for name, function in watched.functions.items():
            self._add(f"{name}Errors", metrics.function("Errors", function).with_(period=_FIVE_MINUTES))
        for name, table in watched.tables.items():
            throttled = metrics.table("WriteThrottleEvents", table).with_(period=_FIVE_MINUTES)
            self._add(f"{name}Throttled", throttled)
        written = metrics.table("ConsumedWriteCapacityUnits", watched.tables["Batches"])
        self._add("BatchesVolume", written.with_(period=Duration.hours(1)))
        for name, reader in watched.readers.items():
            self._add(f"{name}Behind", metrics.function("IteratorAge", reader))
        for name, machine in watched.machines.items():
            self._add(f"{name}Failed", metrics.machine("ExecutionsFailed", machine))
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
