"""The audit's word about a range: complete, incomplete or unknown, and why."""

from __future__ import annotations

import time

import pytest

from iort_contract.catalog.streams import ACCOUNT_STREAM
from iort_contract.messages.account import SourceAccount, StreamAccount
from iort_contract.messages.batch import Batch, RunEnd
from iort_contract.topics import RECORD, build_topic
from iort_station.operations.verdict import verdict
from testkit.dynamodb import TELEMETRY, item_of
from tests.unit.station.data.test_queries import START, TOPIC, cloud_of

S = 1_000_000
ACCOUNTS = build_topic(RECORD, "car", ACCOUNT_STREAM)


def run(boot="0badcafe", start=START, n=10, *, without=(), previous=None):
    """A batch a second, of two samples."""
    return [
        Batch(boot, seq, [start + seq * S, start + seq * S + 1], {"speed": [1, 2]}, 0, None, previous)
        for seq in range(n)
        if seq not in without
    ]


def report(
    boot="0badcafe", at=START + 10 * S, *, n=10, seq=0, ended=True, received_ms=None, refused=0, lost=None
):
    """A run's account of its stream, and of a source that lost something."""
    own = StreamAccount("vesc", 2 * n + refused, 2 * n, refused, 0, 0, n, ended=ended, durable=True).sample()
    samples = [own, *([SourceAccount("ros", lost).sample()] if lost else [])]
    names = dict.fromkeys(name for sample in samples for name in sample)
    columns = {name: [sample.get(name) for sample in samples] for name in names}
    item = item_of(Batch(boot, seq, [at + i for i in range(len(samples))], columns), ACCOUNTS)
    return item | ({"received_ms": {"N": str(received_ms)}} if received_ms else {})


def word(batches, reports, start=None, end=None, **more):
    cloud = cloud_of(*batches)
    for item in reports:
        cloud.table.put(TELEMETRY, item)
    found = verdict(cloud, "car", "vesc", start, end, **more)
    assert bool(found.why) == (found.word != "complete")
    return found


def test_a_run_that_ended_in_good_order_is_complete_and_so_is_each_part_of_it():
    for start, end in [
        (None, None),
        (START, START + 10 * S),
        (START + 2 * S, START + 5 * S),
        (None, START + 3 * S),
    ]:
        found = word(run(), [report()], start, end)
        assert found.word == "complete", (start, end, found.why)
    assert word(run(), [report()], START + 2 * S, START + 5 * S).batches == 3


@pytest.mark.parametrize(
    ("start_s", "end_s", "expected"),
    [
        (3, 6, "incomplete"),
        (0, 9, "incomplete"),
        (4.1, 4.2, "incomplete"),
        (0, 2, "complete"),
        (7, 9, "complete"),
    ],
)
def test_a_gap_counts_where_it_may_have_been(start_s, end_s, expected):
    """Also where the range has no batch at all, since its neighbours tell the numbers."""
    start, end = (START + round(each * S) for each in (start_s, end_s))
    found = word(run(without={4}), [report()], start, end)
    assert (found.word, found.missing) == (expected, int(expected == "incomplete"))


def test_a_range_without_samples_between_two_numbers_is_complete():
    quiet = [*run(n=2), Batch("0badcafe", 2, [START + 60 * S], {"speed": [1]})]
    assert word(quiet, [report(n=3, at=START + 61 * S)], START + 20 * S, START + 30 * S).word == "complete"


def test_nothing_stored_is_unknown():
    assert word([], []).why == ("nothing of car vesc is stored",)


@pytest.fixture
def now_ms():
    """When the test runs: only a run that was heard of lately goes on."""
    return time.time_ns() // 1_000_000


def test_a_run_that_goes_on_is_unknown_at_its_end_alone(now_ms):
    now = now_ms * 1000
    batches, told = run(start=now - 20 * S), [report(at=now - 9 * S, ended=False, received_ms=now_ms)]
    found = word(batches, told, now - 20 * S, now)
    assert found.word == "unknown"
    assert "goes on: the robot may hold batches that come later" in found.why[0]
    assert word(batches, told, now - 20 * S, now - 15 * S).word == "complete"


def test_what_a_killed_run_held_is_unknown_and_what_it_had_counted_is_missing():
    killed = [report(ended=False, received_ms=1)]
    found = word(run(), killed)
    assert found.word == "unknown"
    assert "did not end properly" in found.why[0]
    found = word(run(n=7), killed)
    assert (found.word, found.missing) == ("incomplete", 3)
    assert found.why[0] == "batches 7 to 9 of run 0badcafe are not stored"


def test_without_an_account_nobody_knows_what_followed():
    assert word(run(), []).why == (
        "run 0badcafe has no account of vesc: what followed its last batch is not known",
    )
    assert word(run(), [], START, START + 5 * S).word == "complete"


def test_numbers_before_the_first_stored_one_are_unknown():
    found = word(run(without={0, 1}), [report()])
    assert found.why == ("the first stored batch is number 2 of its run: what was before is expired or lost",)
    assert word(run(without={0, 1}), [report()], START + 4 * S).word == "complete"


