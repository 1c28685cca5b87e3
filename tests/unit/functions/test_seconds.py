"""A second's summary is stored packed and read flat."""

from __future__ import annotations

from collections import defaultdict
from itertools import cycle, groupby, islice, pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from functions.shared import seconds
from functions.shared.seconds import SECOND_BATCHES, Reader
from functions.shared.summary import process
from functions.shared.tables import attribute
from iort_contract import tables
from iort_contract.codec import flat_second
from iort_contract.dynamodb import plain
from iort_contract.messages.batch import Batch, decode_item
from iort_contract.statistics import missing_before, summarize_second
from iort_contract.tables import EXPIRES_S, OMITTED, STATS, TOPIC
from testkit.dynamodb import ROBOTS, TOPIC_OF_CAR, FakeDynamoDB
from tests.examples import examples
from tests.unit.functions.summarizing import SECOND, T0, S, Stream, batch, clean

# Field names that look like a second's other keys or like another field's statistics.
COUNTS = ["n", "batches", "gaps", "topic", "second", "expires_s", "omitted"]
AWKWARD = [*COUNTS, "a", "a_last", "a_min", "a_last_last"]
names = st.sampled_from(AWKWARD) | st.from_regex(r"[a-z]{1,3}(_(min|mean|max|last)){0,2}", fullmatch=True)
numbers = st.integers(-5, 5) | st.floats(-1e9, 1e9) | st.sampled_from([1e300, -1e-200])
values = numbers | st.none() | st.booleans() | st.text(max_size=3)


def test_the_batch_before_is_decoded_once_unless_the_table_has_changed(monkeypatch):
    decoded = []
    monkeypatch.setattr(seconds, "decode_item", lambda item: decoded.append(item) or decode_item(item))
    stream = Stream()
    stream.deliver(batch(T0 + 500_000, 40, speed=[1] * 40))
    stream.deliver(batch(T0 + 1_300_000, 20, seq=1, speed=[3] * 20))
    assert (decoded, stream.column("speed_min")[1]) == ([], 1)
    # Sent again with other values; its record comes later.
    stream.store(batch(T0 + 500_000, 40, speed=[2] * 40))
    stream.deliver(batch(T0 + 1_300_000, 20, seq=1, speed=[3] * 20))
    assert (len(decoded), stream.column("speed_min")[1]) == (1, 2)


three = {"min_size": 3, "max_size": 3}


@given(st.dictionaries(names, st.lists(numbers, **three) | st.lists(values, **three)))
def test_a_packed_second_is_read_as_it_was_summarized(columns):
    packed = summarize_second(0, [Batch("0badcafe", 0, [0, 10, 20], columns)], None)
    assert packed is not None
    packed[EXPIRES_S] = 1_800_000_000
    made = flat_second(packed)
    for name, column in columns.items():
        known = [value for value in column if value is not None]
        if known:
            assert made[f"{name}_last"] == known[-1]
        if known and {type(value) for value in known} <= {int, float}:
            assert (made[f"{name}_min"], made[f"{name}_max"]) == (min(known), max(known))
    assert not packed.keys() & {TOPIC, tables.SECOND, OMITTED}
    # The same through the table, with Decimals as numbers.
    stored = plain({name: attribute(value) for name, value in packed.items()})
    assert flat_second(stored) == plain({name: attribute(value) for name, value in made.items()})


def test_a_second_that_was_stored_flat_is_still_read():
    flat = {"n": 50, "speed_min": 1, "speed_mean": 1.5, "speed_max": 2, "speed_last": 2, "mode_last": "x"}
    assert flat_second(flat) == flat


@pytest.mark.parametrize(
    ("columns", "expected"),
    [
        ({"a": [1, 2, 4.5]}, {"a": [1, 2.5, 4.5, 4.5]}),
        ({"a": [7, 7, 7]}, {"a": [7]}),
        ({"a": ["x", "y", None]}, {"a_last": "y"}),
        ({"a": [1, 2, "y"]}, {"a_last": "y"}),
        ({"gaps": [1, 1, 1]}, {f"gaps_{statistic}": 1 for statistic in STATS}),
    ],
)
def test_a_second_is_packed_as_documented(columns, expected):
    packed = summarize_second(0, [Batch("0badcafe", 0, [0, 10, 20], columns)], None)
    whole = {"n": 3, "batches": 1, "missing_batches": 0, "gaps": 0, "nonfinite": 0}
    assert packed == {**whole, **expected}


# A robot that fills a second with batches does not delay other robots, and no batch is lost.

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


# Lambda 2: the summary depends on the stored batches, not on the order of the stream's records.


