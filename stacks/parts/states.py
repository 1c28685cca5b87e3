"""The states of the machine `analysis`, in the Amazon States Language with JSONPath.

The CDK's constructs have no reader that flattens many files into one map (LOAD_AND_FLATTEN), and the embedded
cloud evaluates no JSONata in a map's ItemSelector: decision 59.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from iort_contract.cloud import DRIVES, PLANS_PREFIX
from stacks.settings import AtOnce

# The service's own errors, which pass; a new account's functions are throttled for as long as others run.
_PASSING = {
    "ErrorEquals": [
        "Lambda.ServiceException",
        "Lambda.AWSLambdaException",
        "Lambda.SdkClientException",
        "Lambda.TooManyRequestsException",
    ],
    "IntervalSeconds": 2,
    "BackoffRate": 2,
    "MaxAttempts": 5,
    "JitterStrategy": "FULL",
}
# Three attempts of a function that fails, is killed or runs out of time or memory.
_FAILING = {"ErrorEquals": ["States.ALL"], "IntervalSeconds": 1, "BackoffRate": 3, "MaxAttempts": 2}

# What the functions get of one item.
_PLAN = {f"{name}.$": f"$.{name}" for name in ("robot", "start_us", "end_us", "again", "job")}
_ANALYSE = {f"{name}.$": f"$.{name}" for name in ("planned", "job")}


def states(partition: str, functions: Mapping[str, str], *, bucket: str, at_once: AtOnce) -> dict[str, Any]:
    """The machine's definition, by the functions' ARNs. ``at_once`` limits robots and drives."""

    def call(function: str, payload: Mapping[str, Any], **more: Any) -> dict[str, Any]:
        return {
            "Type": "Task",
            "Resource": f"arn:{partition}:states:::lambda:invoke",
            "Parameters": {"FunctionName": functions[function], "Payload": payload},
            "Retry": [_PASSING, _FAILING],
            **more,
        }

    def or_failed(name: str, task: Mapping[str, Any], what: str) -> dict[str, Any]:
        """The states of one item, whose failure becomes a finding, so that the others go on."""
        # The results of thousands of items would not fit in a state.
        end = {"ResultPath": None, "OutputPath": None, "End": True}
        caught = {"ErrorEquals": ["States.ALL"], "ResultPath": "$.error", "Next": "Failed"}
        return {
            "StartAt": name,
            "States": {
                name: {**task, "Catch": [caught], **end},
                "Failed": call("Present", {"failed.$": what, "error.$": "$.error"}, **end),
            },
        }

    payload = {"OutputPath": "$.Payload"}
    drives = f"States.Format('{PLANS_PREFIX}{{}}/{DRIVES}/', $.job)"
    return {
        "StartAt": "Robots",
        "States": {
            "Robots": call("Plan", {"input.$": "$", "job.$": "$$.Execution.Name"}, **payload, Next="Plans"),
            "Plans": {
                "Type": "Map",
                "ItemsPath": "$.robots",
                "ItemSelector": {**_PLAN, "robot.$": "$$.Map.Item.Value"},
                "MaxConcurrency": at_once.robots,
                "ItemProcessor": {
                    "ProcessorConfig": {"Mode": "INLINE"},
                    **or_failed("Plan", call("Plan", _PLAN), "$"),
                },
                "ResultPath": None,
                "Next": "Listed",
            },
            # AWS documents no map over a prefix without objects ("ItemReader (Map)").
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
                "Default": "Evaluate",
            },
            "Drives": {
                "Type": "Map",
                "Label": "Drives",
                "ItemReader": {
                    "Resource": f"arn:{partition}:states:::s3:listObjectsV2",
                    "ReaderConfig": {"InputType": "JSON", "Transformation": "LOAD_AND_FLATTEN"},
                    "Parameters": {
                        "Bucket": bucket,
                        "Prefix.$": drives,
                    },
                },
                "ItemSelector": {"planned.$": "$$.Map.Item.Value", "job.$": "$.job"},
                "MaxConcurrency": at_once.drives,
                # A drive that fails is a finding; where even that fails, the night goes on.
                "ToleratedFailurePercentage": 100,
                "ItemProcessor": {
                    "ProcessorConfig": {"Mode": "DISTRIBUTED", "ExecutionType": "EXPRESS"},
                    **or_failed("Analyse", call("Analyse", _ANALYSE), "$.planned"),
                },
                "ResultPath": None,
                "Next": "Evaluate",
            },
            "Evaluate": call(
                "Evaluate",
                {
                    f"{name}.$": f"$.{name}"
                    for name in ("job", "began_us", "robots", "start_us", "end_us", "again")
                },
                ResultPath=None,
                Next="Present",
            ),
            "Present": call("Present", {"job.$": "$.job"}, **payload, End=True),
        },
    }
