"""Fixes of Lambda's invocations: asynchronous events in turn, the end of a log, and how many are kept."""

from __future__ import annotations

import logging
import os
import queue
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Mapping
from functools import wraps
from typing import Any

from ministack.core import lambda_runtime
from ministack.services import cloudwatch_logs, iot, lambda_svc

from iort_contract.tables import TOPIC

_log = logging.getLogger(__name__)
_Call = tuple[Callable[..., object], tuple[Any, ...]]


class Turns:
    """Runs submitted calls in a fixed number of daemon threads.

    The calls of one owner start in their order. Owners take turns: each gets one call before any gets two.
    """

    def __init__(self, threads: int) -> None:
        self._waiting: OrderedDict[str, deque[_Call]] = OrderedDict()
        self._changed = threading.Condition()
        for _ in range(threads):
            threading.Thread(target=self._run, daemon=True).start()

    def submit(self, whose: str, function: Callable[..., object], *arguments: Any) -> None:
        """Call the function when it is the turn of the owner ``whose``."""
        with self._changed:
            self._waiting.setdefault(whose, deque()).append((function, arguments))
            self._changed.notify()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting)
                whose, calls = self._waiting.popitem(last=False)
                function, arguments = calls.popleft()
                if calls:
                    self._waiting[whose] = calls
            try:
                function(*arguments)
            except Exception:  # noqa: BLE001 - the thread has to serve the other calls
                _log.exception("a call of %r failed", whose)


_RETRIES, _MAX_AGE_S = 2, 21_600


def close_async_invocations() -> None:
    """Asynchronous invocations by a rule.

    AWS: queues the event. A throttled event is tried again for up to six hours, a failed one as often as the
      function's settings say; then it goes to the destination for failures
      (https://docs.aws.amazon.com/lambda/latest/dg/invocation-async-error-handling.html).
    ministack: invokes the function at once in a new thread, and a throttled or failed event is lost.
    Test: tests/local/emulator/test_fixes.py::test_an_event_that_breaks_the_emulator_goes_to_its_destination
    Patch: none; it needs a queue for each function, which is more than a small patch
    """
    iot._dispatch_rule_to_lambda = AsyncInvocations().queue


class AsyncInvocations:
    """A queue of events for each function.

    Each function has as many threads as its reserved concurrency, but at most one per core. On AWS no robot
    waits for another. Here the robots take turns.
    """

    def __init__(self) -> None:
        self._pools: dict[str, Turns] = {}

    def queue(
        self,
        account: str,
        region: str,
        function_arn: str,
        event: Any,
        *,
        done: Callable[[], object] = lambda: None,
    ) -> None:
        """Queue one event; ``done`` is called when it needs no more attempt. Raises `LookupError` for an
        unknown function."""
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


END = "=== end of the log, local/emulator/fixes/invocations.py ==="
# The end of the worker's loop, with the patch log_levels: it sends the answer, and the log is complete.
_ANSWERED = "        _real_stdout.flush()\n\n# Lambda's own set-up of logging"
# For a worker that dies before it prints the end.
_MAX_WAIT_S = 1.0


def close_log_end() -> None:
    """The end of an invocation's log.

    AWS: does not apply; an invocation's time does not depend on its log.
    ministack: reads the log from the worker's standard error and does not know where it ends. It waits 50 ms
      for a first line, ten times as long as a function runs that logs nothing. Here the worker prints a line
      at the end.
    Test: tests/local/emulator/test_log_fixes.py::test_the_worker_marks_the_end_of_each_invocations_log
    Patch: none; the end has to be agreed for the workers of every runtime, not Python's alone
    """
    worker = lambda_runtime._PYTHON_WORKER_SCRIPT
    if worker.count(_ANSWERED) != 1:
        raise RuntimeError("the end of ministack's Python worker must occur once")
    printed = f"        print({END!r}, file=sys.stderr, flush=True)\n"
    lambda_runtime._PYTHON_WORKER_SCRIPT = worker.replace(_ANSWERED, printed + _ANSWERED)
    drain = lambda_runtime.Worker._drain_stderr_bounded
    lambda_runtime.Worker._drain_stderr_bounded = _to_the_end(drain)


def _to_the_end(drain: Callable[..., str]) -> Callable[[Any], str]:
    def log(worker: Any) -> str:
        if not str(worker.config.get("Runtime", "")).startswith("python"):
            return drain(worker)
        lines: list[str] = []
        deadline = time.monotonic() + _MAX_WAIT_S
        while (left_s := deadline - time.monotonic()) > 0:
            try:
                line = worker._stderr_queue.get(timeout=left_s)
            except queue.Empty:
                break
            if line == END:
                break
            lines.append(line)
        return "\n".join(lines)

    return log


KEPT = 500
# So many streams more are there before some are deleted: all have to be looked at.
_SLACK = 100
_EVENTFUL = ("[WARNING]", "[ERROR]", "[CRITICAL]", "Traceback ", "Task timed out")


def close_log_retention() -> None:
    """The number of logs that are kept.

    AWS: does not apply; it keeps a log group's events on disks
      (https://docs.aws.amazon.com/AmazonCloudWatch/latest/logs/Working-with-log-groups-and-streams.html).
    ministack: keeps a log stream for each invocation in memory, for ever. Here a group keeps its newest ones,
      and as many of those that have a warning or an error.
    Test: tests/local/emulator/test_log_fixes.py::test_a_group_keeps_its_newest_logs_and_its_errors
    Patch: none; which logs are worth their memory is not for ministack to say
    """
    lambda_svc._emit_lambda_logs = _forgetting(lambda_svc._emit_lambda_logs)


def _forgetting(emit: Callable[..., None]) -> Callable[..., None]:
    @wraps(emit)
    def emit_logs(function: dict[str, Any], *arguments: Any, **options: Any) -> None:
        emit(function, *arguments, **options)
        config = function.get("config") or function
        name = (config.get("LoggingConfig") or {}).get(
            "LogGroup"
        ) or f"/aws/lambda/{config.get('FunctionName', 'unknown')}"
        if group := cloudwatch_logs._log_groups.get(name):
            forget(group["streams"])

    return emit_logs


def forget(streams: dict[str, dict[str, Any]], kept: int = KEPT) -> None:
    """Delete the oldest streams; they are in the order of their beginnings."""
    if len(streams) <= 2 * kept + _SLACK:
        return
    names = list(streams)
    old = names[:-kept]
    eventful = [name for name in old if _is_eventful(streams[name])]
    for name in set(old).difference(eventful[-kept:]):
        streams.pop(name, None)


def _is_eventful(stream: Mapping[str, Any]) -> bool:
    return any(str(event["message"]).startswith(_EVENTFUL) for event in stream["events"])
