"""What the embedded cloud lacks of AWS and this project relies on.

ministack is pinned, and each gap is one wrapper around one of its functions; tests/local/test_gaps.py
fails when a release changes what is wrapped or closes the gap itself. Sessions that AWS would end are in
local/cut_sessions.py, where it listens and how long it waits for a CONNECT in local/listener_gap.py; here, in
order:

- a republish action's topic is not expanded: ``${topic(3)}`` stays literal;
- the SQL function floor() gives nothing;
- a payload nested deeper than Python reads, or with an integer of more digits, ends the session, whose
  messages are never acknowledged again;
- a message above 128 KB is taken from an MQTT 3.1.1 client or by HTTP (AWS refuses it);
- on Python 3.10 the MQTT listener pauses reading too early, loses the ClientHello and never answers
  (local/listener_gap.py);
- a rule's SQS action counts as plain HTTP, which the queues' policies refuse (AWS calls itself by TLS);
- SendMessageBatch asks for a permission of its own (AWS asks for sqs:SendMessage);
- fleet provisioning has no CreateCertificateFromCsr over MQTT, only keys made in the cloud;
- a rule invokes Lambda at once, in a thread a message, and a throttled message is lost (AWS queues
  asynchronous events, a burst waits for free concurrency, and what fails goes to a destination);
- a stream's mapping tries a failed batch again until it succeeds, and a role's grant on a stream's ARN is
  not seen (local/stream_gap.py);
- a Query takes time with every item of its partition (local/table_gap.py);
- a message that is sent to a queue while another thread takes some out of it is lost
  (local/queue_gap.py);
- an invocation that logs nothing takes 50 ms more, and what is logged has no level (local/log_gap.py).
"""

from __future__ import annotations

import contextvars
import json
import math
import os
import re
import secrets
import time
from collections.abc import Callable
from functools import wraps
from typing import Any

from ministack.core import iam_actions, iam_evaluator
from ministack.services import iot, lambda_svc

from iort_contract import TOPIC
from local import cut_sessions, listener_gap, log_gap, queue_gap, stream_gap, table_gap
from local.turns import Turns

# "Message size" in AWS IoT Core's service quotas.
AWS_MESSAGE_BYTES = 128 * 1024
_CSR = "create-from-csr"
_TEMPLATE = re.compile(r"\$\{\s*(topic\(\s*\d*\s*\))\s*\}")


class MessageTooLargeError(ConnectionError):
    """A publish above AWS IoT Core's message size; as a connection error it ends the session."""


def install() -> None:
    """Close the gaps in this process, before the emulator starts."""
    cut_sessions.install()
    listener_gap.install()
    iot._run_rule_actions = _expanding_republish(iot._run_rule_actions)
    iot._eval_select_function = _with_floor(iot._eval_select_function)
    iot._rule_message = as_text_if_unreadable(iot._rule_message)
    iot._IMPLEMENTED_SQL_FUNCS |= {"floor"}
    iot.broker_publish = _refusing_large(iot.broker_publish)
    iot._dispatch_rule_sqs = _over_tls(iot._dispatch_rule_sqs)
    iam_actions.extract_iam_action = _as_one_message(iam_actions.extract_iam_action)
    iot._parse_fleet_provisioning_topic = _with_csr(iot._parse_fleet_provisioning_topic)
    iot._fleet_provisioning_reply = _certifying(iot._fleet_provisioning_reply)
    iot._dispatch_rule_to_lambda = AsyncInvocations().dispatch
    stream_gap.install()
    table_gap.install()
    queue_gap.install()
    log_gap.install()


def expand_topic(template: str, topic: str) -> str:
    """The republish topic for a message on ``topic``; a level it does not have leaves nothing."""
    levels = topic.split("/")

    def level(match: re.Match[str]) -> str:
        index = match[1][len("topic(") : -1].strip()
        if not index:
            return topic
        return levels[int(index) - 1] if 1 <= int(index) <= len(levels) else ""

    return _TEMPLATE.sub(level, template)


