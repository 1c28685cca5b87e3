"""Every alarm with its threshold; docs/cloud.md says what to do about each."""

from __future__ import annotations

from aws_cdk import Duration
from aws_cdk import aws_cloudwatch as cloudwatch
from aws_cdk import aws_cloudwatch_actions as actions
from aws_cdk import aws_sns as sns
from constructs import Construct

from stacks.monitoring import metrics
from stacks.monitoring.watched import Watched
from stacks.settings import Settings

_FIVE_MINUTES = Duration.minutes(5)


class Alarms(Construct):
    """An alarm notifies the topic when it goes off, not when it ends. Missing data is no alarm: a fleet that
    is switched off sends none. ``every`` lists all alarms, the most urgent first."""

    def __init__(
        self, scope: Construct, construct_id: str, *, settings: Settings, watched: Watched, topic: sns.ITopic
    ) -> None:
        super().__init__(scope, construct_id)
        self.every: list[cloudwatch.IAlarm] = []
        self._namespace = settings.namespace
        self._tell = actions.SnsAction(topic)
        self._lost_or_late(settings, watched)
        self._cars(settings)
        if not settings.embedded:
            self._never_kept()

    def _lost_or_late(self, settings: Settings, watched: Watched) -> None:
        for name, queue in watched.queues.items():
            if name == "PutOff":
                # A car that empties its queue after an outage exceeds its share for some minutes.
                what = "a robot is over its share of Lambda 2, and its summaries are late"
                self._alarm(f"{name}Waiting", metrics.waiting(queue), 0, what, periods=15)
            else:
                self._alarm(f"{name}Waiting", metrics.waiting(queue), 0, "messages are in quarantine")
        for name, function in watched.functions.items():
            failed = metrics.function("Errors", function).with_(period=_FIVE_MINUTES)
            self._alarm(f"{name}Errors", failed, 0, "the function failed")
        for name, table in watched.tables.items():
            throttled = metrics.table("WriteThrottleEvents", table).with_(period=_FIVE_MINUTES)
            self._alarm(f"{name}Throttled", throttled, 0, "the table refused writes")
        limits = settings.thresholds
        for name, function in watched.readers.items():
            age = metrics.function("IteratorAge", function)
            behind_ms = limits.stream_behind_s * 1000
            self._alarm(f"{name}Behind", age, behind_ms, "the stream is read late", periods=3)
        self._ours("Quarantined", "quarantine", 0, "messages that could not be processed are in quarantine")
        # Of five minutes: a live lane at 0.01 Hz, the slowest allowed, sends in three of them.
        self._ours("PubNubFailed", "live", 0, "live samples did not reach PubNub", periods=3, within=5)
        late_ms = limits.car_to_lambda_ms
        self._ours("CarToLambdaMs", "live", late_ms, "live samples are late", periods=3, within=5)
        self._ours("BatchesMissing", "summarize", 0, "batches of a car are missing")
        self._ours("BatchesRefused", "summarize", 0, "batches cannot be decoded")

    def _never_kept(self) -> None:
        """Messages that can be lost without being in quarantine. Account-wide, since AWS documents no values
        for some of the dimensions; the embedded cloud has no Metrics Insights."""
        for name, namespace, what in (
            ("ParseError", "AWS/IoT", "messages are not JSON, and a rule could not read them"),
            ("ErrorActionFailure", "AWS/IoT", "failed messages of a rule did not reach the quarantine"),
            ("RuleMessageThrottled", "AWS/IoT", "messages did not reach a rule"),
            ("DestinationDeliveryFailures", "AWS/Lambda", "failures of a function are not in quarantine"),
        ):
            self._alarm(name, metrics.of_the_account(namespace, name), 0, what)

    def _cars(self, settings: Settings) -> None:
        """From the record lane, which is lossless; the rules fault and battery are faster and name the
        car."""
        limits = settings.thresholds
        self._ours("FaultSamples", "health", 0, "a car reports a fault")
        self._ours("TemperatureDegC", "health", limits.high_temperature_degc, "a car's controller is hot")
        self._ours("BatteryVolts", "health", limits.low_voltage_v, "a car's battery is low", below=True)

    def _ours(
        self,
        name: str,
        function: str,
        limit: float,
        what: str,
        *,
        periods: int = 1,
        within: int | None = None,
        below: bool = False,
    ) -> None:
        metric = metrics.ours(function, name, namespace=self._namespace)
        self._alarm(name, metric, limit, what, periods=periods, within=within, below=below)

    def _alarm(
        self,
        name: str,
        metric: cloudwatch.IMetric,
        limit: float,
        what: str,
        *,
        periods: int = 1,
        within: int | None = None,
        below: bool = False,
    ) -> None:
        """``periods`` over the limit set it off: in a row, or ``within`` that many periods."""
        operator = cloudwatch.ComparisonOperator
        alarm = cloudwatch.Alarm(
            self,
            name,
            alarm_name=f"{self._namespace}-{name}",
            alarm_description=f"{what}. What to do: docs/cloud.md",
            metric=metric,
            threshold=limit,
            comparison_operator=operator.LESS_THAN_THRESHOLD if below else operator.GREATER_THAN_THRESHOLD,
            evaluation_periods=within or periods,
            datapoints_to_alarm=periods,
            treat_missing_data=cloudwatch.TreatMissingData.NOT_BREACHING,
        )
        alarm.add_alarm_action(self._tell)
        self.every.append(alarm)
