"""Alert: mails a car's fault or low battery, one rule each, to the subscribers.

A rule fires on every matching message; the mail is sent once per car and cause, and repeated if the cause
lasts for `QUIET_S`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, timezone
from functools import cache
from typing import TYPE_CHECKING, Any, TypeGuard

from functions.shared import clients
from functions.shared.clients import variables
from functions.shared.metrics import emit
from iort_contract.catalog.environments import AlertEnvironment
from iort_contract.catalog.vesc import FAULT_FIELD, FAULTS, VOLTAGE_FIELD
from iort_contract.tables import ALERT_FAULT, ALERT_LOW_VOLTAGE, RECEIVED_MS, ROBOT, TOPIC
from iort_contract.topics import parse_topic

if TYPE_CHECKING:
    from types_boto3_dynamodb import DynamoDBClient

QUIET_S = 900

Notify = Callable[[str, str], None]


@dataclass(frozen=True)
class Cause:
    """The reason for a mail: ``key`` separates a car's causes, ``text`` is for the reader."""

    key: str
    text: str


def causes(event: Mapping[str, Any], low_voltage_v: float) -> list[Cause]:
    """The alarming values of a message that a rule selected; values that are not numbers are ignored."""
    found = []
    code, volts = event.get(FAULT_FIELD), event.get(VOLTAGE_FIELD)
    if _is_number(code) and code > 0:
        # All unknown codes are one cause: a car with invented codes may neither send a mail for each nor fill
        # its row of the registry.
        meaning = FAULTS[int(code)] if code in FAULTS else None
        key = f"{ALERT_FAULT}{'unknown' if meaning is None else int(code)}"
        found.append(Cause(key, f"fault {code:g}, {meaning or 'a code that the contract does not know'}"))
    if _is_number(volts) and 0 < volts < low_voltage_v:
        found.append(Cause(ALERT_LOW_VOLTAGE, f"battery at {volts:.1f} V, below {low_voltage_v:g} V"))
    return found


class Notices:
    """The last mail of each car and cause, in the car's row of the registry; a cache in this environment
    saves requests."""

    def __init__(self, client: DynamoDBClient, table: str) -> None:
        self._client, self._table = client, table
        self._until_s: dict[tuple[str, str], float] = {}

    def take(self, robot: str, key: str, now_s: int) -> bool:
        """Whether to send a mail now; one caller per `QUIET_S` gets True. Always False for a removed robot,
        which has no row and must not get one again."""
        if now_s < self._until_s.get((robot, key), 0):
            return False
        values = {":now": {"N": str(now_s)}, ":then": {"N": str(now_s - QUIET_S)}}
        due = "attribute_not_exists(#key) OR #key <= :then"
        try:
            self._update(robot, key, "SET #key = :now", due, ExpressionAttributeValues=values)
        except self._client.exceptions.ConditionalCheckFailedException:
            # Another environment sent it, at an unknown time within the quiet period; another look costs a
            # request.
            self._until_s[robot, key] = now_s + QUIET_S / 10
            return False
        self._until_s[robot, key] = now_s + QUIET_S
        return True

    def give_back(self, robot: str, key: str) -> None:
        """Sending failed: the next caller tries again."""
        self._until_s.pop((robot, key), None)
        with suppress(self._client.exceptions.ConditionalCheckFailedException):
            self._update(robot, key, "REMOVE #key", "attribute_exists(#key)")

    def _update(self, robot: str, key: str, expression: str, condition: str, **values: Any) -> None:
        self._client.update_item(
            TableName=self._table,
            Key={ROBOT: {"S": robot}},
            UpdateExpression=expression,
            ConditionExpression=f"attribute_exists(#robot) AND ({condition})",
            ExpressionAttributeNames={"#key": key, "#robot": ROBOT},
            **values,
        )


def process(
    event: Mapping[str, Any], low_voltage_v: float, notices: Notices, notify: Notify, now_s: int
) -> None:
    """Notify for each cause that is due. If ``notify`` raises, the notice is given back and the error raised.

    Raises `iort_contract.ContractError` for a topic outside the contract.
    """
    topic = parse_topic(event[TOPIC])
    when = datetime.fromtimestamp(int(event[RECEIVED_MS]) / 1000, timezone.utc)
    for cause in causes(event, low_voltage_v):
        if not notices.take(topic.robot, cause.key, now_s):
            emit("alert", AlertsHeld=1)
            continue
        text = (
            f"{topic.robot}: {cause.text}\n\n"
            f"when     {when:%Y-%m-%d %H:%M:%S} UTC\n"
            f"stream   {topic}\n\n"
            f"The next mail about this comes in {QUIET_S // 60} minutes if it lasts.\n"
            f"What happened: iort query {topic.robot} {topic.name}\n"
        )
        try:
            notify(f"{topic.namespace}: {topic.robot}, {cause.text}", text)
        except Exception:
            notices.give_back(topic.robot, cause.key)
            raise
        emit("alert", AlertsSent=1)


def _is_number(value: object) -> TypeGuard[int | float]:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


@cache
def _notices() -> Notices:
    return Notices(clients.dynamodb(), variables(AlertEnvironment).robots_table)


def _notify(subject: str, text: str) -> None:
    clients.send(variables(AlertEnvironment).alarm_topic, subject, text)


def handler(event: dict[str, Any], _context: object) -> None:
    """Entry point of the Lambda action of the rules fault and battery."""
    low_voltage_v = variables(AlertEnvironment).low_voltage_v
    process(event, low_voltage_v, _notices(), _notify, int(time.time()))
