"""Lambda: the runtime's versions, and the report of a failed asynchronous invocation."""

from __future__ import annotations

import concurrent.futures
import json
import time

from iort_contract.messages.envelope import rule_event
from iort_contract.tables import BY_FUNCTION, TOPIC
from iort_contract.topics import LAMBDA, PING
from testkit.waiting import until
from verify.lab import CannotAskError, Lab
from verify.question import Seen, question

_MEMORY_MB = 256
_WITHIN_S = 180.0
# The newer parameters that functions/ passes to boto3's clients.
_PARAMETERS = {
    "CompleteMultipartUpload": ["IfNoneMatch", "MpuObjectSize"],
    "PutObject": ["ChecksumSHA256", "IfNoneMatch"],
    "UploadPart": ["ChecksumSHA256"],
}
_ENVIRONMENT = ("AWS_LAMBDA_FUNCTION_MEMORY_SIZE", "AWS_LAMBDA_FUNCTION_NAME", "AWS_REGION")
_RUNTIME = f"""
import os, sys
import boto3

def handler(event, context):
    model = boto3.client("s3", region_name="eu-central-1").meta.service_model
    return {{
        "python": "%d.%d" % sys.version_info[:2],
        "boto3": boto3.__version__,
        "unknown": [
            f"{{operation}}.{{name}}"
            for operation, names in {_PARAMETERS!r}.items()
            for name in names
            if name not in model.operation_model(operation).input_shape.members
        ],
        "environment": [name for name in {_ENVIRONMENT!r} if os.environ.get(name)],
        "memory_mb": int(os.environ["AWS_LAMBDA_FUNCTION_MEMORY_SIZE"]),
        "remaining_ms": context.get_remaining_time_in_millis(),
        "arn": context.invoked_function_arn.split(":")[5],
        "cores": os.cpu_count(),
        "log_format": os.environ.get("AWS_LAMBDA_LOG_FORMAT"),
    }}
"""


@question(
    "functions.runtime",
    expected={
        "parameters_that_boto3_does_not_know": [],
        "environment": list(_ENVIRONMENT),
        "memory_mb": _MEMORY_MB,
        "time_is_limited": True,
        "arn_is_a_functions": True,
    },
)
def runtime(lab: Lab) -> Seen:
    """boto3 of Lambda's runtime knows every parameter that the functions use, and the environment and the
    context have memory, name and time left."""
    function = lab.function("runtime", _RUNTIME, memory_mb=_MEMORY_MB, timeout_s=30)
    answer = lab.invoke(function)
    return {
        "parameters_that_boto3_does_not_know": answer["unknown"],
        "environment": answer["environment"],
        "memory_mb": answer["memory_mb"],
        "time_is_limited": 0 < answer["remaining_ms"] <= 30_000,
        "arn_is_a_functions": answer["arn"] == "function",
        "note_runtime": lab.configuration(function)["Runtime"],
        **{f"note_{name}": answer[name] for name in ("python", "boto3", "cores", "log_format")},
    }


@question(
    "functions.python",
    aws="lambda:lambda-runtimes",
    expected={"runs_as_named": True},
    not_embedded="the embedded cloud runs the functions with its host's Python",
)
def python(lab: Lab) -> Seen:
    """The runtime python3.13 runs Python 3.13, for which the layer is built."""
    source = "import sys\n\ndef handler(event, context):\n    return 'python%d.%d' % sys.version_info[:2]\n"
    function = lab.function("python", source, memory_mb=_MEMORY_MB, timeout_s=30)
    runs = lab.invoke(function)
    return {"runs_as_named": runs == lab.configuration(function)["Runtime"], "note_python": runs}


# AWS keeps so many executions for functions that reserve none.
_LIMIT, _CALLS, _UNRESERVED = 10, 20, 100
_EVENT = "verify: an event ran"
_HOLDING = f"""
import time

def handler(event, context):
    if "event" in event:
        print("{_EVENT}", flush=True)
    began = time.time()
    time.sleep(1 if "event" in event else 4)
    return [began, time.time()]
"""


