"""Asynchronous invocations by a rule.

AWS: queues the event. A throttled event is tried again for up to six hours, a failed one as often as the
  function's settings say; then it goes to the destination for failures
  (https://docs.aws.amazon.com/lambda/latest/dg/invocation-async-error-handling.html).
ministack: invokes the function at once in a new thread, and a throttled or failed event is lost.
Test: tests/local/gaps/test_gaps.py::test_an_event_that_breaks_the_emulator_goes_to_its_destination
Patch: none; it needs a queue for each function, which is more than a small patch
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

from ministack.services import iot, lambda_svc

from iort_contract.tables import TOPIC
from local.gaps.parts.turns import Turns

_RETRIES, _MAX_AGE_S = 2, 21_600


def install() -> None:
    """Close the gap in this process."""
    iot._dispatch_rule_to_lambda = AsyncInvocations().dispatch


def is_open() -> bool:
    """Send one event to a function that is throttled, and count the attempts."""
    attempts = []

    def throttled(_record: Any, event: Any) -> dict[str, Any]:
        attempts.append(event)
        return {"error": True, "throttle": True}

    def thread(*, target: Any, args: Any, daemon: bool) -> SimpleNamespace:
        return SimpleNamespace(start=lambda: target(*args), daemon=daemon)

    function = {"config": {"FunctionName": "function"}}
    with (
        patch.object(iot, "threading", SimpleNamespace(Thread=thread)),
        patch.multiple(
            lambda_svc,
            _get_func_record_for_ref_in_scope=lambda *_, **__: (function, function["config"], "function"),
            _execution_record_for_config=lambda record, _config: record,
            _execute_function_with_config_scope=throttled,
        ),
    ):
        iot._dispatch_rule_to_lambda("000000000000", "eu-west-1", "arn:function", {})
    return len(attempts) == 1


class AsyncInvocations:
    """A queue of events for each function.

    Each function has as many threads as its reserved concurrency, but at most one per core. On AWS no robot
    waits for another. Here the robots take turns.
    """

    def __init__(self) -> None:
        self._pools: dict[str, Turns] = {}

    def dispatch(self, account: str, region: str, function_arn: str, event: Any) -> None:
        """Queue one event; raises `LookupError` for an unknown function."""
        self.queue(account, region, function_arn, event)

    def queue(
        self,
        account: str,
        region: str,
        function_arn: str,
        event: Any,
        *,
        done: Callable[[], object] = lambda: None,
    ) -> None:
        """As `dispatch`; ``done`` is called when the event needs no more attempt."""
        function, config, _ = lambda_svc._get_func_record_for_ref_in_scope(
            function_arn, account_id=account, region=region
        )
        if not function or not config:
            raise LookupError(f"function {function_arn} not found")
        record = lambda_svc._execution_record_for_config(function, config)
        pool = self._pools.get(function_arn)
        if pool is None:
            reserved = lambda_svc._reserved_concurrency(function, config)
            cores = os.cpu_count() or 1
            pool = Turns(cores if reserved is None else max(1, min(cores, reserved)))
            self._pools[function_arn] = pool
        queued_s = time.monotonic()

        def run() -> None:
            invoke(account, region, record, event, queued_s)
            done()

        pool.submit(_robot(event), run)


def _robot(event: Any) -> str:
    """The robot whose message the event is; "" if it has no topic."""
    topic = event.get(TOPIC) if isinstance(event, dict) else None
    levels = topic.split("/") if isinstance(topic, str) else []
    return levels[2] if len(levels) > 2 else ""


def invoke(account: str, region: str, record: dict[str, Any], event: Any, queued_s: float) -> None:
    """Try as often and as long as the function's settings say; then tell its destination."""
    # The CDK sets them for the version $LATEST, which is what a rule calls.
    settings: dict[str, Any] = {}
    for qualifier in ("$LATEST", None):
        settings = settings or lambda_svc._event_invoke_config(record, qualifier) or {}
    retries, age_s = settings.get("MaximumRetryAttempts"), settings.get("MaximumEventAgeInSeconds")
    result: dict[str, Any] = {"body": {"errorMessage": "the event was too old"}}
    for _ in range(1 + (_RETRIES if retries is None else int(retries))):
        if time.monotonic() - queued_s > (_MAX_AGE_S if age_s is None else int(age_s)):
            break
        try:
            result = lambda_svc._execute_function_with_config_scope(record, event)
        except Exception as error:  # noqa: BLE001 - any error counts as a failed attempt, so that no event is lost
            result = {"error": True, "body": {"errorMessage": f"{type(error).__name__}: {error}"}}
        if not result.get("error"):
            return
    destination = ((settings.get("DestinationConfig") or {}).get("OnFailure") or {}).get("Destination")
    if destination:
        name = record["config"]["FunctionName"]
        with iot.request_scope(account, region):
            lambda_svc._route_async_failure(destination, name, event, result)
