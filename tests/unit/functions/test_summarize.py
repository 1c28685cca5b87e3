"""Summarize: the content of a second's summary, one property a test."""

from __future__ import annotations

import base64
import json
import logging
import random
import zlib
from collections import defaultdict
from decimal import Decimal

import pytest

from functions import summarize
from functions.shared import tables as tables_module
from functions.shared.direct import Direct
from functions.shared.summary import process
from functions.summarize import size_of
from iort_contract.codec import DICTIONARY, flat_second
from iort_contract.dynamodb import TableError, plain
from iort_contract.limits import MAX_AHEAD_US, MAX_COLUMNS_BYTES
from iort_contract.messages.batch import BatchId, encode_batch
from iort_contract.tables import EXPIRES_S, RECEIVED_MS
from testkit.dynamodb import (
    EXPIRES,
    ROBOTS,
    SUMMARY,
    TELEMETRY,
    FakeDynamoDB,
    item_of,
    item_of_message,
    record_of,
)
from tests.unit.functions.summarizing import SECOND, T0, S, Stream, batch, clean, counted


def test_a_late_batch_fills_the_gap_that_its_successor_reported(stream, capsys):
    stream.deliver(batch(T0, 50, seq=0))
    stream.deliver(batch(T0 + 2 * S, 50, seq=2))
    assert stream.column("missing_batches") == {0: 0, 2: 1}
    assert stream.column("gaps") == {0: 0, 2: 1}
    assert counted(capsys)["BatchesMissing"] == 1
    stream.deliver(batch(T0 + S, 50, seq=1))
    assert stream.column("missing_batches") == {0: 0, 1: 0, 2: 0}
    assert stream.column("gaps") == {0: 0, 1: 0, 2: 0}
    assert stream.column("n") == {0: 50, 1: 50, 2: 50}
    assert "BatchesMissing" not in counted(capsys)


@pytest.mark.parametrize("apart_s", [2, 3, 59, 61, 100_000])
def test_a_late_batch_fills_the_gap_of_a_distant_successor(stream, apart_s):
    stream.deliver(batch(T0, seq=0))
    # Three batches in the successor's second: all of it must be summarised again, not its start.
    last = [batch(T0 + 2 * apart_s * S + i * 300_000, 5, seq=2 + i) for i in range(3)]
    stream.deliver(*last)
    assert stream.column("missing_batches") == {0: 0, 2 * apart_s: 1}
    stream.deliver(batch(T0 + apart_s * S, seq=1))
    assert stream.column("missing_batches") == {0: 0, apart_s: 0, 2 * apart_s: 0}
    assert stream.column("n") == {0: 1, apart_s: 1, 2 * apart_s: 15}


def test_missing_batches_are_counted_once_in_the_metric(stream, capsys):
    """A second may be written many times, but a missing batch counts once."""
    for i in (0, 1, 5, 6, 7, 8, 9):
        stream.deliver(batch(T0 + i * 20_000, seq=i))
    assert counted(capsys) == {"BatchesSummarized": 7, "SamplesSummarized": 7, "BatchesMissing": 3}


def test_batches_received_long_ago_are_summarised_without_alarms(stream, capsys):
    """Batches copied from an old table are not news: their faults and gaps must set off no alarm."""
    records = stream.store(batch(T0, seq=0, fault_code=[3]), batch(T0 + 2 * S, seq=2, voltage_input=[5.5]))
    received_ms = int(records[0]["dynamodb"]["NewImage"][RECEIVED_MS]["N"])

    def said(since_ms):
        process({"Records": records}, stream.tables, stream.refuse, news_since_ms=since_ms)
        lines = map(json.loads, capsys.readouterr().out.splitlines())
        return {name: value for line in lines for name, value in line.items()}

    silent = said(received_ms + 1)
    assert (silent["BatchesSummarized"], stream.column("missing_batches")) == (2, {0: 0, 2: 1})
    assert not silent.keys() & {"BatchesMissing", "FaultSamples", "BatteryVolts"}
    news = said(received_ms)
    assert (news["BatchesMissing"], news["FaultSamples"], news["BatteryVolts"]) == (1, 1, [5.5])


def test_a_restart_begins_new_sequence_numbers(stream):
    stream.deliver(batch(T0, 10, seq=8), batch(T0 + S, 10, seq=9))
    stream.deliver(
        batch(T0 + 5 * S, 10, seq=0, boot="bbbbbbbb"), batch(T0 + 6 * S, 10, seq=1, boot="bbbbbbbb")
    )
    # The first eight were never stored; the restart itself lost no known batch.
    assert stream.column("missing_batches") == {0: 8, 1: 0, 5: 0, 6: 0}
    stream.deliver(batch(T0 + 9 * S, 10, seq=2, boot="cccccccc"))
    assert stream.column("missing_batches")[9] == 0


