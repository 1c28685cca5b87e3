"""Lambda 2 under the stream's mapping: the summary is right and no record is lost after any fault.

`local.emulator.fixes.stream_model` follows AWS' pages. Hypothesis makes histories of poison, throttled
tables, time-outs, lost acknowledgements and repeated batches, and runs the real handler on them.
"""

from __future__ import annotations

from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from functions.shared import tables as tables_module
from functions.shared.summary import process
from iort_contract.dynamodb import TableError
from iort_contract.messages.batch import Batch
from local.emulator.fixes.stream_model import Answer, Condition, Settings, Shard, Stream
from testkit.dynamodb import TELEMETRY, FakeDynamoDB, item_of, record_of, summary_of, tables
from tests.examples import examples

S = 1_000_000
T0 = 1_700_000_000 * S
DEPLOYED = Settings(
    batch_size=500,
    window_s=2,
    bisect=True,
    max_retries=5,
    max_age_s=6 * 3600,
    report_failures=True,
    parallel=1,
)


def record(n, *, at_s=0.0, topic="dt/iort/car/vesc"):
    keys = {"topic": {"S": topic}, "batch": {"S": f"{n:016}-0badcafe-0"}}
    return {
        "dynamodb": {"Keys": keys, "SequenceNumber": f"{n:06}", "ApproximateCreationDateTime": at_s},
        "n": n,
    }


def numbers(records):
    return [one["n"] for one in records]


def failed(*which):
    return Answer({"batchItemFailures": [{"itemIdentifier": n} for n in which]})


class Run:
    """A shard with records, a function that answers by record numbers, and the records that it received."""

    def __init__(self, given, count=8, **changes):
        self.shard = Shard(Settings(**{"batch_size": 8, **changes}))
        self.shard.put(record(n) for n in range(count))
        self.given, self.seen = given, []

    def all(self, now_s=0.0):
        for _ in range(200):
            for lane in self.shard.lanes:
                if batch := lane.batch(now_s):
                    self.seen.append(numbers(batch))
                    lane.answered(self.given(numbers(batch)))
            if not self.shard.size:
                return self
        raise AssertionError("the shard is blocked")

    @property
    def given_up(self):
        return [(one.condition, numbers(one.records)) for one in self.shard.discarded()]


# --- the mapping is as AWS documents it -----------------------------------------------------------------


@pytest.mark.parametrize("payload", [None, {}, "", {"batchItemFailures": []}, {"batchItemFailures": None}])
def test_an_empty_answer_is_complete_success(payload):
    run = Run(lambda _: Answer(payload), report_failures=True).all()
    assert run.seen == [list(range(8))]
    assert run.given_up == []


@pytest.mark.parametrize("identifier", ["", None, "unknown"])
def test_a_wrong_identifier_fails_the_whole_batch(identifier):
    run = Run(lambda _: failed(identifier), report_failures=True, max_retries=2).all()
    assert run.seen == [list(range(8))] * 3
    assert run.given_up == [(Condition.RETRIES, list(range(8)))]


def test_a_misspelt_identifier_fails_the_whole_batch():
    run = Run(
        lambda _: Answer({"batchItemFailures": [{"id": "000003"}]}), report_failures=True, max_retries=0
    ).all()
    assert run.given_up == [(Condition.RETRIES, list(range(8)))]


def test_the_lowest_number_is_the_checkpoint():
    answers = iter([failed("000006", "000003", "000005"), Answer()])
    run = Run(lambda _: next(answers), report_failures=True).all()
    assert run.seen == [list(range(8)), [3, 4, 5, 6, 7]]


def test_partial_answers_without_the_setting_are_successes():
    run = Run(lambda _: failed("000003")).all()
    assert run.seen == [list(range(8))]


def test_a_failing_batch_is_retried_up_to_the_limit_and_then_given_up():
    run = Run(lambda _: Answer(error=True), max_retries=3).all()
    assert run.seen == [list(range(8))] * 4
    assert run.given_up == [(Condition.RETRIES, list(range(8)))]


