"""The end of objects by a bucket's lifecycle rules.

AWS: deletes objects that are older than a rule says, and the parts of uploads that nobody completes
  (https://docs.aws.amazon.com/AmazonS3/latest/userguide/object-lifecycle-mgmt.html).
ministack: ignores the rules of a template, and deletes nothing by the rules that it knows.
Test: tests/local/gaps/test_object_gap.py::test_objects_and_abandoned_uploads_end_by_the_rules
Patch: none; ministack has no clock that could look for old objects
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from typing import Any

from ministack.core.responses import request_scope
from ministack.services import s3
from ministack.services.cloudformation import provisioners

from local.gaps.metrics import alarm_timer

_PROPERTY = "LifecycleConfiguration"
_DAY_S, _EVERY_S = 86_400, 600.0
# The answers to completed uploads, which a client may ask for again.
_ANSWERS = 1_000
_due_s: list[float] = []


def install() -> None:
    """Close the gap in this process: `alarm_timer` looks every few minutes."""
    provisioners._S3_BUCKET_CONFIGURATIONS = (
        *provisioners._S3_BUCKET_CONFIGURATIONS,
        (_PROPERTY, _rules, s3._bucket_lifecycle.__setitem__, s3._bucket_lifecycle.pop),
    )
    alarm_timer.BEFORE_ALARMS.append(_look)


def is_open() -> bool:
    """Look at the properties of a bucket that a template may set."""
    return not any(one[0] == _PROPERTY for one in provisioners._S3_BUCKET_CONFIGURATIONS)


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
