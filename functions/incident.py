"""Incident: tells of an incident of the event recorder, by mail and by the signed webhook.

`summarize` calls it, without waiting, for each new sample of the stream `incidents`:

    sample --> told before? --> mail (opened, lost, over budget) --> webhook (every state) --> noted as told
                                    |                                  |  three tries
                                    +------------ failed --------------+--> Lambda tries the event twice more
                                                                            --> quarantine

What was told is noted in the robot's row, so that a repeated sample tells nobody twice.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime, timezone
from functools import cache
from typing import TYPE_CHECKING, Any, Protocol

from functions.shared import clients
from functions.shared.clients import variables
from functions.shared.metrics import emit
from functions.shared.queues import quarantined
from functions.shared.quotas import HOUR, Quota
from functions.shared.webhooks import StoredWebhook, WebhookError
from iort_contract.catalog.environments import IncidentEnvironment
from iort_contract.catalog.streams import INCIDENT_STREAM
from iort_contract.checks import whole_number
from iort_contract.limits import ContractError
from iort_contract.messages.recorder import KEPT, LOST, NOTIFIED, OVER_BUDGET, Incident, incident
from iort_contract.tables import (
    INCIDENT,
    INCIDENT_HOUR,
    INCIDENT_MAILS,
    INCIDENTS_TOLD,
    ROBOT,
    T_US,
    TOPIC,
)
from iort_contract.topics import Topic, parse_topic
from iort_contract.webhook import TEST

if TYPE_CHECKING:
    from types_boto3_dynamodb import DynamoDBClient

# A robot's mails of an hour; a mistake in a trigger must not bury what others say.
MAILS_AN_HOUR = 20
# What is mailed about an incident: that it opened, and that its data will not come.
MAILED = {KEPT: "kept", NOTIFIED: "seen", OVER_BUDGET: "over the budget of its trigger", LOST: "lost"}
# How many notes of what was told a robot's row keeps; each write of the row costs by its size.
NOTES = 48
_LATEST_US = 2**53

Notify = Callable[[str, str], None]


class Sender(Protocol):
    """The webhook, if there is one."""

    def stored(self) -> bool:
        """Whether there is one."""

    def deliver(self, body: bytes, delivery: str, tries: int = ...) -> int:
        """Send; return the receiver's status, or raise `WebhookError`."""


@dataclass(frozen=True)
class News:
    """A sample of the stream `incidents`."""

    topic: Topic
    t_us: int
    incident: Incident

    @property
    def delivery(self) -> str:
        """The same whenever the incident has this state again."""
        return f"{self.topic.robot}-{self.incident.id}-{self.incident.state}"

    @property
    def body(self) -> bytes:
        """The webhook's message. It has the file's key and no address, since whoever has an address may read
        the file."""
        about = {"namespace": self.topic.namespace, "robot": self.topic.robot, "t_us": self.t_us}
        return json.dumps({**about, **self.incident.sample()}, separators=(",", ":")).encode()


def news(event: Mapping[str, Any]) -> News:
    """Decode an event; raises `ContractError`."""
    topic = parse_topic(event.get(TOPIC, ""))
    sample = event.get(INCIDENT)
    if topic.name != INCIDENT_STREAM or not isinstance(sample, Mapping):
        raise ContractError("the event is no sample of the stream incidents")
    t_us = event.get(T_US)
    whole_number("t", t_us, 0, _LATEST_US)
    return News(topic, int(t_us or 0), incident(sample))


class Told:
    """What was told of a robot's newest incidents, in its row of the registry."""

    def __init__(self, client: DynamoDBClient, table: str) -> None:
        self._client, self._table = client, table

    def notes(self, robot: str) -> set[str] | None:
        """The notes of the robot; None if it is not registered, or was removed."""
        answer = self._client.get_item(
            TableName=self._table,
            Key={ROBOT: {"S": robot}},
            ProjectionExpression="#robot, #told",
            ExpressionAttributeNames={"#robot": ROBOT, "#told": INCIDENTS_TOLD},
            ConsistentRead=True,
        )
        if "Item" not in answer:
            return None
        kept = answer["Item"].get(INCIDENTS_TOLD, {}).get("SS", ())
        return {one.partition("-")[2] for one in kept}

    def add(self, robot: str, note: str, now_s: int) -> None:
        """Note; the oldest notes go."""
        answer = self._change(robot, "ADD", [f"{now_s:010d}-{note}"])
        kept = sorted(answer.get(INCIDENTS_TOLD, {}).get("SS", ()))
        if old := kept[:-NOTES]:
            self._change(robot, "DELETE", old)

    def _change(self, robot: str, verb: str, notes: list[str]) -> Mapping[str, Any]:
        answer = self._client.update_item(
            TableName=self._table,
            Key={ROBOT: {"S": robot}},
            UpdateExpression=f"{verb} #told :notes",
            ConditionExpression="attribute_exists(#robot)",
            ExpressionAttributeNames={"#robot": ROBOT, "#told": INCIDENTS_TOLD},
            ExpressionAttributeValues={":notes": {"SS": notes}},
            ReturnValues="UPDATED_NEW",
        )
        return answer.get("Attributes", {})