def test_bisecting_isolates_the_failing_record_in_order_without_counting_as_a_retry():
    run = Run(lambda seen: Answer(error=5 in seen), bisect=True, max_retries=0).all()
    assert run.seen == [[*range(8)], [0, 1, 2, 3], [4, 5, 6, 7], [4, 5], [4], [5], [6, 7]]
    assert run.given_up == [(Condition.RETRIES, [5])]


def test_an_error_is_bisected_also_with_partial_answers():
    run = Run(lambda seen: Answer(error=0 in seen), bisect=True, report_failures=True, max_retries=0).all()
    assert run.given_up == [(Condition.RETRIES, [0])]


def test_a_throttle_does_not_count_as_a_retry():
    answers = iter([Answer(throttled=True)] * 50 + [Answer()])
    run = Run(lambda _: next(answers), max_retries=0, bisect=True).all()
    assert len(run.seen) == 51
    assert run.given_up == []


def test_a_record_over_the_age_limit_is_given_up_without_a_try():
    shard = Shard(Settings(batch_size=8, max_age_s=60))
    shard.put([record(0, at_s=0), record(1, at_s=50), record(2, at_s=100)])
    (lane,) = shard.lanes
    assert numbers(lane.batch(100)) == [1, 2]
    (old,) = shard.discarded()
    assert (old.condition, numbers(old.records)) == (Condition.AGE, [0])
    # The same while it is retried.
    lane.answered(Answer(error=True))
    assert numbers(lane.batch(111)) == [2]
    assert [numbers(one.records) for one in shard.discarded()] == [[1]]


def window(**changes):
    shard = Shard(Settings(**{"batch_size": 3, "window_s": 2, **changes}))
    return shard, shard.lanes[0]


def test_records_are_gathered_until_the_window_ends():
    shard, lane = window()
    assert lane.batch(9) == []
    assert lane.due_s is None
    shard.put([record(0)])
    assert lane.batch(10) == []
    assert lane.due_s == 12
    shard.put([record(1)])
    assert lane.batch(11.9) == []
    assert numbers(lane.batch(12)) == [0, 1]
    assert lane.due_s is None


def test_a_full_batch_does_not_wait_for_the_window():
    shard, lane = window()
    shard.put(record(n) for n in range(4))
    assert numbers(lane.batch(10)) == [0, 1, 2]
    lane.answered(Answer())
    # The remaining record begins a new window.
    assert lane.batch(10) == []
    assert numbers(lane.batch(12)) == [3]


def test_the_payload_limit_ends_the_window():
    shard, lane = window(batch_size=100)
    shard.put({**record(n), "large": "x" * 2_500_000} for n in range(3))
    assert numbers(lane.batch(10)) == [0, 1]


def test_a_retry_does_not_wait_for_the_window():
    shard, lane = window(bisect=True)
    shard.put(record(n) for n in range(3))
    assert numbers(lane.batch(10)) == [0, 1, 2]
    lane.answered(Answer(error=True))
    assert numbers(lane.batch(10)) == [0]


def test_a_record_over_the_age_limit_begins_no_window():
    shard, lane = window(max_age_s=60)
    shard.put([record(0, at_s=0)])
    assert lane.batch(59) == []
    assert lane.batch(61) == []
    assert lane.due_s is None
    shard.put([record(1, at_s=61)])
    assert lane.batch(61.5) == []
    assert numbers(lane.batch(63.5)) == [1]


def test_an_event_has_at_most_6_mb():
    shard = Shard(Settings(batch_size=100))
    shard.put([{**record(n), "padding": "x" * 2_000_000} for n in range(5)])
    (lane,) = shard.lanes
    seen = []
    while batch := lane.batch(0):
        seen.append(numbers(batch))
        lane.answered(Answer())
    assert seen == [[0, 1, 2], [3, 4]]