def test_runs_before_the_first_stored_one_are_unknown():
    batches = run("1badcafe", previous=(RunEnd("0badcafe", 11),))
    for start, expected in ((None, "unknown"), (START - 60 * S, "unknown"), (START, "complete")):
        found = word(batches, [report("1badcafe")], start)
        assert found.word == expected
    assert word(batches, [report("1badcafe")], START - 60 * S).why == (
        "the first stored run names runs before it: what was before is expired or lost",
    )


def test_losses_that_an_agent_reports():
    found = word(run(), [report(lost={"/tf.malformed": 3})])
    assert found.word == "unknown"
    assert found.why[0].endswith("did not record all of ros, at times that are not known: 3 /tf.malformed")
    found = word(run(), [report(refused=4)])
    assert (found.word, found.why[0].partition(": ")[2]) == (
        "incomplete",
        "4 samples refused by the agent: no message can hold them",
    )


def test_the_end_that_a_later_run_names_is_missing_before_it():
    later = run("1badcafe", START + 100 * S, 3, previous=(RunEnd("0badcafe", 11),))
    told = [report(n=12, at=START + 12 * S), report("1badcafe", START + 104 * S, n=3)]
    found = word([*run(), *later], told)
    assert (found.word, found.missing) == ("incomplete", 2)
    assert word([*run(), *later], told, START + 101 * S).word == "complete"


def test_a_run_of_which_nothing_is_stored_is_missing_where_its_reports_are():
    """Also if no later run names it, and if it is the only one."""
    lost = report("1badcafe", START + 200 * S)
    last = run("2badcafe", START + 390 * S)
    for batches, told in (
        (run(), [report(), lost]),
        ([*run(), *last], [report(), lost, report("2badcafe", START + 400 * S)]),
        ([], [lost]),
    ):
        for start, end in ((None, None), (START + 150 * S, START + 250 * S)):
            found = word(batches, told, start, end)
            assert (found.word, found.missing) == ("incomplete", 10)
            assert "none of the 10 batches of run 1badcafe is stored" in found.why
        if batches:
            assert word(batches, told, START, START + 10 * S).word == "complete"


def test_a_run_whose_batches_wait_in_the_car_is_unknown(now_ms):
    now = now_ms * 1000
    told = [report(), report("1badcafe", now - 9 * S, ended=False, received_ms=now_ms)]
    found = word(run(), told, now - 20 * S, now)
    assert (found.word, found.missing) == ("unknown", 0)
    assert found.why == ("run 1badcafe goes on: the robot may hold its 10 batches",)


def test_a_report_of_a_run_before_the_range_says_nothing_about_it():
    # The short run between is the range's neighbour; the report before it is read, its batches are not.
    between = run("1badcafe", START + 13 * S, 1)
    later = run("2badcafe", START + 60 * S)
    told = [
        report(at=START + 12 * S),
        report("1badcafe", START + 14 * S, n=1),
        report("2badcafe", START + 70 * S),
    ]
    assert word([*run(), *between, *later], told, START + 30 * S, START + 65 * S).word == "complete"


def test_what_followed_a_run_is_missing_although_the_clock_was_set_back_after_it():
    told = [report(n=15, at=START + 15 * S), report("1badcafe", START + 9 * S, n=3)]
    found = word([*run(), *run("1badcafe", START + 5 * S, 3)], told, START + 11 * S, START + 13 * S)
    assert (found.word, found.why) == ("incomplete", ("batches 10 to 14 of run 0badcafe are not stored",))


def test_a_run_beside_another_that_is_not_compared_is_unknown():
    # Its clock was set back, and its batches are before the range's neighbour.
    beside = run("1badcafe", START + 50 * S)
    told = [
        report(n=100, at=START + 100 * S),
        report("1badcafe", START + 61 * S, ended=False),
        report("1badcafe", START + 150 * S, n=90, seq=1),
    ]
    found = word([*run(n=100), *beside], told, START + 120 * S, START + 130 * S)
    assert (found.word, found.why) == (
        "unknown",
        ("run 1badcafe recorded at the same time as another, and is not compared",),
    )


def test_what_cannot_be_read_is_incomplete_here_and_as_a_reader_found_it():
    found = word(run(), [report()], refused=(2, "dt/iort/car/vesc at 10:00: truncated"))
    assert (found.word, found.why) == (
        "incomplete",
        ("2 stored items cannot be read; the first: dt/iort/car/vesc at 10:00: truncated",),
    )
    cloud = cloud_of(*run())
    cloud.table.put(TELEMETRY, report())
    damaged = item_of(run()[4]) | {"samples": {"S": "AAAA"}}
    cloud.table.put(TELEMETRY, damaged)
    assert verdict(cloud, "car", "vesc").word == "incomplete"
    assert damaged["topic"]["S"] == TOPIC


def test_more_batches_than_allowed_are_not_compared():
    found = word(run(), [report()], most=5)
    assert (found.word, found.why) == (
        "unknown",
        ("the range has more than 5 batches: `iort audit` reads any number",),
    )
