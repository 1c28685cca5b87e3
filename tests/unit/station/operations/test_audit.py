"""An audit reports batches that were lost, repeated, late or numbered anew."""

from __future__ import annotations

import random

from hypothesis import given
from hypothesis import strategies as st

from iort_contract.catalog.streams import AGENT_STREAM
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.messages.batch import Batch, BatchId
from iort_contract.tables import SAMPLES, SECOND, TOPIC
from iort_contract.topics import RECORD, build_topic
from iort_station.operations.audit import audit, delivery, last_figures
from testkit.dynamodb import SUMMARY, TELEMETRY, item_of, serialize
from tests.unit.station.data.test_queries import cloud_of

T_US = 1_750_000_000_000_000


def _item(seq, *, boot="0badcafe", n=50, late_ms=0, at=None, previous=None):
    t_us = T_US + int((seq if at is None else at) * 1_000_000)
    return {
        "batch": str(BatchId(t_us, boot, seq)),
        "n": str(n),
        "received_ms": t_us // 1000 + 1020 + late_ms,
        **({} if previous is None else {"previous": previous}),
    }


def _run(boot, seqs, *, at, previous=""):
    """Batches of a run, one a second from ``at`` on; the first one names the runs before."""
    return [_item(seq, boot=boot, at=at + seq, previous=previous if seq == 0 else None) for seq in seqs]


def test_a_whole_run_is_complete():
    found = audit("vesc", [_item(seq) for seq in range(10)])
    assert found.complete
    assert (found.runs[0].expected, found.runs[0].batches, found.runs[0].samples) == (10, 10, 500)
    assert (found.missing, found.before_first) == (0, 0)


def test_a_gap_is_named_with_its_neighbours():
    found = audit("vesc", [_item(seq) for seq in (0, 1, 4, 5)])
    assert not found.complete
    (gap,) = found.runs[0].missing
    assert (gap.first, gap.last) == (2, 3)
    assert (gap.after_us, gap.before_us) == (T_US + 1_000_000, T_US + 4_000_000)


def test_an_empty_stream_is_not_complete():
    assert not audit("vesc", []).complete


def test_numbers_before_the_first_batch_are_missing_only_on_request():
    items = [_item(seq) for seq in (7, 8)]
    assert audit("vesc", items).complete
    assert audit("vesc", items).before_first == 7
    found = audit("vesc", items, from_start=True)
    assert (found.missing, found.before_first) == (7, 0)


def test_the_missing_start_of_a_later_run_is_found():
    items = [_item(seq) for seq in range(5)] + [_item(seq, boot="deadbeef", at=10 + seq) for seq in range(3)]
    assert audit("vesc", items).complete
    found = audit("vesc", [item for item in items if not item["batch"].endswith("-deadbeef-0")])
    assert found.missing == 1


def test_each_run_numbers_from_0_and_names_the_one_before():
    items = _run("aaaaaaaa", range(3), at=0) + _run("bbbbbbbb", range(3), at=10, previous="aaaaaaaa-2")
    assert audit("vesc", items).complete
    assert audit("vesc", items, from_start=True).complete
    without = [item for item in items if not item["batch"].endswith("-aaaaaaaa-2")]
    (gap,) = audit("vesc", without).runs[0].missing
    assert (gap.first, gap.last, gap.after_us, gap.before_us) == (2, 2, T_US + 1_000_000, None)
    assert audit("vesc", without).runs[0].expected == 3


def test_the_missing_start_of_a_run_is_found_after_a_short_run():
    items = _run("aaaaaaaa", [0], at=0) + _run("bbbbbbbb", range(4), at=10, previous="aaaaaaaa-0")
    # Batches name the runs before until one has arrived, so the first stored batch names them.
    late = [*items[:1], {**items[3], "previous": "aaaaaaaa-0"}, items[4]]
    (gap,) = audit("vesc", late).runs[1].missing
    assert (gap.first, gap.last, gap.after_us, gap.before_us) == (0, 1, T_US, T_US + 12_000_000)


