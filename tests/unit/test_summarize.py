"""Lambda 2: the summary follows from what is stored, however the stream's records come in."""

from __future__ import annotations

import base64
import json
import logging
import random
import zlib
from collections import defaultdict
from decimal import Decimal
from itertools import cycle, islice

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import contract
from contract import EXPIRES_S, Batch, split
from functions import summarize
from functions import tables as tables_module
from functions.statistics import missing_before
from functions.summarize import process
from functions.tables import TableError, plain
from tests.fakes import (
    EXPIRES,
    NAMES,
    ROBOTS,
    SUMMARY,
    TELEMETRY,
    TOPIC_OF_CAR,
    FakeDynamoDB,
    item_of,
    item_of_message,
    record_of,
    summary_of,
    tables,
)
from tests.recordings import recording

S = 1_000_000
SECOND = 1_700_000_000
T0 = SECOND * S


def batch(start_us, n=1, *, step_us=20_000, seq=0, boot="aaaaaaaa", nonfinite=0, **columns):
    """n samples from start_us on; the field i counts them unless columns are given."""
    times = [start_us + i * step_us for i in range(n)]
    return Batch(boot, seq, times, columns or {"i": list(range(n))}, nonfinite)


class Stream:
    """The telemetry table and its stream: what is stored gets a record, and summarize gets records."""

    def __init__(self, client=None):
        self.client = client if client is not None else FakeDynamoDB()
        self.tables = tables(self.client)
        self.records = 0
        self.refused, self.jammed = [], set()

    def store(self, *batches, topic=TOPIC_OF_CAR):
        return [self.store_item(item_of(batch, topic)) for batch in batches]

    def store_item(self, item):
        if isinstance(self.client, FakeDynamoDB):
            self.client.put(TELEMETRY, item)
        else:
            self.client.put_item(TableName=TELEMETRY, Item=item)
        self.records += 1
        return record_of(item, self.records)

    def summarize(self, records):
        return process({"Records": records}, self.tables, self.refuse)

    def refuse(self, refused):
        """The queue before the quarantine, which takes all but what ``jammed`` says."""
        self.refused += [one for one in refused if one.number not in self.jammed]
        return [one for one in refused if one.number in self.jammed]

    def deliver(self, *batches, topic=TOPIC_OF_CAR):
        return self.summarize(self.store(*batches, topic=topic))

    def summary(self, topic=TOPIC_OF_CAR):
        return summary_of(self.client, topic)

    def column(self, name):
        return {second - SECOND: item.get(name) for second, item in sorted(self.summary().items())}


@pytest.fixture
def stream():
    return Stream()


def counted(capsys):
    totals = defaultdict(int)
    for line in capsys.readouterr().out.splitlines():
        entry = json.loads(line)
        for metric in entry["_aws"]["CloudWatchMetrics"][0]["Metrics"]:
            totals[metric["Name"]] += entry[metric["Name"]]
    return dict(totals)


# --- the property: only what is stored matters ------------------------------------------------------


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


def clean(summary):
    return {second: dict(item) for second, item in summary.items()}


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(drives(), st.randoms(use_true_random=False), st.data())
def test_order_grouping_duplication_and_halving_of_the_records_change_nothing(drive, rng, data):
    expected = Stream()
    expected.client.put(ROBOTS, {"robot": {"S": "car"}, "speed_to_erpm_gain": {"N": "4614"}})
    expected.deliver(*drive)

    got = Stream(FakeDynamoDB(page_items=data.draw(st.sampled_from([1, 2, 100]))))
    got.client.put(ROBOTS, {"robot": {"S": "car"}, "speed_to_erpm_gain": {"N": "4614"}})
    order = list(drive)
    rng.shuffle(order)
    seen = []
    while order:
        # The table runs ahead of its stream: some of what comes later may be stored already.
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

    assert clean(got.summary()) == clean(expected.summary())
    assert sum(item["n"] for item in got.summary().values()) == sum(len(b.times_us) for b in drive)
    assert_summary(expected.summary(), drive)


