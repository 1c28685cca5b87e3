"""Puts off the expiry of items that are not archived: nothing expires before it is in the archive."""

from __future__ import annotations

from contextlib import suppress

from functions.shared.archive.archive import Archive
from functions.shared.metrics import emit
from iort_contract.archive import SAFE_UNTIL_S, Pending, parse_hour
from iort_contract.dynamodb import starting_between, whole
from iort_contract.tables import BATCH, EXPIRES_S, PUT_OFF_TO_S, TOPIC

_DAY_S = 86_400
PUT_OFF_S = 30 * _DAY_S


def margin_s(retention_s: int) -> int:
    """An hour that is not archived this long before its items expire has their expiry put off."""
    return min(retention_s // 10, 7 * _DAY_S)


def put_off(archive: Archive, pending: Pending, now_ms: int) -> int:
    """Put off the expiry of an hour's items that expire soon; returns their number."""
    hour, now_s = parse_hour(pending.period), now_ms // 1000
    margin = margin_s(archive.given.retention_s)
    safe_s, count = now_s + PUT_OFF_S, 0
    keys = starting_between(hour.start_us, hour.end_us - 1)
    for page in archive.telemetry.pages(pending.topic, keys, attributes=(TOPIC, BATCH, EXPIRES_S)):
        for item in page.items:
            expires_s = whole(item, EXPIRES_S)
            if expires_s is None:
                continue
            if expires_s > now_s + margin:
                safe_s = min(safe_s, expires_s)
                continue
            # One that has gone meanwhile must not come back as a row of an expiry alone.
            with suppress(archive.client.exceptions.ConditionalCheckFailedException):
                archive.client.update_item(
                    TableName=archive.telemetry.name,
                    Key={name: item[name] for name in (TOPIC, BATCH)},
                    UpdateExpression="SET #expires = :expires, #put_off = :expires",
                    ConditionExpression="#expires = :before",
                    ExpressionAttributeNames={"#expires": EXPIRES_S, "#put_off": PUT_OFF_TO_S},
                    ExpressionAttributeValues={
                        ":expires": {"N": str(now_s + PUT_OFF_S)},
                        ":before": item[EXPIRES_S],
                    },
                )
                count += 1
    archive.marks.keep(pending, **{SAFE_UNTIL_S: safe_s})
    emit("archive", ExpiriesPutOff=count)
    return count
