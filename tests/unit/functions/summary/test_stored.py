"""A robot that fills a second with batches does not delay other robots, and no batch is lost."""

from __future__ import annotations

import pytest

from functions.shared.seconds import SECOND_BATCHES, Reader
from functions.shared.summary import process
from iort_contract.messages.batch import Batch
from testkit.dynamodb import TOPIC_OF_CAR
from tests.unit.functions.summary.summarizing import SECOND, T0, S, Stream, batch

MANY = 3 * SECOND_BATCHES


def packed(count, *, second=0, seq=0):
    """n batches of one sample within a second."""
    return [batch(T0 + second * S + n * (S // count), seq=seq + n) for n in range(count)]


def test_a_second_counts_its_first_batches_and_refuses_further_ones(stream, capsys):
    batches = packed(MANY)
    records = stream.store(*batches)
    assert stream.summarize(records) == {"batchItemFailures": []}
    assert stream.column("batches") == {0: SECOND_BATCHES}
    assert [one.number for one in stream.refused] == [
        record["dynamodb"]["SequenceNumber"] for record in records[SECOND_BATCHES:]
    ]
    assert all("100 batches" in one.reason and "samples" in one.image for one in stream.refused)
    said = capsys.readouterr().out
    assert f'"BatchesRefused":{MANY - SECOND_BATCHES}' in said
    assert f'"BatchesSummarized":{SECOND_BATCHES}' in said


def test_a_refused_batch_stays_in_the_stream_if_the_queue_does_not_take_it(stream):
    records = stream.store(*packed(SECOND_BATCHES + 1))
    number = records[-1]["dynamodb"]["SequenceNumber"]
    stream.jammed = {number}
    assert stream.summarize(records) == {"batchItemFailures": [{"itemIdentifier": number}]}


def test_the_allowed_number_of_batches_is_summarised(stream):
    stream.deliver(*packed(SECOND_BATCHES))
    assert stream.column("batches") == {0: SECOND_BATCHES}
    assert stream.refused == []


def test_every_event_reads_a_bounded_part_of_a_full_second(stream):
    records = stream.store(*packed(MANY), *packed(3, second=1, seq=MANY))
    stream.summarize(records)
    before = stream.client.read
    stream.summarize(records[-1:])
    # Both seconds, in whole pages.
    assert stream.client.read - before <= 3 * SECOND_BATCHES


@pytest.mark.parametrize("grouped", [1, 7, 10_000])
def test_the_second_after_a_full_one_misses_nothing(stream, grouped):
    records = stream.store(*packed(MANY), *packed(3, second=1, seq=MANY))
    for start in range(0, len(records), grouped):
        stream.summarize(records[start : start + grouped])
    assert stream.column("missing_batches") == {0: 0, 1: 0}
    assert stream.column("batches") == {0: SECOND_BATCHES, 1: 3}
    refused = {one.number for one in stream.refused}
    assert refused == {record["dynamodb"]["SequenceNumber"] for record in records[SECOND_BATCHES:MANY]}


def test_a_batch_that_reaches_beyond_a_full_second_counts_in_the_next(stream):
    over = batch(T0 + S - 1_000, 2, seq=MANY)
    stream.deliver(*packed(MANY), over)
    assert stream.column("n") == {0: SECOND_BATCHES, 1: 1}


def test_undecodable_neighbours_fill_a_second(stream):
    records = stream.store(*packed(MANY))
    for key, item in list(stream.client.items["telemetry"].items())[: 2 * SECOND_BATCHES]:
        stream.client.items["telemetry"][key] = {**item, "samples": {"S": "AAAA"}}
    last = records[-1]
    stream.summarize([last])
    assert [one.number for one in stream.refused] == [last["dynamodb"]["SequenceNumber"]]


def test_large_batches_fill_a_second_by_their_size(stream):
    text = "x" * 4_000
    batches = [
        Batch("aaaaaaaa", n, range(T0 + n * 10_000, T0 + n * 10_000 + 300), {"a": [text] * 300})
        for n in range(20)
    ]
    stream.deliver(*batches)
    assert stream.column("batches")[0] < len(batches)
    assert stream.column("batches")[0] + len(stream.refused) == len(batches)


def test_other_seconds_and_streams_are_not_affected(stream):
    other = "dt/iort/bus/vesc"
    records = stream.store(*packed(MANY)) + stream.store(*packed(2, second=5), topic=other)
    stream.summarize(records)
    assert [item["batches"] for item in stream.summary(other).values()] == [2]
    assert len(stream.refused) == MANY - SECOND_BATCHES


def test_a_reader_reports_full_seconds(stream):
    stream.store(*packed(MANY))
    reader = Reader(stream.tables, TOPIC_OF_CAR, {}, list)
    assert len(reader.read(SECOND, SECOND)[0]) == SECOND_BATCHES + 1
    assert reader.full == {SECOND}


def test_a_distant_batch_in_the_event_does_not_change_a_full_second(stream, capsys):
    records = stream.store(*packed(MANY), batch(T0 + 100 * S, seq=MANY))
    stream.summarize(records)
    assert len(stream.refused) == MANY - SECOND_BATCHES
    assert stream.column("batches") == {0: SECOND_BATCHES, 100: 1}
    said = capsys.readouterr().out
    assert f'"BatchesSummarized":{SECOND_BATCHES + 1}' in said
    assert "BatchesMissing" not in said


def test_one_large_event_gives_the_same_summary_as_single_batches(stream, capsys):
    """More batches than one read takes, two a second that reach into the next second, and one hole."""
    batches = [
        batch(T0 + n * S // 2 + 100_000, 20, step_us=25_000, seq=n + 5 * (n >= 100)) for n in range(300)
    ]
    records = stream.store(*batches)
    stream.summarize(records)
    assert '"BatchesMissing":5}' in capsys.readouterr().out
    at_once = stream.summary()
    for record in records:
        stream.summarize([record])
    assert at_once == stream.summary()
    assert [second for second, missing in stream.column("missing_batches").items() if missing] == [50]


def test_topics_that_are_read_concurrently_give_the_same_summary():
    seen = []
    for at_once in (1, 4):
        stream = Stream()
        topics = [f"dt/iort/car{n}/vesc" for n in range(9)]
        records = [record for topic in topics for record in stream.store(*packed(3), topic=topic)]
        process({"Records": records}, stream.tables, stream.refuse, at_once=at_once)
        seen.append({topic: stream.summary(topic) for topic in topics})
    assert seen[0] == seen[1]
    assert all(item["batches"] == 3 for items in seen[0].values() for item in items.values())


def large(number):
    """A batch that fills half a second's size limit and is small on the wire."""
    texts = {f"f{i}": ["x" * 4000] * 100 for i in range(10)}
    return Batch("aaaaaaaa", number, [T0 + number * S + i * 5000 for i in range(100)], texts)


def test_large_seconds_are_not_in_memory_together(stream):
    batches = [large(number) for number in range(8)]
    records = stream.store(*batches)
    held = []
    reader = Reader(stream.tables, TOPIC_OF_CAR, {one.id: one for one in batches}, list)
    first = SECOND
    while first < SECOND + 8:
        stored, last = reader.read(first, SECOND + 7)
        held.append(len(stored))
        assert last >= first
        first = last + 1
    assert max(held) < 5
    assert stream.summarize(records) == {"batchItemFailures": []}
    assert stream.column("n") == dict.fromkeys(range(8), 100)
    assert stream.column("missing_batches") == dict.fromkeys(range(8), 0)