def test_concurrent_batches_keep_only_the_order_of_an_item():
    shard = Shard(Settings(batch_size=2, parallel=4))
    shard.put(record(n % 3) for n in range(12))
    for lane in shard.lanes:
        seen = []
        while batch := lane.batch(0):
            seen += numbers(batch)
            lane.answered(Answer())
        assert Counter(seen) == dict.fromkeys(set(seen), 4)


def test_shards_keep_the_order_of_a_partition_and_hold_up_no_other():
    stream = Stream(Settings(batch_size=4), "topic", shards=4)
    stream.put(record(n, topic=f"car{n % 9}") for n in range(90))
    blocked = max(stream.lanes, key=lambda lane: lane.size)
    seen = []
    for lane in stream.lanes:
        while lane is not blocked and (batch := lane.batch(0)):
            seen += numbers(batch)
            lane.answered(Answer())
    assert len({n % 9 for n in seen}) > 1
    assert stream.size == 90 - len(seen) == blocked.size
    while batch := blocked.batch(0):
        seen += numbers(batch)
        blocked.answered(Answer())
    for car in range(9):
        assert [n for n in seen if n % 9 == car] == list(range(car, 90, 9))


# --- Lambda 2 in it -------------------------------------------------------------------------------------


class Crash(BaseException):
    """The handler's process ended: by a time-out, or by an uncaught fault."""


class Faulty(FakeDynamoDB):
    """A fake DynamoDB that throttles or ends the handler at chosen calls, before or after the write."""

    def __init__(self, faults):
        super().__init__(page_items=3)
        self.faults = faults

    def _fault(self):
        return next(self.faults, None)

    def batch_write_item(self, **request):
        fault = self._fault()
        if fault == "throttled":
            raise TableError("throttled")
        if fault == "killed before":
            raise Crash
        answer = super().batch_write_item(**request)
        if fault == "killed after":
            raise Crash
        return answer


POISON = ("undecodable", "fatal")


@st.composite
def histories(draw):
    """Numbered batches of two robots, some of them poison, with the faults of each call."""
    kinds = draw(
        st.lists(
            st.tuples(st.sampled_from(["car", "bus"]), st.sampled_from(["good"] * 5 + list(POISON))),
            min_size=1,
            max_size=12,
        )
    )
    faults = draw(
        st.lists(st.sampled_from([None, None, "throttled", "killed before", "killed after"]), max_size=12)
    )
    jams = draw(st.lists(st.booleans(), max_size=6))
    return kinds, faults, jams


@examples(150)
@given(
    histories(),
    st.integers(1, 6),
    st.booleans(),
    st.sampled_from([1, 1, 3]),
    st.randoms(use_true_random=False),
)
def test_the_summary_is_right_and_every_poison_record_is_kept(history, size, halve, parallel, rng):
    kinds, faults, jams = history
    client, expected = Faulty(iter(faults)), FakeDynamoDB()
    shard = Shard(
        Settings(
            batch_size=size,
            bisect=True,
            # As many retries as faults, so that only poison is given up.
            max_retries=len(faults) + len(jams) + 1,
            report_failures=True,
            parallel=parallel,
            halve_at_checkpoint=halve,
        )
    )
    poison, fatal, records = set(), set(), []
    for n, (robot, kind) in enumerate(kinds):
        # Two batches a second: a second has several records, often from different events.
        topic, start_us = f"dt/iort/{robot}/vesc", T0 + n * 400_000
        item = item_of(Batch("aaaaaaaa", n, [start_us, start_us + 20_000], {"speed": [n, n]}), topic)
        if kind == "undecodable":
            item = {**item, "samples": {"S": "AAAA"}}
        client.put(TELEMETRY, item)
        expected.put(TELEMETRY, item)
        one = record_of(item, n)
        records.append(one)
        number = one["dynamodb"]["SequenceNumber"]
        if kind == "undecodable":
            poison.add(number)
        elif kind == "fatal":
            fatal.add(number)
    quarantined, jam = set(), iter(jams)

    def refuse(refused):
        """A fake dead-letter queue that sometimes takes no message."""
        if refused and next(jam, False):
            return list(refused)
        quarantined.update(one.number for one in refused)
        return []

    shard.put(records)
    given_up = set()
    for _ in range(2_000):
        lanes = [lane for lane in shard.lanes if lane.batch(0)]
        if not lanes:
            break
        lane = rng.choice(lanes)
        batch = lane.batch(0)
        lane.answered(invoke(batch, client, refuse, fatal))
        if rng.random() < 0.2:
            # An acknowledgement was lost: the same records are delivered again after later ones.
            invoke(batch, client, refuse, fatal)
        given_up |= {one["dynamodb"]["SequenceNumber"] for d in shard.discarded() for one in d.records}
    assert not shard.size, "the shard is blocked"

    assert quarantined == poison
    # A record that ends the handler goes to the failure destination alone.
    assert given_up == fatal
    whole = tables(expected)
    process({"Records": [r for r in records if r["dynamodb"]["SequenceNumber"] not in fatal]}, whole, list)
    for robot in ("car", "bus"):
        topic = f"dt/iort/{robot}/vesc"
        got, want = summary_of(client, topic), summary_of(expected, topic)
        # The record that ended Lambda 2 is stored, so it counts in the summary of its second's neighbours.
        assert got == want