@pytest.mark.parametrize("offset_us", [-1, 0, 1, -20_000, 20_000, 980_000])
def test_samples_at_the_boundary_count_in_their_own_second(stream, offset_us):
    b = batch(T0 + offset_us, 50)
    stream.deliver(b)
    per_second = defaultdict(int)
    for t_us in b.times_us:
        per_second[t_us // S - SECOND] += 1
    assert stream.column("n") == per_second


def test_speed_and_power_follow_from_the_vehicles_parameters(stream):
    columns = {"speed": [4614, 9228], "voltage_input": [16.0, 15.0], "current_input": [2.0, -1.0]}
    stream.client.put(ROBOTS, {"robot": {"S": "car"}, "speed_to_erpm_gain": {"N": "4614"}})
    stream.store(batch(T0, 2, **columns), topic="dt/iort/unknown/vesc")
    stream.deliver(batch(T0, 2, **columns))
    (item,) = stream.summary().values()
    assert (item["speed_mps_min"], item["speed_mps_max"], item["speed_mps_last"]) == (1, 2, 2)
    assert (item["power_w_min"], item["power_w_mean"], item["power_w_max"]) == (-15, Decimal("8.5"), 32)
    stream.deliver(batch(T0, 2, **columns), topic="dt/iort/unknown/vesc")
    (unknown,) = stream.summary("dt/iort/unknown/vesc").values()
    assert not any(name.startswith("speed_mps") for name in unknown)
    assert unknown["power_w_max"] == 32


def test_extreme_values_are_stored(stream):
    stream.deliver(
        batch(
            T0,
            3,
            huge=[1e300, 1.7e308, 1.7e308],
            tiny=[5e-324, 5e-324, 1e-200],
            counter=[2**53 + 1, 2**53 + 3, 2**64 - 1],
            low=[-(2**63)] * 3,
            flag=[True, False, True],
            text=["", None, "x" * 4096],
            nothing=[None] * 3,
            voltage_input=[2**64 - 1] * 3,
            current_input=[2**64 - 1] * 3,
        )
    )
    (item,) = stream.summary().values()
    assert (item["huge_min"], item["huge_max"]) == ("1e+300", "1.7e+308")
    assert (item["tiny_min"], item["tiny_max"], item["tiny_mean"]) == (0, 0, 0)
    assert (item["counter_min"], item["counter_max"]) == (2**53 + 1, 2**64 - 1)
    assert item["low_mean"] == -(2**63)
    assert item["flag_last"] is True
    assert item["text_last"] == "x" * 4096
    assert not any(name.startswith("nothing") for name in item)
    # 2**128 has more digits than DynamoDB keeps; the float nearest to it has not.
    assert len(item["power_w_max"].as_tuple().digits) <= 38


def test_a_summary_expires_with_its_batches(stream):
    """Samples may be years old: a recorded drive with its own times, or a car without a clock."""
    long_ago = 1_500_000_000
    stream.summarize(
        [
            stream.store_item(item_of(batch(long_ago * S, 2), expires_s=EXPIRES)),
            stream.store_item(item_of(batch(long_ago * S + 500_000, 2, seq=1), expires_s=EXPIRES + 7)),
        ]
    )
    assert stream.summary()[long_ago][EXPIRES_S] == EXPIRES + 7
    other, without = Stream(), item_of(batch(T0))
    del without[EXPIRES_S]
    other.summarize([other.store_item(without)])
    assert EXPIRES_S not in other.summary()[SECOND]


def test_a_jump_of_the_clock_does_not_read_the_years_between(stream):
    between = [batch(T0 - day * 86_400 * S - 7 * S, seq=day) for day in range(1, 200)]
    stream.store(*between)
    stream.client.calls.clear()
    stream.deliver(batch(0, 10, seq=300), batch(T0, 10, seq=301))
    assert stream.client.calls["query"] < 15
    # Only the batch that now has a predecessor in 1970 is summarised again.
    assert stream.summary().keys() == {0, between[-1].t_us // S, SECOND}


def test_the_newest_batch_of_a_driving_car_takes_one_query(stream):
    stream.client.page_items = 100
    stream.deliver(batch(T0, seq=0))
    stream.client.calls.clear()
    stream.deliver(batch(T0 + S, seq=1))
    assert (stream.client.calls["query"], stream.client.calls["batch_write_item"]) == (1, 1)


def test_removals_are_skipped(stream, capsys):
    stream.deliver(batch(T0, 5))
    before = clean(stream.summary())
    capsys.readouterr()
    item = item_of(batch(T0, 5))
    assert stream.summarize([record_of(item, 9, "REMOVE")]) == {"batchItemFailures": []}
    assert clean(stream.summary()) == before
    assert counted(capsys) == {}


def interleaved(seconds):
    """Two publishers of one stream; the clock of one is 2 s behind: batches in the order in which
    the agent closes and numbers them."""
    batches = []
    for i in range(seconds):
        for start_s in (i, i - 2):
            batches.append(batch(T0 + start_s * S + 100, 10, step_us=1000, seq=len(batches)))
    return batches


@pytest.mark.parametrize("grouped", [1, 7, 100])
def test_interleaved_clocks_miss_no_batch(stream, capsys, grouped):
    drive = interleaved(20)
    for i in range(0, len(drive), grouped):
        stream.deliver(*drive[i : i + grouped])
    assert set(stream.column("missing_batches").values()) == {0}
    assert sum(stream.column("n").values()) == 10 * len(drive)
    assert "BatchesMissing" not in counted(capsys)


def test_a_missing_batch_of_interleaved_clocks_counts_once(stream, capsys):
    drive = interleaved(20)
    lost = drive.pop(21)
    for one in drive:
        stream.deliver(one)
    assert sum(stream.column("missing_batches").values()) == 1
    assert counted(capsys)["BatchesMissing"] == 1
    # The next batch, with the other clock, reveals its number.
    (told,) = [second for second, missing in stream.column("missing_batches").items() if missing]
    assert told == drive[21].t_us // S - SECOND != lost.t_us // S - SECOND


def test_a_recording_played_twice_is_stored_twice_and_misses_no_batch(stream, capsys):
    first = [batch(T0 + i * S, 10, step_us=1000, seq=i) for i in range(5)]
    again = [batch(T0 + i * S, 10, step_us=1000, seq=5 + i, boot="bbbbbbbb") for i in range(5)]
    stream.deliver(*first)
    stream.deliver(*again)
    assert stream.column("n") == dict.fromkeys(range(5), 20)
    assert stream.column("batches") == dict.fromkeys(range(5), 2)
    assert stream.column("missing_batches") == dict.fromkeys(range(5), 0)
    assert "BatchesMissing" not in counted(capsys)
    # A repeated batch counts once.
    stream.deliver(*again)
    assert stream.column("n") == dict.fromkeys(range(5), 20)


# Lambda 2 reports and counts invalid records and neighbours, and continues.


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


# Lambda 2 against moto's tables, and on a drive of a real car.


def test_the_handler_works_on_the_templates_tables(dynamodb, monkeypatch, capsys):
    monkeypatch.setenv("PUT_OFF_QUEUE", "https://sqs.example/put-off")
    monkeypatch.setenv("ROBOT_METRICS", "false")
    monkeypatch.setenv("INCIDENT_FUNCTION", "incident")
    monkeypatch.setenv("RECORD_BYTES_A_DAY", "1")
    # moto answers botocore alone.
    monkeypatch.setattr(Direct, "_answer", lambda *_: None)
    dynamodb.put_item(TableName=ROBOTS, Item={"robot": {"S": "car"}, "speed_to_erpm_gain": {"N": "4614"}})
    stream = Stream(dynamodb)
    drive = [
        batch(T0 + i * S, 50, seq=i, speed=[4614 * i] * 50, text=["a"] * 50) for i in range(40) if i != 7
    ]
    order = list(drive)
    random.Random(1).shuffle(order)
    for start in range(0, len(order), 13):
        records = stream.store(*order[start : start + 13])
        assert summarize.handler({"Records": records}, None) == {"batchItemFailures": []}
    items = [flat_second(plain(item)) for item in dynamodb.scan(TableName=SUMMARY)["Items"]]
    assert sum(item["n"] for item in items) == 39 * 50
    by_second = {int(item["second"]) - SECOND: item for item in items}
    assert {s for s, item in by_second.items() if item["missing_batches"]} == {8}
    assert all(item["speed_mps_mean"] == second for second, item in by_second.items())
    assert counted(capsys)["SamplesSummarized"] == 39 * 50
    row = plain(dynamodb.get_item(TableName=ROBOTS, Key={"robot": {"S": "car"}})["Item"])
    stored = dynamodb.scan(TableName=TELEMETRY)["Items"]
    assert row["record_bytes"] == sum(map(size_of, stored)) > 0
    # The same through the fake: it must behave as moto does.
    fake = Stream()
    fake.client.put(ROBOTS, {"robot": {"S": "car"}, "speed_to_erpm_gain": {"N": "4614"}})
    fake.deliver(*drive)
    assert {int(item["second"]): item for item in items} == fake.summary()