@st.composite
def drives(draw):
    """Batches of one stream as they may lie in the table: some missing, some of a restarted agent,
    some that overlap because the car's clock was set back; no two begin at the same time."""
    batches, start_us, seq, boot = [], T0 - 300_000, draw(st.integers(0, 3)), "aaaaaaaa"
    starts = set()
    for _ in range(draw(st.integers(1, 10))):
        start_us += draw(st.sampled_from([20_000, 400_000, 980_000, S, 1_500_000, 3 * S, 90 * S, -700_000]))
        start_us -= draw(st.sampled_from([0, start_us % S]))
        while start_us in starts:
            start_us += 20_000
        starts.add(start_us)
        if draw(st.booleans()) and draw(st.booleans()):
            boot, seq = ("bbbbbbbb" if boot == "aaaaaaaa" else "aaaaaaaa"), draw(st.sampled_from([0, seq]))
        n, step_us = draw(st.sampled_from([(1, 1), (2, 400_000), (5, 199_999), (50, 20_000), (12, 20_000)]))
        fields = draw(st.sets(st.sampled_from(["speed", "voltage_input", "current_input", "mode"])))
        whole = st.integers(-9, 9)
        values = {
            "mode": st.sampled_from(["a", None, True]),
            "speed": st.sampled_from([0, 1.5, 1e300, 5e-324]),
        }
        columns = {
            name: list(islice(cycle(draw(st.lists(values.get(name, whole), min_size=1, max_size=3))), n))
            for name in sorted(fields)
        }
        batches.append(batch(start_us, n, step_us=step_us, seq=seq, boot=boot, nonfinite=n % 3, **columns))
        seq += draw(st.sampled_from([1, 1, 1, 2, 5]))
    return batches


@examples(150)
@given(drives(), st.randoms(use_true_random=False), st.data())
def test_the_summary_does_not_depend_on_order_grouping_or_repetition_of_records(drive, rng, data):
    expected = Stream()
    expected.client.put(ROBOTS, {"robot": {"S": "car"}, "speed_to_erpm_gain": {"N": "4614"}})
    expected.deliver(*drive)

    got = Stream(FakeDynamoDB(page_items=data.draw(st.sampled_from([1, 2, 100]))))
    got.client.put(ROBOTS, {"robot": {"S": "car"}, "speed_to_erpm_gain": {"N": "4614"}})
    order = list(drive)
    rng.shuffle(order)
    seen = []
    while order:
        # The table is ahead of its stream: later batches may be stored already.
        take = rng.randint(1, len(order))
        group, order = order[:take], order[take:]
        records = got.store(*group)
        seen += records
        got.store(*(b for b in order if rng.random() < 0.3))
        records += [record for record in seen if rng.random() < 0.3]
        rng.shuffle(records)
        half = rng.randint(0, len(records))
        for part in (records[:half], records[half:], records if rng.random() < 0.3 else []):
            if part:
                assert got.summarize(part) == {"batchItemFailures": []}

    assert told(got, drive) == told(expected, drive)
    assert sum(item["n"] for item in got.summary().values()) == sum(len(b.times_us) for b in drive)
    assert_summary(expected.summary(), drive)


def in_order(drive):
    """True if numbers and times agree: no clock was set back, and no run continued after another."""
    drive = sorted(drive, key=lambda b: b.id)
    runs = [boot for boot, _ in groupby(b.boot for b in drive)]
    return len(set(runs)) == len(runs) and all(a.seq < b.seq for a, b in pairwise(drive) if a.boot == b.boot)


def told(stream, drive):
    """The summary, with missing batches only if numbers and times agree; otherwise that number depends on
    the batches stored when the second was last summarised."""
    summary = clean(stream.summary())
    if not in_order(drive):
        for item in summary.values():
            del item["missing_batches"]
    return summary


def assert_summary(summary, drive):
    """Compare with a direct computation from all batches."""
    agree = in_order(drive)
    drive = sorted(drive, key=lambda b: b.id)
    samples = defaultdict(list)
    for b in drive:
        for i, t_us in enumerate(b.times_us):
            samples[t_us // S].append({name: column[i] for name, column in b.columns.items()})
    assert summary.keys() == samples.keys()
    missing, nonfinite = defaultdict(int), defaultdict(int)
    for b in drive:
        missing[b.t_us // S] += missing_before(b.id, [other.id for other in drive])
        nonfinite[b.t_us // S] += b.nonfinite
    for second, rows in samples.items():
        item = summary[second]
        assert item["n"] == len(rows)
        assert item["batches"] == sum(any(t // S == second for t in b.times_us) for b in drive)
        assert not agree or item["missing_batches"] == missing[second]
        assert item["nonfinite"] == nonfinite[second]
        for name in ("voltage_input", "current_input"):
            column = [row[name] for row in rows if name in row]
            if column:
                assert [item[f"{name}_{stat}"] for stat in ("min", "max", "last")] == [
                    min(column),
                    max(column),
                    column[-1],
                ]
                assert float(item[f"{name}_mean"]) == pytest.approx(sum(column) / len(column), rel=1e-8)
            else:
                assert f"{name}_last" not in item
