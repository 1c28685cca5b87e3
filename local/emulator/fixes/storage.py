"""Fixes of the storage's ends: objects that expire, requests to DynamoDB, ministack's own addresses."""

from __future__ import annotations

import json
import time
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from datetime import datetime
from functools import wraps
from types import SimpleNamespace
from typing import Any

from ministack import app
from ministack.core import iam_actions
from ministack.core.responses import request_scope
from ministack.services import dynamodb, s3
from ministack.services.cloudformation import provisioners

from local.emulator.fixes import alarms

_PROPERTY = "LifecycleConfiguration"
_DAY_S, _EVERY_S = 86_400, 600.0
# The answers to completed uploads, which a client may ask for again.
_ANSWERS = 1_000
_due_s: list[float] = []


def close_object_expiry() -> None:
    """The end of objects by a bucket's lifecycle rules.

    AWS: deletes objects that are older than a rule says, and the parts of uploads that nobody completes
      (https://docs.aws.amazon.com/AmazonS3/latest/userguide/object-lifecycle-mgmt.html).
    ministack: ignores the rules of a template, and deletes nothing by the rules that it knows.
    Test: tests/local/emulator/test_object_fixes.py::test_objects_and_abandoned_uploads_end_by_the_rules
    Patch: none; ministack has no clock that could look for old objects
    """
    # `alarm_timer` looks every few minutes.
    provisioners._S3_BUCKET_CONFIGURATIONS = (
        *provisioners._S3_BUCKET_CONFIGURATIONS,
        (_PROPERTY, _rules, s3._bucket_lifecycle.__setitem__, s3._bucket_lifecycle.pop),
    )
    alarms.BEFORE_ALARMS.append(_look)


def expire(now_s: float) -> None:
    """Delete what the rules of all buckets call old."""
    for (account, bucket), rules in list(s3._bucket_lifecycle._data.items()):
        enabled = [rule for rule in rules if isinstance(rule, dict) and rule.get("Status") == "Enabled"]
        region = (s3._buckets._data.get((account, bucket)) or {}).get("region") or ""
        with request_scope(account, region):
            for key in list(_old_objects(bucket, enabled, now_s)):
                s3._delete_object(bucket, key)
            for upload in list(_old_uploads(bucket, enabled, now_s)):
                s3._multipart_uploads.pop(upload, None)
    answers = s3._completed_multipart_uploads._data
    for key in list(answers)[:-_ANSWERS]:
        answers.pop(key, None)


def _look() -> None:
    if not _due_s or time.time() >= _due_s[-1]:
        _due_s[:] = [time.time() + _EVERY_S]
        expire(time.time())


