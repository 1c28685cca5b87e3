"""Lambda 2 reports and counts invalid records and neighbours, and continues."""

from __future__ import annotations

import base64
import json
import logging
import zlib

import pytest

from functions.shared import tables as tables_module
from functions.shared.summary import process
from iort_contract.codec.columns import DICTIONARY
from iort_contract.dynamodb import TableError
from iort_contract.limits import MAX_AHEAD_US, MAX_COLUMNS_BYTES
from iort_contract.messages.batch import BatchId, encode_batch
from testkit.dynamodb import ROBOTS, FakeDynamoDB, item_of_message
from tests.unit.functions.summary.summarizing import T0, S, Stream, batch, clean, counted


def poison(**changes):
    """An item that looks like a batch; None removes the attribute."""
    envelope = json.loads(encode_batch(batch(T0 + 10 * S + 1, 3, seq=7))) | changes
    return item_of_message(json.dumps({k: v for k, v in envelope.items() if v is not None}).encode())


def packed(body):
    """As the samples of a batch are compressed."""
    deflater = zlib.compressobj(zdict=DICTIONARY)
    return base64.b64encode(deflater.compress(body) + deflater.flush()).decode()


bomb = base64.b64encode(zlib.compress(b" " * (MAX_COLUMNS_BYTES + 2))).decode()
POISON = {
    "not base64": poison(samples="%%%"),
    "not zlib": poison(samples="AAAA"),
    "not JSON": poison(samples=base64.b64encode(zlib.compress(b"{")).decode()),
    "inflates without end": poison(samples=bomb),
    "no samples": poison(samples=None),
    "version before": poison(v=1),
    "other version": poison(v=9),
    "no version": poison(v=None),
    "other codec": poison(codec="cbor"),
    "wrong count": poison(n=4),
    "huge count with its digits": {**poison(), "n": {"N": "1" + "0" * 125}},
    "fraction for nonfinite": {**poison(), "nonfinite": {"N": "7.5"}},
    "huge nonfinite": {**poison(), "nonfinite": {"N": "1E+125"}},
    "map for nonfinite": {**poison(), "nonfinite": {"M": {}}},
    "no run": poison(batch=f"{T0}-car-7"),
    "no number": poison(batch=f"{T0}-aaaaaaaa-"),
    "huge number": poison(batch=f"{T0}-aaaaaaaa-{10**15 * 9 + 10**14}"),
    "no key of a batch": poison(batch="zzz"),
    "a key of text": poison(batch="x" * 1024),
    "binary samples": {**poison(), "samples": {"B": b"AAAA"}},
    "messages without a head": poison(codec="ros1", samples=packed(b'{"dt":[0],"fields":{}}'), n=1),
    "messages of nothing": poison(codec="ros1", samples=packed(b'{"dt":[0],"fields":{}}\n{}\n'), n=1),
    "other topic": {**poison(), "topic": {"S": "dt/iort/car"}},
    "topic of no robot": {**poison(), "topic": {"S": "dt/iort/c r/vesc"}},
    "topic of the live lane": {**poison(), "topic": {"S": "live/iort/car/vesc"}},
    "in the name of another": {**poison(), "robot": {"S": "other"}},
    "before 1970": poison(batch=f"-{1:015}-aaaaaaaa-7"),
    "years ahead": poison(batch=str(BatchId(T0 + 2 * MAX_AHEAD_US, "aaaaaaaa", 7))),
}


@pytest.mark.parametrize("name", POISON)
def test_a_poison_record_is_reported_and_the_others_are_kept(stream, name, capsys, caplog):
    good = [batch(T0, 50, seq=0), batch(T0 + 10 * S, 1, seq=1), batch(T0 + 11 * S, 50, seq=2)]
    first, second = stream.store(*good[:2])
    bad = stream.store_item(POISON[name])
    (third,) = stream.store(good[2])
    with caplog.at_level(logging.WARNING):
        answer = stream.summarize([first, second, bad, third])
    assert answer == {"batchItemFailures": []}
    number = bad["dynamodb"]["SequenceNumber"]
    assert [(one.number, one.image) for one in stream.refused] == [(number, POISON[name])]
    assert stream.column("n") == {0: 50, 10: 1, 11: 50}
    assert stream.column("missing_batches") == {0: 0, 10: 0, 11: 0}
    assert counted(capsys) == {"BatchesSummarized": 3, "SamplesSummarized": 101, "BatchesRefused": 1}
    assert [record.message[:7] for record in caplog.records] == ["refused"]
    # If the dead-letter queue does not take it, it stays in the stream and is delivered again.
    before = clean(stream.summary())
    stream.jammed = {number}
    assert stream.summarize([bad, third]) == {"batchItemFailures": [{"itemIdentifier": number}]}
    assert clean(stream.summary()) == before


def test_a_replay_reports_refused_records_and_does_not_quarantine_them_again(stream):
    good, bad = stream.store(batch(T0, 5)), stream.store_item(POISON["other version"])
    event = {"replay": True, "Records": [*good, bad]}
    answer = process(event, stream.tables, stream.refuse)
    assert answer == {"batchItemFailures": [{"itemIdentifier": bad["dynamodb"]["SequenceNumber"]}]}
    assert stream.refused == []
    assert stream.column("n") == {0: 5}


def test_a_poison_neighbour_does_not_count_as_a_stored_batch(stream):
    stream.deliver(batch(T0, seq=5))
    for i in range(3):
        stream.summarize([stream.store_item(poison(v=9, batch=f"{T0 + (20 + i) * S}-aaaaaaaa-7"))])
    stream.deliver(batch(T0 + 40 * S, seq=8))
    # 6 and 7 are missing; the poison items may be them, but this cannot be known.
    assert stream.column("missing_batches") == {0: 5, 40: 2}


def test_many_poison_items_are_read_with_few_queries(stream):
    for i in range(200):
        stream.store_item(poison(v=9, batch=f"{T0 + i * S}-aaaaaaaa-7"))
    stream.client.calls.clear()
    stream.deliver(batch(T0 + 500 * S, seq=1))
    assert stream.client.calls["query"] <= 15
    assert stream.column("n") == {500: 1}


def test_a_table_that_accepts_no_writes_fails_the_event(monkeypatch):
    monkeypatch.setattr(tables_module.time, "sleep", lambda _: None)
    stream = Stream(FakeDynamoDB(unprocessed=10**9))
    with pytest.raises(TableError):
        stream.deliver(*(batch(T0 + i * S, seq=i) for i in range(20)))


def test_wrong_vehicle_parameters_stop_no_summary(stream, caplog):
    stream.client.put(ROBOTS, {"robot": {"S": "car"}, "speed_to_erpm_gain": {"S": "fast"}})
    stream.deliver(batch(T0, 2, speed=[1, 2]))
    assert stream.column("speed_max") == {0: 2}
    assert "car" in caplog.text


def test_an_attribute_with_more_digits_than_boto3_reads_stops_no_summary(stream):
    """DynamoDB returns numbers up to 9.99e125 with all their digits."""
    odd = {"N": "-1" + "0" * 125}
    item = item_of_message(encode_batch(batch(T0, 3, a=[1.5] * 3)))
    odd_item = {**item, "far": odd, "deep": {"M": {"far": {"L": [odd]}}}}
    assert stream.summarize([stream.store_item(odd_item)]) == {"batchItemFailures": []}
    assert stream.column("n") == {0: 3}
    stream.deliver(batch(T0 + S // 2, 2, seq=1, a=[2.5] * 2))
    assert stream.column("n") == {0: 5}
    assert stream.refused == []