def test_a_run_without_stored_batches_is_found_by_later_runs():
    a, b = _run("aaaaaaaa", range(3), at=0), _run("bbbbbbbb", range(5), at=10, previous="aaaaaaaa-2")
    c = _run("cccccccc", range(2), at=20, previous="aaaaaaaa-2 bbbbbbbb-4")
    assert audit("vesc", [*a, *b, *c]).complete
    found = audit("vesc", [*a, *c])
    assert (found.lost_runs, found.missing, found.complete) == ((("bbbbbbbb", 5),), 5, False)
    # Batches before the first stored one may have expired or be out of the range.
    assert audit("vesc", c).complete
    assert audit("vesc", [*b, *c]).complete
    assert audit("vesc", c, from_start=True).lost_runs == (("aaaaaaaa", 3), ("bbbbbbbb", 5))
    z = _run("dddddddd", range(2), at=-10)
    assert audit("vesc", [*z, *b, *c]).lost_runs == (("aaaaaaaa", 3),)


def test_a_clock_set_back_between_runs_changes_nothing():
    before = [_item(seq) for seq in range(3)]
    after = [_item(seq, boot="deadbeef", at=seq - 1000, late_ms=2_000_000) for seq in range(3)]
    assert audit("vesc", after + before).complete


def test_lateness_is_relative_to_the_fastest_batch_of_the_run():
    items = [_item(seq, late_ms=-3_600_000 + (20_000 if seq == 2 else 0)) for seq in range(5)]
    (run,) = audit("vesc", items).runs
    assert (run.late, run.latest_ms) == (1, 20_000)


def test_a_number_stored_twice_is_counted_without_its_samples():
    (run,) = audit("vesc", [_item(0), _item(1), _item(1, at=1.5)]).runs
    assert (run.duplicated, run.batches, run.samples) == (1, 2, 100)


def test_an_invalid_batch_is_counted():
    wrong = [{"batch": "5"}, {**_item(1), "batch": "5-0badcafe-x"}, {**_item(2), "previous": "nobody"}]
    found = audit("vesc", [_item(0), *wrong])
    assert (found.refused, found.complete) == (3, False)


@given(st.sets(st.integers(0, 300), min_size=1), st.integers(0, 2**32))
def test_expected_is_stored_and_missing_in_any_order(seqs, seed):
    items = [_item(seq) for seq in seqs]
    random.Random(seed).shuffle(items)
    (run,) = audit("vesc", items).runs
    assert run.expected == run.last_seq - run.first_seq + 1
    missing = {seq for gap in run.missing for seq in range(gap.first, gap.last + 1)}
    assert missing == set(range(min(seqs), max(seqs) + 1)) - seqs


def test_the_agents_figures_come_from_its_newest_valid_batch():
    cloud, topic = cloud_of(), build_topic(RECORD, "car", AGENT_STREAM)
    cloud.table.put(TELEMETRY, item_of(Batch("0badcafe", 0, [T_US], {"backlog_batches": [3]}), topic))
    assert last_figures(cloud, "car") == {"backlog_batches": 3.0}
    invalid = item_of(Batch("0badcafe", 1, [T_US + 1], {"backlog_batches": [4]}), topic)
    cloud.table.put(TELEMETRY, {**invalid, "codec": {"S": "none"}})
    assert last_figures(cloud, "car") == {}


def test_what_another_run_has_stored_hides_no_loss_of_one():
    """An import has come while the car drove."""
    cloud = cloud_of(
        Batch("0badcafe", 0, [T_US], {"speed": [1]}),
        Batch("0badcafe", 1, [T_US + 1_500_000], {"speed": [2]}),
        Batch("deadbeef", 0, [T_US - 60_000_000], {"speed": [3]}),
    )
    topic = build_topic(RECORD, "car", VESC_STREAM)
    for second, samples in ((-60, 1), (0, 1), (1, 1), (90, 5)):
        row = {TOPIC: topic, SECOND: T_US // 1_000_000 + second, SAMPLES: samples}
        cloud.table.put(SUMMARY, {name: serialize(value) for name, value in row.items()})
    of_one, of_all = delivery(cloud, "car", VESC_STREAM, "0badcafe"), delivery(cloud, "car", VESC_STREAM)
    assert (of_one.samples_stored, of_one.samples_summarized) == (2, 2)
    assert (of_all.samples_stored, of_all.samples_summarized) == (3, 8)
    none = delivery(cloud, "car", VESC_STREAM, "feedbeef")
    assert (none.samples_stored, none.samples_summarized) == (0, 0)