def _limit(lab: Lab, name: str) -> None:
    """Give a function ten executions; a new account has no more for all.

    Raises `CannotAskError` if the account has more than ten, and too few to reserve ten.
    """
    client = lab.client("lambda")
    account = client.get_account_settings()["AccountLimit"]
    if account["UnreservedConcurrentExecutions"] >= _UNRESERVED + _LIMIT:
        client.put_function_concurrency(FunctionName=name, ReservedConcurrentExecutions=_LIMIT)
    elif account["ConcurrentExecutions"] > _LIMIT:
        raise CannotAskError(f"no ten of the account's {account['ConcurrentExecutions']} can be reserved")


@question(
    "functions.ten_at_once",
    aws="lambda:lambda-concurrency lambda:invocation-async-error-handling",
    expected={"more_than_ten_at_once": False, "throttled": True, "events_run": _CALLS},
)
def ten_at_once(lab: Lab) -> Seen:
    """Of twenty calls at a limit of ten executions, which is a new account's, ten run at once, and the others
    are refused with 429 (TooManyRequestsException). Twenty events all run: Lambda tries them again."""
    client, echo = lab.client("lambda"), lab.cloud.output("processing", "EchoFunction")
    since_ms, name = int(time.time() * 1000), lab.function("ten", _HOLDING, memory_mb=128, timeout_s=30)
    _limit(lab, name)

    def call(_number: int) -> tuple[list[float], bool]:
        """When a call ran, and whether it was refused before, so that botocore tried again."""
        try:
            answer = client.invoke(FunctionName=name, Payload=b"{}")
        except client.exceptions.TooManyRequestsException:
            return [], True
        return json.loads(answer["Payload"].read()), answer["ResponseMetadata"]["RetryAttempts"] > 0

    def events() -> int:
        return sum(_EVENT in line for line in lab.lines(echo, since_ms))

    with concurrent.futures.ThreadPoolExecutor(_CALLS) as pool:
        calls = list(pool.map(call, range(_CALLS)))
    for _ in range(_CALLS):
        client.invoke(FunctionName=name, InvocationType="Event", Payload=b'{"event": true}')
    until(lambda: events() >= _CALLS, "twenty events at a limit of ten", within_s=_WITHIN_S)
    ran = [times for times, _ in calls if times]
    most = max(sum(begin <= at < end for begin, end in ran) for at, _ in ran)
    return {
        "more_than_ten_at_once": most > _LIMIT,
        "throttled": any(refused for _, refused in calls),
        "events_run": events(),
        "note_most_at_once": most,
        "note_answered": len(ran),
    }


_RAISING = "def handler(event, context):\n    raise ValueError('not JSON')\n"


@question(
    "functions.failed_invocation",
    aws="lambda:invocation-async-retain-records",
    expected={
        "source": True,
        "topic": True,
        "condition": "RetriesExhausted",
        "says_why": True,
        "message_as_sent": True,
    },
)
def failed_invocation(lab: Lab) -> Seen:
    """A failed asynchronous invocation without retries reaches the destination with its event, the
    function's ARN, the condition RetriesExhausted and the error's message."""
    # No function of ours fails by a message; this one has the destination of one that a rule calls.
    robot, client, message = lab.robot("verify-failure").robot, lab.client("lambda"), b"\xff no ping"
    event = rule_event(message, lab.topic(PING, robot, LAMBDA), int(time.time() * 1000))
    name = lab.function("raising", _RAISING, memory_mb=128)
    echo = lab.cloud.output("processing", "EchoFunction")
    ours = client.get_function_event_invoke_config(FunctionName=echo, Qualifier="$LATEST")
    same = {key: ours[key] for key in ("MaximumRetryAttempts", "DestinationConfig")}
    client.put_function_event_invoke_config(FunctionName=name, **same)
    client.invoke(FunctionName=name, InvocationType="Event", Payload=json.dumps(event))
    entry = lab.only_entry(robot, within_s=_WITHIN_S)
    return {
        "source": entry.source == f"{BY_FUNCTION} {name}",
        "topic": entry.topic == event[TOPIC],
        "condition": entry.reason.split(":")[0],
        "says_why": "not JSON" in entry.reason,
        "message_as_sent": entry.payload == message,
    }
