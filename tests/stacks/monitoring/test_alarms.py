"""Every failure that must be noticed has an alarm, and every alarm is documented."""

from __future__ import annotations

import re

from iort_contract.catalog.rules import LOW_VOLTAGE_V, RULES
from iort_contract.limits import LIVE_MIN_RATE_HZ
from iort_station.cost.usage import Usage
from stacks.settings import ROOT, Settings
from tests.stacks.monitoring.aws_metrics import AWS_METRICS
from tests.stacks.templates import name


def test_every_queue_function_and_table_has_an_alarm(synthesized, alarms):
    for kind, ending in (
        ("AWS::SQS::Queue", "Waiting"),
        ("AWS::Lambda::Function", "Errors"),
        ("AWS::DynamoDB::Table", "Throttled"),
    ):
        for logical_id in synthesized.resources(kind):
            assert f"{name(logical_id)}{ending}" in alarms


def test_every_loss_outside_the_quarantine_has_an_alarm(alarms):
    asked = {}
    for alarm, properties in alarms.items():
        if "Metrics" in properties:
            (query,) = properties["Metrics"]
            assert query["ReturnData"] is not False
            metric, namespace = re.fullmatch(
                r'SELECT SUM\((\w+)\) FROM "([\w/]+)"', query["Expression"]
            ).groups()
            asked[alarm] = (namespace, metric)
    known = {(key[0], metric) for key, names in AWS_METRICS.items() for metric in names}
    assert set(asked.values()) <= known
    assert asked == {
        "ParseError": ("AWS/IoT", "ParseError"),
        "ErrorActionFailure": ("AWS/IoT", "ErrorActionFailure"),
        "RuleMessageThrottled": ("AWS/IoT", "RuleMessageThrottled"),
        "DestinationDeliveryFailures": ("AWS/Lambda", "DestinationDeliveryFailures"),
    }


def test_the_cost_model_counts_every_alarm(synthesized, alarms):
    """Alarms by Metrics Insights count by the metrics that they read after every failure: one a rule, and for
    Lambda one a function, one a function with its qualifier, and one for all."""
    insights = [alarm["Metrics"][0]["Expression"] for alarm in alarms.values() if "Metrics" in alarm]
    assert Usage().alarms == len(alarms) - len(insights)
    of_lambda = 2 * len(synthesized.resources("AWS::Lambda::Function")) + 1
    most = [len(RULES) if "AWS/IoT" in query else of_lambda for query in insights]
    assert Usage().insights_metrics == sum(most)


def test_every_alarm_notifies_the_topic_and_is_documented(alarms, reader):
    text = (ROOT / "docs/how-to/alarms.md").read_text()
    for alarm, properties in alarms.items():
        assert reader.texts(properties["AlarmActions"]) == ["Alarms"]
        assert properties["TreatMissingData"] == "notBreaching"
        # It is shown in AWS' console and in its mail, where docs/ is not.
        description = properties["AlarmDescription"]
        assert re.fullmatch(r"\w.*\. What to do: .*", description)
        assert "](" not in description
        assert len(description) <= 1024
        generic = re.sub(r"^.*(Waiting|Errors|Throttled|Behind|Failed)$", r"\1", alarm)
        assert f"`{generic}`" in text or f"`...{generic}`" in text, (
            f"docs/how-to/alarms.md says nothing of {alarm}"
        )


def test_the_thresholds_come_from_the_settings(production, synthesized):
    alarms = {
        a["AlarmName"]: a["Threshold"] for a in synthesized.resources("AWS::CloudWatch::Alarm").values()
    }
    limits = Settings()
    assert alarms["iort-BatteryVolts"] == limits.low_voltage_v == LOW_VOLTAGE_V
    assert alarms["iort-TemperatureDegC"] == limits.high_temperature_degc
    assert alarms["iort-CarToLambdaMs"] == limits.car_to_lambda_ms
    assert alarms["iort-SummarizeBehind"] == limits.stream_behind_s * 1000
    (alert,) = (f for k, f in synthesized.resources("AWS::Lambda::Function").items() if k.startswith("Alert"))
    assert float(alert["Environment"]["Variables"]["LOW_VOLTAGE_V"]) == limits.low_voltage_v


def test_the_slowest_live_lane_can_set_off_its_alarms(alarms):
    """A lane with one message in 100 s does not have a message in each of three successive minutes."""
    every_s = 1 / LIVE_MIN_RATE_HZ
    for name_ in ("PubNubFailed", "CarToLambdaMs"):
        alarm = alarms[name_]
        periods, needed = alarm["EvaluationPeriods"], alarm["DatapointsToAlarm"]
        assert alarm["Period"] == 60
        for offset_s in range(60):
            minutes = {int(offset_s + i * every_s) // 60 for i in range(100)}
            assert all(len(minutes & set(range(i, i + periods))) >= needed for i in range(100))


def test_the_address_subscribes_to_the_topic(production, synthesized):
    (subscription,) = production.resources("AWS::SNS::Subscription").values()
    assert (subscription["Protocol"], subscription["Endpoint"]) == ("email", "lab@example.org")
    assert not synthesized.resources("AWS::SNS::Subscription")
