"""The embedded cloud's CloudWatch: its sources, its searches and its alarms."""

from __future__ import annotations

import json
import time

import pytest
from ministack.core.responses import request_scope
from ministack.services import cloudwatch, sqs

from functions.shared.metrics import emit
from local.emulator.fixes import alarms, metrics


@pytest.fixture(autouse=True)
def empty():
    cloudwatch.reset()
    yield
    cloudwatch.reset()


def values(namespace, name, **dimensions):
    alarms = cloudwatch._metrics.get((namespace, name, cloudwatch._dims_key(dimensions))) or []
    return sorted(point["Value"] for point in alarms for _ in range(int(point["Count"])))


def test_a_printed_metric_line_is_recorded(capsys, monkeypatch):
    monkeypatch.setenv("NAMESPACE", "lab2")
    emit("health", robot="car7", BatteryVolts=[11.5, 11.25], FaultSamples=3)
    log = f"START\n{capsys.readouterr().out}" + '{"_aws": broken\n{"_aws": {}}\nnot a metric'
    metrics.record_log(log)
    whole = {"Deployment": "lab2", "Function": "health"}
    assert values("iort", "BatteryVolts", **whole) == [11.25, 11.5]
    assert values("iort", "BatteryVolts", **whole, Robot="car7") == [11.25, 11.5]
    assert values("iort", "FaultSamples", **whole) == [3]


def test_a_minute_of_many_values_keeps_their_count_within_bounds():
    for value in range(1000):
        alarms.record("iort", "CarToLambdaMs", value, "Milliseconds")
    assert len(values("iort", "CarToLambdaMs")) == 1000
    # The test may run past the end of a minute.
    assert len(cloudwatch._metrics["iort", "CarToLambdaMs", ""]) <= 2 * 120


def test_a_search_finds_a_metric_of_any_action_type():
    alarms.record("AWS/IoT", "Failure", 1, "Count", RuleName="iort_record", ActionType="DynamoDBv2")
    alarms.record("AWS/IoT", "Failure", 1, "Count", RuleName="iort_live", ActionType="Lambda")
    search = (
        "SEARCH('{AWS/IoT,ActionType,RuleName} MetricName=\"Failure\" RuleName=\"iort_record\"', 'Sum', 60)"
    )
    (query,) = metrics.expand({"Id": "a", "Expression": search, "Label": "failed"})
    assert (query["Id"], query["Label"], "Expression" in query) == ("a", "failed", False)
    assert query["MetricStat"]["Metric"]["Dimensions"] == [
        {"Name": "ActionType", "Value": "DynamoDBv2"},
        {"Name": "RuleName", "Value": "iort_record"},
    ]
    assert not list(metrics.expand({"Id": "a", "Expression": search.replace("iort_record", "iort_echo")}))
    plain = {"Id": "b", "MetricStat": {}}
    assert list(metrics.expand(plain)) == [plain]
    sums = {"Id": "c", "Expression": "a + b"}
    assert list(metrics.expand(sums)) == [sums]


ALARM = {
    "AlarmName": "iort-FaultSamples",
    "Namespace": "iort",
    "MetricName": "FaultSamples",
    "Dimensions": [{"Name": "Deployment", "Value": "iort"}],
    "Statistic": "Sum",
    "Period": 60,
    "EvaluationPeriods": 2,
    "Threshold": 0,
    "ComparisonOperator": "GreaterThanThreshold",
}


def point(at_s, value):
    bucket = cloudwatch._metric_bucket(("iort", "FaultSamples", "Deployment=iort"))
    bucket.append({"Timestamp": at_s, "Value": value, "Count": 1.0, "Unit": "Count", "Dimensions": {}})


def test_an_alarm_needs_all_periods_and_its_own_dimensions():
    now_s = 1_700_000_100.0
    cloudwatch._metric_bucket(("iort", "FaultSamples", "Deployment=lab2")).append(
        {"Timestamp": now_s, "Value": 9.0, "Count": 1.0, "Unit": "Count", "Dimensions": {}}
    )
    assert not alarms.breaching(ALARM, now_s)
    point(now_s, 1.0)
    assert not alarms.breaching(ALARM, now_s)
    point(now_s - 60, 1.0)
    assert alarms.breaching(ALARM, now_s)
    # The alarm is over: a minute without data does not breach.
    assert not alarms.breaching(ALARM, now_s + 180)
    below = {**ALARM, "ComparisonOperator": "LessThanThreshold", "Threshold": 0.5}
    assert not alarms.breaching(below, now_s)


def test_an_alarm_goes_off_and_ends():
    alarm = {**ALARM, "StateValue": "INSUFFICIENT_DATA", "EvaluationPeriods": 1, "AlarmActions": []}
    point(time.time(), 4.0)
    alarms.evaluate(alarm)
    assert alarm["StateValue"] == "ALARM"
    assert "FaultSamples" in alarm["StateReason"]
    cloudwatch._metrics.clear()
    alarms.evaluate(alarm)
    assert alarm["StateValue"] == "OK"
    states = [json.loads(entry["HistoryData"]) for entry in cloudwatch._history_entries()]
    assert [state["newState"]["stateValue"] for state in states] == ["ALARM", "OK"]


def test_an_alarm_from_before_a_start_stays_as_long_as_its_lost_points_could_keep_it():
    raised_s = time.time() - 30
    alarm = {**ALARM, "StateValue": "ALARM", "EvaluationPeriods": 2, "AlarmActions": []}
    alarm["StateUpdatedTimestamp"] = raised_s
    alarms.evaluate(alarm, since_s=raised_s + 10)
    assert alarm["StateValue"] == "ALARM"
    alarms.evaluate(alarm, since_s=raised_s - 100)
    assert alarm["StateValue"] == "OK"


@pytest.mark.parametrize("failed", [False, True])
def test_an_invocation_is_counted(failed):
    execute = metrics.counting_invocations(lambda *_: {"error": failed})
    newest = {"dynamodb": {"ApproximateCreationDateTime": time.time() - 60}}
    execute({}, {"FunctionName": "f"}, {"Records": [newest]}, "id", time.time())
    assert values("AWS/Lambda", "Invocations", FunctionName="f") == [1]
    assert values("AWS/Lambda", "Errors", FunctionName="f") == values("AWS/Lambda", "Errors") == [failed]
    assert values("AWS/Lambda", "ConcurrentExecutions", FunctionName="f") == [1]
    (age_ms,) = values("AWS/Lambda", "IteratorAge", FunctionName="f")
    assert age_ms >= 60_000


def test_waiting_messages_are_counted():
    with request_scope("000000000000", "eu-west-1"):
        url = sqs._act_create_queue({"QueueName": "counted"}, "")["QueueUrl"]
        try:
            sqs._act_send_message({"MessageBody": "text"}, url)
            metrics.count()
        finally:
            sqs._act_delete_queue({"QueueUrl": url}, "")
        assert values("AWS/SQS", "ApproximateNumberOfMessagesVisible", QueueName="counted") == [1]