def assert_summary(summary, drive):
    """Against a computation that knows nothing of pages, events or neighbours."""
    drive = sorted(drive, key=lambda b: b.t_us)
    samples = defaultdict(list)
    for b in drive:
        for i, t_us in enumerate(b.times_us):
            samples[t_us // S].append({name: column[i] for name, column in b.columns.items()})
    assert summary.keys() == samples.keys()
    missing, nonfinite = defaultdict(int), defaultdict(int)
    for previous, b in zip([None, *drive], drive, strict=False):
        missing[b.t_us // S] += missing_before(previous, b)
        nonfinite[b.t_us // S] += b.nonfinite
    for second, rows in samples.items():
        item = summary[second]
        assert item["n"] == len(rows)
        assert item["batches"] == sum(any(t // S == second for t in b.times_us) for b in drive)
        assert item["missing_batches"] == missing[second]
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


@settings(max_examples=60, deadline=None)
@given(drives())
def test_a_batch_sent_in_two_halves_leaves_the_same_samples(drive):
    whole, halved = Stream(), Stream()
    whole.deliver(*drive)
    # The batches of a drive may overlap here, and two that start at once would be one item.
    taken = {b.t_us for b in drive}
    for b in drive:
        halves = split(b) if len(b.times_us) > 1 and split(b)[1].t_us not in taken else (b,)
        taken.add(halves[-1].t_us)
        halved.deliver(*halves)
    for second, item in whole.summary().items():
        other = halved.summary()[second]
        assert {k: v for k, v in other.items() if k.endswith(("_min", "_max")) or k == "n"} == {
            k: v for k, v in item.items() if k.endswith(("_min", "_max")) or k == "n"
        }


# --- one thing at a time ----------------------------------------------------------------------------


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
def test_a_late_batch_fills_the_gap_of_a_successor_however_far_away(stream, apart_s):
    stream.deliver(batch(T0, seq=0))
    # Three batches in the successor's second: all of it must be summarised again, not its start.
    last = [batch(T0 + 2 * apart_s * S + i * 300_000, 5, seq=2 + i) for i in range(3)]
    stream.deliver(*last)
    assert stream.column("missing_batches") == {0: 0, 2 * apart_s: 1}
    stream.deliver(batch(T0 + apart_s * S, seq=1))
    assert stream.column("missing_batches") == {0: 0, apart_s: 0, 2 * apart_s: 0}
    assert stream.column("n") == {0: 1, apart_s: 1, 2 * apart_s: 15}


def test_a_second_is_whole_whichever_of_its_batches_comes_last(stream):
    parts = [batch(T0 + i * 250_000, 12, seq=i) for i in range(4)]
    for order in ([0, 1, 2, 3], [3, 2, 1, 0], [1, 3, 0, 2]):
        other = Stream()
        for i in order:
            other.deliver(parts[i])
        assert other.column("n") == {0: 48}
        assert other.column("batches") == {0: 4}
        assert other.column("missing_batches") == {0: 0}


def test_one_sample_a_batch_as_in_the_thesis(stream):
    batches = [batch(T0 + i * 20_000, seq=i, speed=[i]) for i in range(150) if i != 70]
    for i in range(0, len(batches), 7):
        stream.deliver(*batches[i : i + 7])
    assert stream.column("n") == {0: 50, 1: 49, 2: 50}
    assert stream.column("batches") == {0: 50, 1: 49, 2: 50}
    assert stream.column("missing_batches") == {0: 0, 1: 1, 2: 0}
    assert stream.column("speed_last") == {0: 49, 1: 99, 2: 149}


def test_missing_batches_are_counted_once_in_the_metric(stream, capsys):
    """The seconds are written many times over; a batch that is missing is missing once."""
    for i in (0, 1, 5, 6, 7, 8, 9):
        stream.deliver(batch(T0 + i * 20_000, seq=i))
    assert counted(capsys) == {"BatchesSummarized": 7, "SamplesSummarized": 7, "BatchesMissing": 3}


def test_a_restart_begins_a_new_count(stream):
    stream.deliver(batch(T0, 10, seq=8), batch(T0 + S, 10, seq=9))
    stream.deliver(
        batch(T0 + 5 * S, 10, seq=0, boot="bbbbbbbb"), batch(T0 + 6 * S, 10, seq=1, boot="bbbbbbbb")
    )
    # The first eight were never stored; the restart itself lost nothing that can be told.
    assert stream.column("missing_batches") == {0: 8, 1: 0, 5: 0, 6: 0}
    stream.deliver(batch(T0 + 9 * S, 10, seq=2, boot="cccccccc"))
    assert stream.column("missing_batches")[9] == 0


@pytest.mark.parametrize("offset_us", [-1, 0, 1, -20_000, 20_000, 980_000])
def test_batches_at_the_boundary_of_a_second(stream, offset_us):
    b = batch(T0 + offset_us, 50)
    stream.deliver(b)
    per_second = defaultdict(int)
    for t_us in b.times_us:
        per_second[t_us // S - SECOND] += 1
    assert stream.column("n") == per_second


def test_batches_that_overlap_the_boundary_together(stream):
    """A car's clock was set back: several batches begin before the second in which all have samples."""
    drive = [batch(T0 - 600_000 + i * 100_000, 50, step_us=19_000, seq=i) for i in range(5)]
    stream.store(*drive)
    stream.deliver(batch(T0 + 900_000, 3, seq=5))
    assert stream.column("n") == {0: sum(t >= T0 for b in drive for t in b.times_us) + 3}
    assert stream.column("batches") == {0: 6}


def test_topics_and_robots_do_not_mix(stream):
    other = "dt/iort/other/vesc"
    records = stream.store(batch(T0, 3)) + stream.store(batch(T0, 5, seq=4), topic=other)
    stream.summarize(records)
    assert stream.column("n") == {0: 3}
    assert [item["n"] for item in stream.summary(other).values()] == [5]
    assert [item["missing_batches"] for item in stream.summary(other).values()] == [4]


def test_speed_and_power_from_the_vehicles_parameters(stream):
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


def test_a_summary_is_kept_as_long_as_the_batches_it_is_made_of(stream):
    """Its samples may be of years ago: a recorded drive with its own times, a car without a clock."""
    long_ago = 1_500_000_000
    stream.summarize(
        [
            stream.store_item(item_of(batch(long_ago * S, 2), expires_s=EXPIRES)),
            stream.store_item(item_of(batch(long_ago * S + 500_000, 2, seq=1), expires_s=EXPIRES + 7)),
        ]
    )
    assert stream.summary()[long_ago][EXPIRES_S] == EXPIRES + 7


def test_a_batch_that_was_stored_without_an_end_has_a_summary_without_one(stream):
    item = item_of(batch(T0))
    del item[EXPIRES_S]
    stream.summarize([stream.store_item(item)])
    assert EXPIRES_S not in stream.summary()[SECOND]


def test_a_jump_of_the_clock_does_not_read_the_years_between(stream):
    between = [batch(T0 - day * 86_400 * S - 7 * S, seq=day) for day in range(1, 200)]
    stream.store(*between)
    stream.client.calls.clear()
    stream.deliver(batch(0, 10, seq=300), batch(T0, 10, seq=301))
    assert stream.client.calls["query"] < 15
    # The batch that now has a predecessor in 1970 is summarised again, and nothing between.
    assert stream.summary().keys() == {0, between[-1].t_us // S, SECOND}


# --- records that are wrong -------------------------------------------------------------------------


def poison(**changes):
    """An item that looks like a batch; a value of None leaves the attribute out."""
    envelope = json.loads(contract.encode(batch(T0 + 10 * S + 1, 3, seq=7))) | changes
    return item_of_message(json.dumps({k: v for k, v in envelope.items() if v is not None}).encode())


bomb = base64.b64encode(zlib.compress(b" " * (contract.MAX_COLUMNS_BYTES + 2))).decode()
POISON = {
    "not base64": poison(samples="%%%"),
    "not zlib": poison(samples="AAAA"),
    "not JSON": poison(samples=base64.b64encode(zlib.compress(b"{")).decode()),
    "inflates without end": poison(samples=bomb),
    "no samples": poison(samples=None),
    "other version": poison(v=2),
    "no version": poison(v=None),
    "other codec": poison(codec="cbor"),
    "wrong count": poison(n=4),
    "wrong boot": poison(boot="car"),
    "no seq": poison(seq=None),
    "text for seq": poison(seq="7"),
    "fraction for seq": {**poison(), "seq": {"N": "7.5"}},
    "huge seq": {**poison(), "seq": {"N": "1E+125"}},
    "binary samples": {**poison(), "samples": {"B": b"AAAA"}},
    "map for boot": {**poison(), "boot": {"M": {}}},
    "other topic": {**poison(), "topic": {"S": "dt/iort/car"}},
    "topic of no robot": {**poison(), "topic": {"S": "dt/iort/c r/vesc"}},
    "topic of the live lane": {**poison(), "topic": {"S": "live/iort/car/vesc"}},
    "in the name of another": {**poison(), "robot": {"S": "other"}},
    "before 1970": {**poison(), "t": {"N": "-1"}},
    "years ahead": {**poison(), "t": {"N": str(T0 + 2 * contract.MAX_AHEAD_US)}},
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
    # The queue before the quarantine does not take it: it stays in the stream, and comes again.
    before = clean(stream.summary())
    stream.jammed = {number}
    assert stream.summarize([bad, third]) == {"batchItemFailures": [{"itemIdentifier": number}]}
    assert clean(stream.summary()) == before


def test_a_replay_says_what_is_refused_and_puts_nothing_into_quarantine_again(stream):
    good, bad = stream.store(batch(T0, 5)), stream.store_item(POISON["other version"])
    event = {"replay": True, "Records": [*good, bad]}
    answer = process(event, stream.tables, stream.refuse)
    assert answer == {"batchItemFailures": [{"itemIdentifier": bad["dynamodb"]["SequenceNumber"]}]}
    assert stream.refused == []
    assert stream.column("n") == {0: 5}


def test_a_poison_neighbour_hides_no_batch_from_the_count(stream):
    stream.deliver(batch(T0, seq=5))
    for i in range(3):
        stream.summarize([stream.store_item({**poison(v=9), "t": {"N": str(T0 + (20 + i) * S)}})])
    stream.deliver(batch(T0 + 40 * S, seq=8))
    # 6 and 7 are missing; that they may be among the poison ones, nobody can say.
    assert stream.column("missing_batches") == {0: 5, 40: 2}


def test_the_newest_batch_of_a_driving_car_takes_one_query(stream):
    stream.client.page_items = 100
    stream.deliver(batch(T0, seq=0))
    stream.client.calls.clear()
    stream.deliver(batch(T0 + S, seq=1))
    assert (stream.client.calls["query"], stream.client.calls["batch_write_item"]) == (1, 1)


def test_a_hail_of_poison_bounds_what_is_read(stream):
    for i in range(200):
        stream.store_item({**poison(v=9), "t": {"N": str(T0 + i * S)}})
    stream.client.calls.clear()
    stream.deliver(batch(T0 + 500 * S, seq=1))
    assert stream.client.calls["query"] <= 15
    assert stream.column("n") == {500: 1}


def test_removals_are_passed_over(stream, capsys):
    stream.deliver(batch(T0, 5))
    before = clean(stream.summary())
    capsys.readouterr()
    item = item_of(batch(T0, 5))
    assert stream.summarize([record_of(item, 9, "REMOVE")]) == {"batchItemFailures": []}
    assert clean(stream.summary()) == before
    assert counted(capsys) == {}


def test_an_empty_event_is_nothing(stream):
    assert stream.summarize([]) == {"batchItemFailures": []}
    assert stream.client.calls == {}


def test_a_table_that_takes_nothing_fails_the_event_so_that_it_comes_again(monkeypatch):
    monkeypatch.setattr(tables_module.time, "sleep", lambda _: None)
    stream = Stream(FakeDynamoDB(unprocessed=10**9))
    with pytest.raises(TableError):
        stream.deliver(*(batch(T0 + i * S, seq=i) for i in range(20)))


def test_a_vehicle_whose_parameters_are_wrong_stops_nothing(stream, caplog):
    stream.client.put(ROBOTS, {"robot": {"S": "car"}, "speed_to_erpm_gain": {"S": "fast"}})
    stream.deliver(batch(T0, 2, speed=[1, 2]))
    assert stream.column("speed_max") == {0: 2}
    assert "car" in caplog.text


# --- against moto, and a drive of a real car --------------------------------------------------------


def test_the_handler_against_the_tables_of_the_template(dynamodb, monkeypatch, capsys):
    for name, table in NAMES.items():
        monkeypatch.setenv(f"{name.upper()}_TABLE", table)
    monkeypatch.setenv("REJECTED_QUEUE", "https://sqs.example/rejected")
    monkeypatch.setenv("ROBOT_METRICS", "false")
    dynamodb.put_item(TableName=ROBOTS, Item={"robot": {"S": "car"}, "speed_to_erpm_gain": {"N": "4614"}})
    stream = Stream(dynamodb)
    drive = [
        batch(T0 + i * S, 50, seq=i, speed=[4614 * i] * 50, text=["a"] * 50) for i in range(40) if i != 7
    ]
    order = list(drive)
    random.Random(1).shuffle(order)
    summarize._tables.cache_clear()
    summarize._refusals.cache_clear()
    try:
        for start in range(0, len(order), 13):
            records = stream.store(*order[start : start + 13])
            assert summarize.handler({"Records": records}, None) == {"batchItemFailures": []}
    finally:
        summarize._tables.cache_clear()
        summarize._refusals.cache_clear()
    items = [contract.flat_second(plain(item)) for item in dynamodb.scan(TableName=SUMMARY)["Items"]]
    assert sum(item["n"] for item in items) == 39 * 50
    by_second = {int(item["second"]) - SECOND: item for item in items}
    assert {s for s, item in by_second.items() if item["missing_batches"]} == {8}
    assert all(item["speed_mps_mean"] == second for second, item in by_second.items())
    assert counted(capsys)["SamplesSummarized"] == 39 * 50
    # The same through the fake: what the property tests run on behaves like the real one.
    fake = Stream()
    fake.client.put(ROBOTS, {"robot": {"S": "car"}, "speed_to_erpm_gain": {"N": "4614"}})
    fake.deliver(*drive)
    assert {int(item["second"]): item for item in items} == fake.summary()


def drive_of(path):
    """The VESC samples of a bag: time and flat fields."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    with AnyReader([path], default_typestore=store) as reader:
        for connection, stamp_ns, raw in reader.messages():
            if connection.msgtype.endswith("VescStateStamped"):
                state = reader.deserialize(raw, connection.msgtype).state
                sample = {name: getattr(state, name, None) for name in contract.VESC_FIELDS}
                yield stamp_ns // 1000, {k: v for k, v in sample.items() if v is not None}


def test_a_drive_of_a_real_car(stream):
    import numpy as np

    samples = list(drive_of(recording("f1tenth-motor-servo.bag")))
    assert len(samples) == 2244
    times = np.array([t_us for t_us, _ in samples])
    names = list(samples[0][1])
    values = {name: np.array([sample[name] for _, sample in samples], dtype=float) for name in names}
    assert len(names) == 13
    gain = 4614.0
    stream.client.put(ROBOTS, {"robot": {"S": "car"}, "speed_to_erpm_gain": {"N": "4614"}})
    seconds = sorted(set((times // S).tolist()))
    batches = []
    for seq, second in enumerate(seconds):
        (inside,) = np.nonzero(times // S == second)
        columns = {name: [samples[i][1][name] for i in inside] for name in names}
        batches.append(Batch("aaaaaaaa", seq, times[inside].tolist(), columns))
    random.Random(2).shuffle(batches)
    for b in batches:
        stream.deliver(b)

    summary = stream.summary()
    assert sum(item["n"] for item in summary.values()) == 2244
    assert sum(item["missing_batches"] for item in summary.values()) == 0
    values["speed_mps"] = values["speed"] / gain
    values["power_w"] = values["voltage_input"] * values["current_input"]
    for second, item in summary.items():
        inside = times // S == second
        assert item["n"] == int(inside.sum())
        for name, column in values.items():
            expected = column[inside]
            got = [float(item[f"{name}_{stat}"]) for stat in ("min", "mean", "max", "last")]
            want = [expected.min(), expected.mean(), expected.max(), expected[-1]]
            assert got == pytest.approx(want, rel=1e-8, abs=1e-9), (second, name)
    assert sorted(summary) == seconds