@dataclass(frozen=True)
class Ways:
    """How people and programs hear of an incident; ``notify`` mails, None for nobody."""

    told: Told
    mails: Quota
    notify: Notify | None
    webhook: Sender

    def tell(self, event: Mapping[str, Any], now_s: int) -> None:
        """Tell of a sample whom nobody told of it yet. Raises `ContractError` for another event, and
        `WebhookError` if the webhook's receiver does not take it."""
        what = news(event)
        if self.notify is None and not self.webhook.stored():
            return
        robot, notes = what.topic.robot, self.told.notes(what.topic.robot)
        if notes is None:
            return
        if self.notify is not None and what.incident.state in MAILED:
            note = _note(what, "mail")
            if note not in notes:
                if self.mails.take(robot, 1, now_s):
                    self.notify(*mail(what))
                    emit("incident", IncidentMails=1)
                else:
                    emit("incident", IncidentsHeld=1)
                self.told.add(robot, note, now_s)
        note = _note(what, "webhook")
        if note not in notes:
            try:
                # After the mail, which must not wait for a webhook that cannot be read.
                if not self.webhook.stored():
                    return
                self.webhook.deliver(what.body, what.delivery)
            except WebhookError:
                emit("incident", WebhooksFailed=1)
                raise
            emit("incident", WebhooksSent=1)
            self.told.add(robot, note, now_s)


def _note(what: News, way: str) -> str:
    return hashlib.sha256(f"{way} {what.delivery}".encode()).hexdigest()[:12]


def mail(what: News) -> tuple[str, str]:
    """The subject and the text of a mail about an incident."""
    one, robot = what.incident, what.topic.robot
    trigger = one.trigger or "an incident"
    lines = [
        f"{robot}: {trigger}, {MAILED[one.state]}",
        "",
        f"when      {_time(one.from_us)} to {_time(one.to_us)} UTC",
    ]
    for label, text in (("if", one.condition), ("why", one.why), ("by", one.by)):
        if text:
            lines.append(f"{label:10}{text}")
    lines += ["", f"All incidents: iort incidents {robot}"]
    if one.state == KEPT:
        lines.append(f"The file, once it is uploaded: iort incidents get {one.id} --robot {robot}")
    return f"{what.topic.namespace}: {robot}, {trigger}, {MAILED[one.state]}", "\n".join(lines) + "\n"


def _time(t_us: int) -> str:
    try:
        return f"{datetime.fromtimestamp(t_us / 1e6, timezone.utc):%Y-%m-%d %H:%M:%S}"
    except (OverflowError, OSError, ValueError):
        return str(t_us)


@cache
def _ways() -> Ways:
    given = variables(IncidentEnvironment)
    client, table = clients.dynamodb(), given.robots_table
    named = (INCIDENT_HOUR, INCIDENT_MAILS)
    return Ways(
        Told(client, table),
        Quota(client, table=table, named=named, period=HOUR, most=MAILS_AN_HOUR),
        _notify if given.incident_mails else None,
        StoredWebhook(given.webhook_parameter, plain=given.embedded),
    )


def _notify(subject: str, text: str) -> None:
    clients.send(variables(IncidentEnvironment).alarm_topic, subject, text)


@quarantined
def _told(event: Mapping[str, Any]) -> None:
    _ways().tell(event, int(time.time()))


def handler(event: dict[str, Any], context: object) -> dict[str, int] | None:
    """Entry point of the calls by `summarize` and `later`, and of the operator's test message."""
    if TEST in event:
        body = json.dumps({"namespace": variables(IncidentEnvironment).namespace, TEST: True}).encode()
        webhook = _ways().webhook
        webhook.stored()
        return {"status": webhook.deliver(body, TEST, tries=1)}
    _told(event, context)
    return None