def invoke(batch, client, refuse, fatal):
    if any(one["dynamodb"]["SequenceNumber"] in fatal for one in batch):
        return Answer(error=True)
    try:
        return Answer(process({"Records": batch}, tables(client), refuse))
    except (TableError, Crash):
        return Answer(error=True)


def test_batches_are_given_up_with_their_stream_position_after_long_throttling(monkeypatch):
    monkeypatch.setattr(tables_module.time, "sleep", lambda _: None)
    client = FakeDynamoDB(unprocessed=10**9)
    shard, topic = Shard(DEPLOYED), "dt/iort/car/vesc"
    items = [item_of(Batch("aaaaaaaa", n, [T0 + n * S], {"a": [n]}), topic) for n in range(4)]
    for item in items:
        client.put(TELEMETRY, item)
    shard.put(record_of(item, n) for n, item in enumerate(items))
    (lane,) = shard.lanes
    assert lane.batch(0) == []
    while batch := lane.batch(DEPLOYED.window_s):
        lane.answered(invoke(batch, client, list, set()))
    given_up = [one["dynamodb"]["SequenceNumber"] for d in shard.discarded() for one in d.records]
    assert not shard.size
    # A single record is written in the end (the fake takes the first of every call).
    assert set(given_up) <= {record_of(item, n)["dynamodb"]["SequenceNumber"] for n, item in enumerate(items)}
    replayed = FakeDynamoDB()
    replayed.items = client.items
    process(
        {"replay": True, "Records": [record_of(item, n) for n, item in enumerate(items)]},
        tables(replayed),
        list,
    )
    assert sorted(summary_of(replayed)) == [T0 // S + n for n in range(4)]


def test_concurrent_batches_of_a_robot_could_leave_an_outdated_summary():
    """ParallelizationFactor must be 1: a larger one keeps the order of an item, but not of a topic."""
    client, topic = FakeDynamoDB(), "dt/iort/car/vesc"
    first, second = (item_of(Batch("aaaaaaaa", n, [T0 + n * 400_000], {"a": [n]}), topic) for n in range(2))
    client.put(TELEMETRY, first)

    class Slow(FakeDynamoDB):
        """In the first invocation, between reading and writing, the second one runs completely."""

        items = client.items

        def __init__(self):
            super().__init__()
            self.items = client.items

        def batch_write_item(self, **request):
            client.put(TELEMETRY, second)
            process({"Records": [record_of(second, 2)]}, tables(client), list)
            return super().batch_write_item(**request)

    process({"Records": [record_of(first, 1)]}, tables(Slow()), list)
    assert [item["n"] for item in summary_of(client).values()] == [1]
    # In sequence, as a mapping with one batch at a time runs them:
    process({"Records": [record_of(second, 2)]}, tables(client), list)
    assert [item["n"] for item in summary_of(client).values()] == [2]