def _expanding_republish(run_rule_actions: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(run_rule_actions)
    async def run(account: str, region: str, rule: dict[str, Any], payload: bytes, *rest: Any) -> None:
        topic = rest[0] if rest else ""
        if rule and any("republish" in action for action in rule.get("actions") or []):
            rule = {**rule, "actions": [_expanded(action, topic) for action in rule["actions"]]}
        await run_rule_actions(account, region, rule, payload, *rest)

    return run


def _expanded(action: dict[str, Any], topic: str) -> dict[str, Any]:
    republish = action.get("republish")
    if republish is None:
        return action
    return {"republish": {**republish, "topic": expand_topic(republish["topic"], topic)}}


def _with_floor(evaluate: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(evaluate)
    def evaluate_function(name: str, args: list[str], *context: Any) -> Any:
        if name != "floor" or len(args) != 1:
            return evaluate(name, args, *context)
        value = iot._sql_as_number(iot._eval_select_expr(args[0], *context))
        return iot._MISSING if value is None else math.floor(value)

    return evaluate_function


def as_text_if_unreadable(read: Callable[[bytes], Any]) -> Callable[[bytes], Any]:
    """A payload as rules see it; one that Python does not read as any other that is no JSON."""

    @wraps(read)
    def message(payload: bytes) -> Any:
        try:
            return read(payload)
        # Python's limits: levels of nesting, and digits of an integer (sys.set_int_max_str_digits).
        except (RecursionError, ValueError):
            return payload.decode()

    return message


def _refusing_large(publish: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(publish)
    async def broker_publish(account: str, region: str, topic: str, payload: bytes, **rest: Any) -> None:
        if len(payload) > AWS_MESSAGE_BYTES:
            raise MessageTooLargeError(f"{len(payload)} bytes on {topic}")
        await publish(account, region, topic, payload, **rest)

    return broker_publish


def _over_tls(dispatch: Callable[..., None]) -> Callable[..., None]:
    @wraps(dispatch)
    def dispatch_rule_sqs(*arguments: Any) -> None:
        context = contextvars.copy_context()
        context.run(iam_evaluator.pin_request_origin, "127.0.0.1", True)
        context.run(dispatch, *arguments)

    return dispatch_rule_sqs


def _as_one_message(iam_action: Callable[..., str | None]) -> Callable[..., str | None]:
    @wraps(iam_action)
    def extract(*request: Any) -> str | None:
        action = iam_action(*request)
        return "sqs:SendMessage" if action == "sqs:SendMessageBatch" else action

    return extract


def _with_csr(parse: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(parse)
    def parse_topic(topic: str) -> tuple[str, str | None] | None:
        return (_CSR, None) if topic == "$aws/certificates/create-from-csr/json" else parse(topic)

    return parse_topic


def _certifying(reply: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(reply)
    async def answer(account: str, region: str, operation: str, *rest: Any) -> Any:
        if operation != _CSR:
            return await reply(account, region, operation, *rest)
        request = _json_object(rest[1]).get("certificateSigningRequest")
        try:
            pem = iot.sign_certificate_request(*iot._ensure_ca(), request or "")
        except ValueError:
            return iot._fleet_rejected("InvalidCsr", "CSR violates constraints")
        number, token = iot.get_certificate_id(pem), secrets.token_urlsafe(48)
        with iot.request_scope(account, region):
            record = iot._certificate_record(number, pem, "PENDING_ACTIVATION")
            iot._certificates[number] = record
            expires = time.time() + iot._OWNERSHIP_TOKEN_SECONDS
            iot._ownership_tokens[token] = {"certificateId": number, "expiration": expires}
        return "accepted", {
            "certificateId": number,
            "certificatePem": pem,
            "certificateOwnershipToken": token,
        }

    return answer


def _json_object(payload: bytes) -> dict[str, Any]:
    try:
        value = json.loads(payload)
    except (RecursionError, ValueError):
        value = None
    return value if isinstance(value, dict) else {}


class AsyncInvocations:
    """A queue of asynchronous events for each function, served by as many threads as the function
    may run at once: its reserved concurrency, and no more than this machine has cores.

    AWS has an environment for each of many events, and no robot waits for another. Here the robots take
    turns."""

    def __init__(self) -> None:
        self._pools: dict[str, Turns] = {}

    def dispatch(self, account: str, region: str, function_arn: str, event: Any) -> None:
        """Queue one event; raises `LookupError` for a function that is not there."""
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
        pool.submit(_robot(event), _invoke, account, region, record, event, time.monotonic())


def _robot(event: Any) -> str:
    """Whose message an event is of, by its topic; "" where it has none."""
    topic = event.get(TOPIC) if isinstance(event, dict) else None
    levels = topic.split("/") if isinstance(topic, str) else []
    return levels[2] if len(levels) > 2 else ""


def _invoke(account: str, region: str, record: dict[str, Any], event: Any, queued_s: float) -> None:
    """Try as often, and for as long, as the function's settings say; then tell its destination."""
    # The CDK gives them to the version $LATEST, which is what a rule calls.
    settings: dict[str, Any] = {}
    for qualifier in ("$LATEST", None):
        settings = settings or lambda_svc._event_invoke_config(record, qualifier) or {}
    retries, age_s = settings.get("MaximumRetryAttempts"), settings.get("MaximumEventAgeInSeconds")
    result: dict[str, Any] = {"body": {"errorMessage": "the event was too old"}}
    for _ in range(1 + (2 if retries is None else int(retries))):
        if time.monotonic() - queued_s > (21_600 if age_s is None else int(age_s)):
            break
        try:
            result = lambda_svc._execute_function_with_config_scope(record, event)
        except Exception as error:  # noqa: BLE001 - whatever it is, the event is not lost with the thread
            result = {"error": True, "body": {"errorMessage": f"{type(error).__name__}: {error}"}}
        if not result.get("error"):
            return
    destination = ((settings.get("DestinationConfig") or {}).get("OnFailure") or {}).get("Destination")
    if destination:
        name = record["config"]["FunctionName"]
        with iot.request_scope(account, region):
            lambda_svc._route_async_failure(destination, name, event, result)
