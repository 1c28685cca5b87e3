"""Lambda 2: the content of a second's summary, one property a test."""

from __future__ import annotations

import json
from collections import defaultdict
from decimal import Decimal

import pytest

from functions.shared.summary import process
from iort_contract.tables import EXPIRES_S, RECEIVED_MS
from testkit.dynamodb import EXPIRES, ROBOTS, item_of, record_of
from tests.unit.functions.summary.summarizing import SECOND, T0, S, Stream, batch, clean, counted


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


def test_a_second_is_complete_with_its_batches_in_any_order(stream):
    parts = [batch(T0 + i * 250_000, 12, seq=i) for i in range(4)]
    for order in ([0, 1, 2, 3], [3, 2, 1, 0], [1, 3, 0, 2]):
        other = Stream()
        for i in order:
            other.deliver(parts[i])
        assert other.column("n") == {0: 48}
        assert other.column("batches") == {0: 4}
        assert other.column("missing_batches") == {0: 0}


def test_batches_of_one_sample_as_in_the_thesis_are_summarised(stream):
    batches = [batch(T0 + i * 20_000, seq=i, speed=[i]) for i in range(150) if i != 70]
    for i in range(0, len(batches), 7):
        stream.deliver(*batches[i : i + 7])
    assert stream.column("n") == {0: 50, 1: 49, 2: 50}
    assert stream.column("batches") == {0: 50, 1: 49, 2: 50}
    assert stream.column("missing_batches") == {0: 0, 1: 1, 2: 0}
    assert stream.column("speed_last") == {0: 49, 1: 99, 2: 149}


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


def test_several_batches_across_one_boundary_all_count(stream):
    """A car's clock was set back: several batches begin in the second before."""
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


def test_a_batch_without_expiry_has_a_summary_without_expiry(stream):
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


def test_an_empty_event_succeeds(stream):
    assert stream.summarize([]) == {"batchItemFailures": []}
    assert stream.client.calls == {}


def interleaved(seconds, behind_s=2):
    """Two publishers of one stream; the clock of one is behind: batches in the order in which
    the agent closes and numbers them."""
    batches = []
    for i in range(seconds):
        for start_s in (i, i - behind_s):
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
