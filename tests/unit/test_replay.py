"""Replays of what no agent sent: one entry that cannot be read keeps no other back."""

from __future__ import annotations

import json

import pytest

import contract
from contract import BY_RULE, BY_STREAM, Batch, build_topic
from station.quarantine import Entry
from station.replay import Fate, replay
from tests.fakes import item_of

TOPIC = build_topic(contract.RECORD, "car", "vesc")
RECEIVED_MS = "1700000000000"
GOOD = Batch("0123abcd", 0, [1_700_000_000_000_000], {"speed": [1.5]})


class FakeCloud:
    """A cloud with a quarantine of these payloads, by the entries' ids."""

    def __init__(self, payloads, topic=TOPIC):
        self._payloads, self._topic = payloads, topic

    def output(self, _stack, name):
        return name

    def client(self, service):
        assert service == "dynamodb"
        return self

    def get_item(self, *, TableName, Key, ConsistentRead):
        assert (TableName, ConsistentRead) == ("QuarantineTable", True)
        source, payload = self._payloads[Key["id"]["S"]]
        texts = {"robot": "car", "source": source, "topic": self._topic, "reason": "some"}
        item = {name: {"S": text} for name, text in texts.items()} | Key | {"payload": {"B": payload}}
        return {"Item": item | {name: {"N": RECEIVED_MS} for name in ("first_ms", "last_ms", "seen")}}


def outcomes(**payloads):
    listed = [Entry("car", name, source, TOPIC, "some", 1, 1, 1, 0) for name, (source, _) in payloads.items()]
    return [outcome.fate for outcome in replay(FakeCloud(payloads), listed, dry_run=True)]


whole = json.dumps(item_of(GOOD, TOPIC)).encode()
future = json.dumps(item_of(GOOD, TOPIC) | {"received_ms": {"N": "1"}}).encode()


@pytest.mark.parametrize("source", [BY_STREAM, f"{BY_RULE} iort_record"])
@pytest.mark.parametrize(
    "odd",
    [whole[:-100], b"", b"[]", b"\xff", b"[" * 100_000, future],
    ids=["cut", "empty", "no object", "no text", "nested", "ahead"],
)
def test_an_entry_that_cannot_be_read_is_refused_and_the_next_one_is_not(odd, source):
    fates = outcomes(bad=(source, odd), good=(BY_STREAM, whole))
    assert fates == [Fate.REFUSED, Fate.WOULD]


@pytest.mark.parametrize("prefix", ["", "$aws/rules/iort_record/"])
def test_a_batch_is_replayed_whether_or_not_its_topic_has_basic_ingests_prefix(prefix):
    payload = contract.encode(GOOD)
    cloud = FakeCloud({"a": (f"{BY_RULE} iort_record", payload)}, topic=prefix + TOPIC)
    listed = Entry("car", "a", f"{BY_RULE} iort_record", prefix + TOPIC, "some", 2_000_000_000_000, 1, 1, 0)
    (outcome,) = replay(cloud, [listed], dry_run=True)
    assert (outcome.fate, outcome.entry.topic) == (Fate.WOULD, TOPIC), outcome.detail


def test_keys_that_the_rule_would_not_store_keep_no_batch_from_replay():
    odd = {**json.loads(contract.encode(GOOD)), "robot": "another", "topic": "dt/iort/another/vesc"}
    assert outcomes(odd=(f"{BY_RULE} iort_record", json.dumps(odd).encode())) == [Fate.WOULD]
