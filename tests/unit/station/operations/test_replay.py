"""Replays of unreadable dead letters: they do not stop the replay of other entries."""

from __future__ import annotations

import io
import json
from types import SimpleNamespace

import pytest

from iort_contract.messages.batch import Batch, encode_batch
from iort_contract.tables import BY_FUNCTION, BY_LATER, BY_RULE, BY_STREAM, PUT_OFF
from iort_contract.topics import RECORD, build_topic
from iort_station.operations.quarantine import DeadLetter, Fate, replay
from testkit.dynamodb import item_of

TOPIC = build_topic(RECORD, "car", "vesc")
NOW_MS = 1_700_000_000_000
GOOD = Batch("0123abcd", 0, [1_700_000_000_000_000], {"speed": [1.5]})


class FakeCloud:
    """A fake cloud with these payloads in quarantine, by entry id, and an empty telemetry table."""

    def __init__(self, payloads, topic=TOPIC):
        self._payloads, self._topic = payloads, topic

    def output(self, _stack, name):
        return name

    def client(self, service):
        assert service == "dynamodb"
        return self

    def get_item(self, *, TableName, Key, ConsistentRead, **_):
        assert ConsistentRead
        if TableName == "TelemetryTable":
            return {}
        assert TableName == "QuarantineTable"
        source, payload = self._payloads[Key["id"]["S"]]
        texts = {"robot": "car", "source": source, "topic": self._topic, "reason": "some"}
        item = {name: {"S": text} for name, text in texts.items()} | Key | {"payload": {"B": payload}}
        return {"Item": item | {name: {"N": str(NOW_MS)} for name in ("first_ms", "last_ms", "seen")}}

    def update_item(self, *, TableName, Key, **_):
        assert (TableName, Key["id"]["S"] in self._payloads) == ("QuarantineTable", True)


def replayed(*, dry_run=True, **payloads):
    listed = [
        DeadLetter("car", name, source, TOPIC, "some", 1, 1, 1, 0) for name, (source, _) in payloads.items()
    ]
    return list(replay(FakeCloud(payloads), listed, dry_run=dry_run))


class Queues(FakeCloud):
    """A fake cloud that also has the queue of deferred batches."""

    def __init__(self, payloads, topic=TOPIC):
        super().__init__(payloads, topic)
        self.sent, self.deleted = [], []
        self.exceptions = SimpleNamespace(ConditionalCheckFailedException=KeyError)

    def client(self, service):
        assert service in {"dynamodb", "sqs"}
        return self

    def send_message(self, **message):
        self.sent.append(message)

    def update_item(self, *, Key, UpdateExpression, ExpressionAttributeNames, **_):
        if UpdateExpression.startswith("REMOVE"):
            # A move reads the key and the expiry.
            assert not {"robot", "id", "expires_s"} & set(ExpressionAttributeNames.values())
            self.deleted.append(Key["id"]["S"])


def test_deferred_batches_that_failed_are_queued_again():
    body = json.dumps({PUT_OFF: [[TOPIC, str(GOOD.id)]]})
    cloud = Queues({"late": (BY_LATER, body.encode())})
    listed = [DeadLetter("car", "late", BY_LATER, TOPIC, "some", 1, 1, 1, 0)]
    assert [outcome.fate for outcome in replay(cloud, listed)] == [Fate.REPLAYED]
    assert cloud.sent == [{"QueueUrl": "PutOffQueue", "MessageBody": body, "MessageGroupId": "car"}]
    assert cloud.deleted == ["late"]


def outcomes(**payloads):
    return [outcome.fate for outcome in replayed(**payloads)]


whole = json.dumps(item_of(GOOD, TOPIC)).encode()
future = json.dumps(item_of(GOOD, TOPIC) | {"received_ms": {"N": "1"}}).encode()


@pytest.mark.parametrize("source", [BY_STREAM, f"{BY_RULE} iort_record"])
@pytest.mark.parametrize(
    "odd",
    [whole[:-100], b"", b"[]", b"\xff", b"[" * 100_000, future],
    ids=["cut", "empty", "no object", "no text", "nested", "ahead"],
)
def test_an_unreadable_entry_is_refused_and_the_next_one_is_replayed(odd, source):
    fates = outcomes(bad=(source, odd), good=(BY_STREAM, whole))
    assert fates == [Fate.REFUSED, Fate.WOULD]


@pytest.mark.parametrize("prefix", ["", "$aws/rules/iort_record/"])
def test_a_batch_is_replayed_with_and_without_basic_ingests_prefix(prefix):
    payload = encode_batch(GOOD)
    cloud = FakeCloud({"a": (f"{BY_RULE} iort_record", payload)}, topic=prefix + TOPIC)
    listed = DeadLetter(
        "car", "a", f"{BY_RULE} iort_record", prefix + TOPIC, "some", 2_000_000_000_000, 1, 1, 0
    )
    (outcome,) = replay(cloud, [listed], dry_run=True)
    assert (outcome.fate, outcome.letter.topic) == (Fate.WOULD, TOPIC), outcome.detail


def test_keys_that_the_rule_ignores_do_not_stop_a_replay():
    odd = {**json.loads(encode_batch(GOOD)), "robot": "another", "topic": "dt/iort/another/vesc"}
    assert outcomes(odd=(f"{BY_RULE} iort_record", json.dumps(odd).encode())) == [Fate.WOULD]


class Functions(Queues):
    """A fake cloud that also has the function incident, which fails as ``error`` says."""

    error = None

    def client(self, service):
        assert service in {"dynamodb", "lambda"}
        return self

    def invoke(self, *, FunctionName, Payload):
        self.sent.append((FunctionName, json.loads(Payload)))
        failed = {"FunctionError": "Unhandled"} if self.error else {}
        answer = {"errorMessage": self.error} if self.error else None
        return {"Payload": io.BytesIO(json.dumps(answer).encode()), **failed}


def test_an_incident_that_nobody_could_be_told_of_is_told_again():
    event = {"topic": build_topic(RECORD, "car", "incidents"), "t": 1, "incident": {}}
    source = f"{BY_FUNCTION} iort-processing-Incident"
    cloud = Functions({"told": (source, json.dumps(event).encode())}, topic=event["topic"])
    listed = [DeadLetter("car", "told", source, event["topic"], "some", 1, 1, 1, 0)]
    cloud.error = "the webhook at lab.example.org answered 500"
    (outcome,) = replay(cloud, listed)
    assert (outcome.fate, cloud.deleted) == (Fate.FAILED, [])
    assert "answered 500" in outcome.detail
    cloud.error = None
    assert [outcome.fate for outcome in replay(cloud, listed)] == [Fate.REPLAYED]
    assert cloud.sent == [("IncidentFunction", event)] * 2
    assert cloud.deleted == ["told"]
