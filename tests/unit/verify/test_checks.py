"""The verdicts of questions that the embedded cloud cannot be asked, with fake clouds."""

from __future__ import annotations

import io
import itertools
import json
from types import SimpleNamespace

import pytest

from testkit.target import AWS
from verify.question import Verdict, ask
from verify.questions import ALL

QUESTIONS = {question.name: question for question in ALL}


class Cloud:
    """A fake cloud that answers each operation with the given function."""

    namespace = "iort"

    def __init__(self, **operations):
        self.operations = SimpleNamespace(**operations)

    def client(self, _service):
        return self.operations

    def output(self, noun, name):
        return f"{noun}-{name}"


def verdict(name, cloud):
    target = SimpleNamespace(kind=AWS, cloud=cloud, name=str, robot=lambda base: SimpleNamespace(robot=base))
    answer = ask(QUESTIONS[name], target, itertools.count().__next__)
    return answer.verdict, answer.seen or answer.reason


@pytest.mark.parametrize(
    ("status", "expected"),
    [("ENABLED", Verdict.AS_ASSUMED), ("ENABLING", Verdict.AS_ASSUMED), ("DISABLED", Verdict.DIFFERS)],
)
def test_the_expiry_of_items_is_compared_with_the_assumption(status, expected):
    told = {"TimeToLiveDescription": {"TimeToLiveStatus": status, "AttributeName": "expires_s"}}
    cloud = Cloud(describe_time_to_live=lambda **_: told)
    assert verdict("dynamodb.expiry", cloud)[0] is expected


def insights(code="Complete", count=4, **alarm):
    """A fake CloudWatch with this number of Metrics Insights alarms."""

    def describe_alarms(*, AlarmNames):
        metrics = [{"Expression": 'SELECT SUM(ParseError) FROM "AWS/IoT"'}]
        return {
            "MetricAlarms": [
                {"AlarmName": name, "StateValue": "OK", "Metrics": metrics, **alarm}
                for name in AlarmNames[:count]
            ]
        }

    def get_metric_data(*, MetricDataQueries, **_):
        assert all(query["Period"] == 60 for query in MetricDataQueries)
        return {"MetricDataResults": [{"StatusCode": code} for _ in MetricDataQueries]}

    return Cloud(describe_alarms=describe_alarms, get_metric_data=get_metric_data)


@pytest.mark.parametrize(
    ("cloud", "expected"),
    [
        (insights(), Verdict.AS_ASSUMED),
        (insights(StateValue="ALARM"), Verdict.AS_ASSUMED),
        (insights(EvaluationState="EVALUATION_ERROR"), Verdict.DIFFERS),
        (insights(code="InternalError"), Verdict.DIFFERS),
        (insights(count=3), Verdict.DIFFERS),
    ],
)
def test_metrics_insights_alarms_are_compared_with_the_assumption(cloud, expected):
    assert verdict("alarms.metrics_insights", cloud)[0] is expected


@pytest.mark.parametrize(
    ("runs", "expected"), [("python3.13", Verdict.AS_ASSUMED), ("python3.12", Verdict.DIFFERS)]
)
def test_the_runtime_is_compared_with_the_assumption(runs, expected):
    deleted = []
    configuration = {"Runtime": "python3.13", "Role": "role"}
    cloud = Cloud(
        get_function_configuration=lambda **_: configuration,
        create_function=lambda **_: None,
        get_waiter=lambda _: SimpleNamespace(wait=lambda **_: None),
        invoke=lambda **_: {"Payload": io.BytesIO(json.dumps(runs).encode())},
        delete_function=lambda **named: deleted.append(named),
    )
    assert verdict("functions.python", cloud)[0] is expected
    assert len(deleted) == 1
