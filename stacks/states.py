"""The states of the machine `analysis`, in the Amazon States Language with JSONPath.

The CDK's constructs have no reader that flattens many files into one map (LOAD_AND_FLATTEN), and the embedded
cloud evaluates no JSONata in a map's ItemSelector: decision 59.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from iort_contract.cloud import DRIVES, PLANS_PREFIX
from stacks.settings import AtOnce

# A run takes no longer: a night ends before the next one begins.
LONGEST_S = 12 * 3600
# A refused call has failed nothing, so it is repeated until the run ends, and is no failure of its item.
_MOST_PAUSE_S = 60
_REFUSED = {
    "ErrorEquals": ["Lambda.TooManyRequestsException"],
    "IntervalSeconds": 2,
    "BackoffRate": 2,
    "MaxDelaySeconds": _MOST_PAUSE_S,
    # Pauses are half as long on average. At three events each, a history's 25,000 last far longer.
    "MaxAttempts": 4 * LONGEST_S // _MOST_PAUSE_S,
    "JitterStrategy": "FULL",
}
# The service's own errors, which pass.
_PASSING = {
    "ErrorEquals": ["Lambda.ServiceException", "Lambda.AWSLambdaException", "Lambda.SdkClientException"],
    "IntervalSeconds": 2,
    "BackoffRate": 2,
    "MaxAttempts": 5,
    "JitterStrategy": "FULL",
}
# Three attempts of a function that fails, is killed or runs out of time or memory.
_FAILING = {"ErrorEquals": ["States.ALL"], "IntervalSeconds": 1, "BackoffRate": 3, "MaxAttempts": 2}

# What the functions get of one item.
_PLAN = ("robot", "start_us", "end_us", "again", "most", "job")
_ANALYSE = ("planned", "job")
_EVALUATE = ("robot", "others", "start_us", "end_us", "again", "job", "began_us")


def states(partition: str, functions: Mapping[str, str], *, bucket: str, at_once: AtOnce) -> dict[str, Any]:
    """The machine's definition, by the functions' ARNs. ``at_once`` limits robots and drives."""

    def call(function: str, payload: Mapping[str, Any], **more: Any) -> dict[str, Any]:
        return {
            "Type": "Task",
            "Resource": f"arn:{partition}:states:::lambda:invoke",
            "Parameters": {"FunctionName": functions[function], "Payload": payload},
            "Retry": [_REFUSED, _PASSING, _FAILING],
            **more,
        }

    def each(label: str, reader: Mapping[str, Any], at_once: int, **item: Any) -> dict[str, Any]:
        """A distributed map: each item is an execution with a history of its own. What fails in it, even the
        finding about it, ends no other one."""
        return {
            "Type": "Map",
            "Label": label,
            "ItemReader": reader,
            "MaxConcurrency": at_once,
            "ToleratedFailurePercentage": 100,
            **item,
        }

    def workflow(name: str, what: str, end: Mapping[str, Any], **more: dict[str, Any]) -> dict[str, Any]:
        """The states of an item, from ``name`` on; if that one fails, ``what`` becomes a finding. They may
        take as long as the run: AWS ends express executions after five minutes, in silence."""
        failed = {"failed.$": what, "error.$": "$.error", "state": name}
        caught = {"ErrorEquals": ["States.ALL"], "ResultPath": "$.error", "Next": "Failed"}
        first = {**next(iter(more.values())), "Catch": [caught]}
        return {
            "ProcessorConfig": {"Mode": "DISTRIBUTED", "ExecutionType": "STANDARD"},
            "StartAt": name,
            "States": {**more, name: first, "Failed": call("Present", failed, **end)},
        }

    def given(names: Sequence[str]) -> dict[str, str]:
        return {f"{name}.$": f"$.{name}" for name in names}

    def of_robot(names: Sequence[str]) -> dict[str, str]:
        """The input of an item that is a robot, with its own values before those of the run."""
        item = {f"{name}.$": f"$$.Map.Item.Value.{name}" for name in ("robot", "others") if name in names}
        return {**given(names), **item}

    robots = {
        "Resource": f"arn:{partition}:states:::s3:getObject",
        "ReaderConfig": {"InputType": "JSON"},
        "Parameters": {
            "Bucket": bucket,
            "Key.$": f"States.Format('{PLANS_PREFIX}{{}}/robots.json', $.job)",
        },
    }
    drives = f"States.Format('{PLANS_PREFIX}{{}}/{DRIVES}/', $.job)"
    # The results of thousands of items would not fit in a state; a number of findings does.
    nothing = {"ResultPath": None, "OutputPath": None, "End": True}
    findings = {"OutputPath": "$.Payload.findings", "End": True}
    return {
        "StartAt": "Robots",
        "States": {
            "Robots": call(
                "Plan",
                {"input.$": "$", "job.$": "$$.Execution.Name"},
                OutputPath="$.Payload",
                Next="AnyRobots",
            ),
            # AWS documents no map over nothing ("ItemReader (Map)").
            "AnyRobots": {
                "Type": "Choice",
                "Choices": [{"Variable": "$.robots", "NumericGreaterThan": 0, "Next": "Plans"}],
                "Default": "Nobody",
            },
            "Nobody": {"Type": "Pass", "Result": {"findings": []}, "End": True},
            "Plans": each(
                "Plans",
                robots,
                at_once.robots,
                ItemSelector=of_robot(_PLAN),
                ItemProcessor=workflow("Plan", "$", nothing, Plan=call("Plan", given(_PLAN), **nothing)),
                ResultPath=None,
                Next="Listed",
            ),
            "Listed": {
                "Type": "Task",
                "Resource": f"arn:{partition}:states:::aws-sdk:s3:listObjectsV2",
                "Parameters": {"Bucket": bucket, "Prefix.$": drives, "MaxKeys": 1},
                "Retry": [_FAILING],
                "ResultPath": "$.listed",
                "Next": "AnyDrives",
            },
            "AnyDrives": {
                "Type": "Choice",
                "Choices": [{"Variable": "$.listed.Contents[0]", "IsPresent": True, "Next": "Drives"}],
                "Default": "Findings",
            },
            "Drives": each(
                "Drives",
                {
                    "Resource": f"arn:{partition}:states:::s3:listObjectsV2",
                    "ReaderConfig": {"InputType": "JSON", "Transformation": "LOAD_AND_FLATTEN"},
                    "Parameters": {"Bucket": bucket, "Prefix.$": drives},
                },
                at_once.drives,
                ItemSelector={"planned.$": "$$.Map.Item.Value", "job.$": "$.job"},
                ItemProcessor=workflow(
                    "Analyse", "$.planned", nothing, Analyse=call("Analyse", given(_ANALYSE), **nothing)
                ),
                ResultPath=None,
                Next="Findings",
            ),
            "Findings": each(
                "Findings",
                robots,
                at_once.robots,
                ItemSelector=of_robot(_EVALUATE),
                ItemProcessor=workflow(
                    "Evaluate",
                    "$",
                    findings,
                    Evaluate=call("Evaluate", given(_EVALUATE), ResultPath=None, Next="Present"),
                    Present=call("Present", given(("job", "robot")), **findings),
                ),
                ResultSelector={"findings.$": "$"},
                End=True,
            ),
        },
    }
