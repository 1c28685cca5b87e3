"""JSON and other content in the files' bucket, by key."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from botocore.exceptions import ClientError

from iort_contract.catalog.analysis import ANALYSIS_FAILED, DRIVES_WAIT, KINDS
from iort_contract.findings_table import FindingsTable
from iort_contract.messages.analysis import NO_RUN, DriveKey, Finding

if TYPE_CHECKING:
    from types_boto3_s3 import S3Client


class Kept:
    """Objects of the files' bucket."""

    def __init__(self, client: S3Client, bucket: str) -> None:
        self._client, self._bucket = client, bucket

    def put(self, key: str, content: bytes, content_type: str) -> None:
        """Write an object; an earlier one is replaced."""
        self._client.put_object(Bucket=self._bucket, Key=key, Body=content, ContentType=content_type)

    def put_json(self, key: str, content: Any) -> None:
        """Write an object of JSON."""
        text = json.dumps(content, separators=(",", ":"), allow_nan=False)
        self.put(key, text.encode(), "application/json")

    def remove(self, prefix: str) -> None:
        """Remove all objects whose keys begin so."""
        for page in self._client.get_paginator("list_objects_v2").paginate(
            Bucket=self._bucket, Prefix=prefix
        ):
            for found in page.get("Contents", ()):
                self._client.delete_object(Bucket=self._bucket, Key=found["Key"])

    def json(self, key: str) -> Any:
        """Read an object of JSON; None if there is none."""
        try:
            answer = self._client.get_object(Bucket=self._bucket, Key=key)
        except ClientError as error:
            if error.response["Error"]["Code"] in {"NoSuchKey", "404"}:
                return None
            raise
        return json.loads(answer["Body"].read())


# A night plans what failed in the nights before it, up to a week.
_PLANNED_AGAIN_US = 7 * 86_400 * 1_000_000
_MOST_REASON = 500
# The subject of a failed comparison, whose drives are analysed again; and the state that compares.
NOT_COMPARED, COMPARES = "not_compared", "Evaluate"


def failed_plans(
    table: FindingsTable, robot: str, start_us: int, end_us: int, *, again: bool
) -> list[Finding]:
    """The findings about a robot's failed plans which a run of a range makes good.

    A run that looks for new drives begins at the first of them. One that analyses drives ``again`` keeps to
    the range that was asked for.
    """
    from_us = start_us if again else max(0, start_us - _PLANNED_AGAIN_US)
    found = table.findings(robot, from_us, end_us)
    return [one for one in found if one.drive.run == NO_RUN and one.to_us <= end_us]


def failure(about: Mapping[str, Any], error: Mapping[str, str], state: str = "") -> Finding:
    """The finding about a drive that could not be analysed, or a robot whose drives could not be found or
    compared, by the ``state`` of the machine that failed."""
    what = "the drive could not be analysed" if "run" in about else "the drives could not be found"
    if state == COMPARES:
        what = "the drives could not be compared"
    return Finding(
        drive=DriveKey(about["robot"], about["start_us"], about.get("run", NO_RUN)),
        kind=ANALYSIS_FAILED,
        severity=KINDS[ANALYSIS_FAILED].severity,
        subject=NOT_COMPARED if state == COMPARES else ANALYSIS_FAILED,
        from_us=about["start_us"],
        to_us=about["end_us"],
        stream=about.get("motion", ""),
        fields=(),
        text=f"{what} in three attempts: {_reason(error)}",
    )


def waits(robot: str, waiting: Mapping[str, int]) -> Finding:
    """The finding about drives that a run has left to the next one, which begins at the first of them."""
    return Finding(
        drive=DriveKey(robot, waiting["start_us"], NO_RUN),
        kind=DRIVES_WAIT,
        severity=KINDS[DRIVES_WAIT].severity,
        subject=DRIVES_WAIT,
        from_us=waiting["start_us"],
        to_us=waiting["end_us"],
        stream="",
        fields=(),
        text=f"{waiting['drives']:,} drives from here on are more than a run takes, and wait for another",
    )


def _reason(error: Mapping[str, str]) -> str:
    """What a failed state says: the function's own error, if it had time for one."""
    cause = error.get("Cause", "")
    with suppress(ValueError, TypeError, KeyError):
        failed = json.loads(cause)
        cause = f"{failed['errorType']}: {failed['errorMessage']}"
    return f"{cause or error.get('Error', 'unknown')}"[:_MOST_REASON]