def _rules(configuration: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The rules of a template as those of the API."""
    return [_rule(found) for found in configuration.get("Rules", ())]


def _rule(found: Mapping[str, Any]) -> dict[str, Any]:
    rule: dict[str, Any] = {"Status": found["Status"], "Filter": {"Prefix": found.get("Prefix", "")}}
    if "Id" in found:
        rule["ID"] = found["Id"]
    if "ExpirationInDays" in found:
        rule["Expiration"] = {"Days": int(found["ExpirationInDays"])}
    if abort := found.get("AbortIncompleteMultipartUpload"):
        rule["AbortIncompleteMultipartUpload"] = {"DaysAfterInitiation": int(abort["DaysAfterInitiation"])}
    return rule


def _old_objects(bucket: str, rules: Sequence[Mapping[str, Any]], now_s: float) -> Iterator[str]:
    days = {_prefix(rule): rule["Expiration"].get("Days") for rule in rules if "Expiration" in rule}
    for key, found in list((s3._buckets.get(bucket) or {"objects": {}})["objects"].items()):
        age_s = now_s - _seconds(found["last_modified"])
        if any(most and key.startswith(prefix) and age_s > most * _DAY_S for prefix, most in days.items()):
            yield key


def _old_uploads(bucket: str, rules: Sequence[Mapping[str, Any]], now_s: float) -> Iterator[str]:
    name = "AbortIncompleteMultipartUpload"
    days = [rule[name]["DaysAfterInitiation"] for rule in rules if name in rule]
    for upload, found in list(s3._multipart_uploads.items()) if days else ():
        if found["bucket"] == bucket and now_s - _seconds(found["created"]) > min(days) * _DAY_S:
            yield upload


def _prefix(rule: Mapping[str, Any]) -> str:
    return str((rule.get("Filter") or {}).get("Prefix", ""))


def _seconds(text: str) -> float:
    return datetime.fromisoformat(text.replace("Z", "+00:00")).timestamp()


# The items that the running BatchWriteItem has found good, by their identity.
_GOOD: ContextVar[dict[int, Any] | None] = ContextVar("good", default=None)


class OneBody:
    """The body that was parsed last.

    The policy check reads its values; the service takes them away, since it stores items without a copy.
    """

    def __init__(self) -> None:
        self._body: bytes | None = None
        self._values: Any = None

    def read(self, text: str | bytes) -> Any:
        """The values of a body, which is parsed once."""
        if not isinstance(text, bytes):
            return json.loads(text)
        if text is not self._body:
            self._values, self._body = json.loads(text), text
        return self._values

    def take(self, text: str | bytes) -> Any:
        """The values of a body, for a caller that may change them."""
        if text is not self._body:
            return json.loads(text)
        values, self._values, self._body = self._values, None, None
        return values


def close_request_time() -> None:
    """The time of a request to DynamoDB.

    AWS: does not apply; what a request costs AWS does not show
      (https://docs.aws.amazon.com/amazondynamodb/latest/APIReference/API_BatchWriteItem.html).
    ministack: parses the body of every request four times for IAM and once more to serve it, and goes through
      each item of a BatchWriteItem six times. A body of 25 summaries has 100 KB. Here a body is parsed once,
      an item is checked once, and capacity is counted where it is asked for.
    Test: tests/local/emulator/test_time_fixes.py::test_a_batch_write_reads_its_items_once
    Patch: none; it is about speed only, so that upstream should measure it with its own load
    """
    body = OneBody()
    iam_actions.json = _reading(body.read)
    dynamodb.json = _reading(body.take)
    dynamodb._batch_write_item = _checking_once(dynamodb._batch_write_item)
    dynamodb._validate_item = _once(dynamodb._validate_item)
    dynamodb._accumulate_write_capacity = _unless_batch(dynamodb._accumulate_write_capacity)


def _reading(loads: Callable[..., Any]) -> SimpleNamespace:
    return SimpleNamespace(**{**vars(json), "loads": loads})


def _checking_once(batch_write: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(batch_write)
    def write(data: dict[str, Any]) -> Any:
        if data.get("ReturnConsumedCapacity", "NONE") != "NONE":
            return batch_write(data)
        token = _GOOD.set({})
        try:
            return batch_write(data)
        finally:
            _GOOD.reset(token)

    return write


def _once(validate: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(validate)
    def check(item: Any, *rest: Any, **options: Any) -> Any:
        good = _GOOD.get()
        if good is None:
            return validate(item, *rest, **options)
        error = None if id(item) in good else validate(item, *rest, **options)
        if not error:
            good[id(item)] = item
        return error

    return check


def _unless_batch(accumulate: Callable[..., None]) -> Callable[..., None]:
    @wraps(accumulate)
    def count(*arguments: Any) -> None:
        if _GOOD.get() is None:
            accumulate(*arguments)

    return count


_OWN = ("/_ministack/", "/_localstack/")
# Whether it runs, the broker's authority, and the answers to a deployment, which have an unknown name.
_OPEN = ("/_ministack/ready", "/_ministack/health", "/_ministack/iot/ca.pem")
_OPEN_BELOW = ("/_ministack/cfn-response/", "/_ministack/cfn-signal/")

Serve = Callable[..., Awaitable[None]]


def close_own_paths() -> None:
    """The addresses of ministack itself.

    AWS: does not apply; it has none, and every request is signed
      (https://docs.aws.amazon.com/IAM/latest/UserGuide/reference_sigv.html).
    ministack: answers unsigned requests below /_ministack/. One erases everything, others show the messages
      of queues and the code of functions, or change settings, whoever on this machine asks.
    Test: tests/local/emulator/test_object_fixes.py::test_nobody_erases_or_reads_a_cloud_without_a_signature
    Patch: none; ministack's own users want these addresses
    """
    app.app = _refusing(app.app)


def _refusing(serve: Serve) -> Serve:
    @wraps(serve)
    async def answer(scope: dict[str, Any], receive: Any, send: Any) -> None:
        path = scope.get("path", "")
        if scope["type"] != "http" or not path.startswith(_OWN) or _is_open(path):
            await serve(scope, receive, send)
        else:
            await send({"type": "http.response.start", "status": 403, "headers": []})
            await send({"type": "http.response.body", "body": b"this cloud has no such address\n"})

    return answer


def _is_open(path: str) -> bool:
    return path in _OPEN or path.startswith(_OPEN_BELOW)
