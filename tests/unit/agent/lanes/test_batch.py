"""Batches: every sample once and in order, whichever rule closes them."""

from __future__ import annotations

import math
import random
import struct
from operator import itemgetter
from typing import Any, Mapping

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iort_agent.lanes.streams import BatchEncoder, StreamCounts, _Open
from iort_contract.limits import MAX_BATCH_VALUES, MAX_MESSAGE_BYTES
from iort_contract.messages.batch import MAX_VALUES, Batch, RunEnd, decode_batch, messages_of
from iort_contract.ros.message import RosMessage, RosType
from testkit.agent import ManualClock, MemorySpool
from tests.examples import examples
from tests.unit.contract.ros.ros1_messages import text

T0 = 1_700_000_000_000_000
BOOT = "0123456789abcdef"


class Line:
    """An encoder and a spool in a row, as the agent wires them."""

    def __init__(self, spool: MemorySpool | None = None, *, batch_s: float = 1.0) -> None:
        self.clock = ManualClock(now_us=T0)
        self.spool = MemorySpool(max_bytes=2**40) if spool is None else spool
        self.encoder = BatchEncoder("vesc", boot=BOOT, batch_s=batch_s, spool=self.spool, clock=self.clock)

    @property
    def counts(self) -> StreamCounts:
        return self.encoder.counts()

    def messages(self) -> list[bytes]:
        out, after = [], 0
        while (entry := self.spool.next(after)) is not None:
            out.append(entry.payload)
            after = entry.id
        return out

    def batches(self) -> list[Batch]:
        return [decode_batch(payload) for payload in self.messages()]

    def samples(self) -> list[tuple[int, dict[str, Any]]]:
        return [
            (t_us, {name: column[i] for name, column in batch.columns.items()})
            for batch in self.batches()
            for i, t_us in enumerate(batch.times_us)
        ]


def random_bytes(noise: random.Random, size: int) -> bytes:
    return bytes(noise.choices(range(256), k=size))


fields = st.sampled_from([("speed",), ("speed", "duty_cycle"), ("mode",), ()])
number = st.one_of(st.integers(-1000, 1000), st.floats(-1e3, 1e3, width=16), st.none(), st.text(max_size=3))
# Steps between samples: mostly forward; sometimes none, or back by less or more than a second.
steps = st.one_of(st.integers(1, 400_000), st.integers(-999_999, 0), st.integers(-5_000_000, -1_000_000))
A = RosType("/a", "a_msgs/A", "1", "float64 speed")
B = RosType("/b", "a_msgs/B", "2", "string mode")


@st.composite
def drives(draw: Any) -> list[tuple[int, Mapping[str, Any], float]]:
    t_us, out = T0, []
    for step in draw(st.lists(steps, max_size=60)):
        t_us += step
        pause_s = draw(st.sampled_from([0.0, 0.0, 0.02, 2.0]))
        out.append((t_us, {name: draw(number) for name in draw(fields)}, pause_s))
    return out


@examples(300)
@given(drives(), st.sampled_from([0.0, 0.1, 0.5, 1.0]))
def test_every_sample_comes_out_once_and_as_it_was(
    drive: list[tuple[int, dict[str, Any], float]], batch_s: float
) -> None:
    line = Line(batch_s=batch_s)
    for t_us, values, pause_s in drive:
        line.encoder.add(t_us, values)
        line.clock.advance(pause_s)
        line.encoder.tick()
    line.encoder.flush()

    given = [(t_us, sorted(values.items(), key=repr)) for t_us, values, _ in drive]
    stored = [(t_us, sorted(values.items(), key=repr)) for t_us, values in line.samples()]
    # Of one time and one set of fields, they are in the order in which they came.
    for names in {tuple(name for name, _ in values) for _, values in given}:
        alike = [sample for sample in given if tuple(name for name, _ in sample[1]) == names]
        assert sorted(alike, key=itemgetter(0)) == sorted(
            (sample for sample in stored if tuple(name for name, _ in sample[1]) == names), key=itemgetter(0)
        )
    assert len(stored) == len(given)
    assert (line.counts.samples, line.counts.stored) == (len(drive), len(drive))
    assert line.counts.batches == len(line.batches())
    assert line.counts.refused == 0
    assert [batch.seq for batch in line.batches()] == list(range(line.counts.batches))
    for batch in line.batches():
        assert batch.times_us == sorted(batch.times_us)
        assert len({t // 1_000_000 for t in batch.times_us}) == 1, "a batch lies within one second"
        assert batch.times_us[-1] - batch.times_us[0] < (batch_s or 0.000_001) * 1_000_000


def test_a_batch_closes_with_the_second() -> None:
    line = Line()
    for i in range(100):
        line.encoder.add(T0 + i * 20_000, {"speed": i})
        line.clock.advance(0.02)
    assert [len(batch.times_us) for batch in line.batches()] == [50]
    line.encoder.flush()
    assert [len(batch.times_us) for batch in line.batches()] == [50, 50]


def test_one_sample_a_message_as_the_thesis() -> None:
    line = Line(batch_s=0)
    for i in range(5):
        line.encoder.add(T0 + i * 20_000, {"speed": i})
    assert [len(batch.times_us) for batch in line.batches()] == [1, 1, 1, 1, 1]


def test_a_silent_topic_closes_its_batch_by_the_clock() -> None:
    line = Line()
    line.encoder.add(T0, {"speed": 1})
    line.clock.advance(0.9)
    line.encoder.tick()
    assert line.batches() == []
    line.clock.advance(0.3)
    line.encoder.tick()
    assert len(line.batches()) == 1


@pytest.mark.parametrize("behind_us", [2_000_000, 2_500_000, 700_000])
def test_clocks_that_interleave_take_no_more_batches_than_they_would_alone(behind_us: int) -> None:
    """Two publishers at 50 Hz, one of which is behind: a batch a second each, and not one a sample."""
    line, period_us = Line(), 20_000
    for i in range(500):
        for t_us in (T0 + i * period_us, T0 + i * period_us - behind_us):
            line.encoder.add(t_us, {"i": i})
            line.clock.advance(period_us / 2e6)
            line.encoder.tick()
    line.encoder.flush()
    assert len(line.samples()) == 1000
    assert sum(t_us < T0 for t_us, _ in line.samples()) == behind_us // period_us
    # Ten seconds of each, and where they begin and end.
    assert len(line.batches()) <= 2 * 10 + 4
    for batch in line.batches():
        assert batch.times_us == sorted(batch.times_us)


def test_of_too_many_open_seconds_the_oldest_is_closed() -> None:
    line = Line()
    for second in range(20):
        line.encoder.add(T0 + second * 1_000_000, {"speed": second})
    assert [batch.t_us - T0 for batch in line.batches()] == [i * 1_000_000 for i in range(12)]
    line.encoder.flush()
    assert [values["speed"] for _, values in line.samples()] == list(range(20))


def test_before_1970_there_is_no_sample() -> None:
    line = Line()
    line.encoder.add(-1, {"speed": 1})
    line.encoder.add(0, {"speed": 2})
    line.encoder.flush()
    assert [values["speed"] for _, values in line.samples()] == [2]
    assert (line.counts.refused, line.counts.stored) == (1, 1)


def test_another_set_of_fields_is_another_message_and_not_another_second() -> None:
    """Two arms that take turns on one topic: two messages a second, however they take them."""
    line = Line()
    for i in range(50):
        line.encoder.add(T0 + 2 * i, {"a": i, "b": 2} if i % 2 else {"b": 3, "a": i})
        line.encoder.add(T0 + 2 * i + 1, {"a": None})
    line.encoder.flush()
    both, one = line.batches()
    assert dict(both.columns) == {"a": list(range(50)), "b": [2 if i % 2 else 3 for i in range(50)]}
    assert dict(one.columns) == {"a": [None] * 50}
    assert (both.seq, one.seq) == (0, 1)


def test_messages_of_two_types_and_plain_samples_are_a_message_each() -> None:
    line = Line()
    for i in range(3):
        line.encoder.add(T0 + i, RosMessage(struct.pack("<d", i / 2), A))
        line.encoder.add(T0 + i, RosMessage(text("on"), B))
        line.encoder.add(T0 + i, {"speed": 7})
        line.encoder.add(T0 + i, RosMessage(text("on"), B, beside={"note": "n"}))
    line.encoder.flush()
    assert [dict(batch.columns) for batch in line.batches()] == [
        {"speed": [0, 0.5, 1]},
        {"mode": ["on"] * 3},
        {"speed": [7] * 3},
        {"mode": ["on"] * 3, "note": ["n"] * 3},
    ]
    layouts = {kind.id: kind.layout for kind in (A, B)}
    found = [messages_of(payload, layouts)[1] for payload in line.messages()]
    assert [None if one is None else (one.type_id, list(one.raw)) for one in found] == [
        (A.id, [struct.pack("<d", i / 2) for i in range(3)]),
        (B.id, [text("on")] * 3),
        None,
        (B.id, [text("on")] * 3),
    ]
    assert line.counts.stored == line.counts.samples == 12


def test_a_message_that_its_type_does_not_fit_costs_nothing() -> None:
    line = Line()
    raws = [struct.pack("<d", 1.5), b"short", b"", struct.pack("<d", 2.5)]
    for i, raw in enumerate(raws):
        line.encoder.add(T0 + i, RosMessage(raw, A))
    line.encoder.flush()
    (payload,) = line.messages()
    beside, messages = messages_of(payload, {})
    assert messages is not None
    assert list(messages.raw) == raws
    assert beside.columns == {}
    assert decode_batch(payload).columns == {"speed": [1.5, None, None, 2.5]}
    assert line.counts.refused == 0


@pytest.mark.parametrize("size", [10, 1000, 40_000, 90_000])
def test_a_batch_of_messages_closes_near_the_limit_of_a_message(size: int) -> None:
    line, noise = Line(), random.Random(size)
    raws = [random_bytes(noise, size) for _ in range(300_000 // size)]
    for i, raw in enumerate(raws):
        line.encoder.add(T0 + i, RosMessage(raw, A))
    line.encoder.flush()
    assert all(len(payload) <= MAX_MESSAGE_BYTES for payload in line.messages())
    found = [messages_of(payload, {})[1] for payload in line.messages()]
    assert [raw for messages in found if messages is not None for raw in messages.raw] == raws
    assert line.counts.refused == 0
    # Not one a message, where they are small.
    assert len(line.messages()) <= max(len(raws), 1) if size > 10_000 else 8


def test_a_sample_that_nearly_fills_a_message_goes_without_the_runs_before() -> None:
    # As after sixteen restarts without a connection: 330 bytes of names.
    runs = tuple(RunEnd(f"{number:016x}", number) for number in range(16))

    class Restarted(MemorySpool):
        def previous(self, stream: str) -> tuple[RunEnd, ...]:
            return runs

    line, noise = Line(Restarted(max_bytes=2**40)), random.Random(1)
    for i, size in enumerate((10, (MAX_MESSAGE_BYTES - 500) * 3 // 4)):
        line.encoder.add(T0 + i * 1_000_000, RosMessage(random_bytes(noise, size), A))
    line.encoder.flush()
    found = [messages_of(payload, {}) for payload in line.messages()]
    assert [batch.previous for batch, _ in found] == [runs, ()]
    assert line.counts.refused == 0


def test_a_message_that_is_too_large_is_refused_alone() -> None:
    line, noise = Line(), random.Random(1)
    raws = [random_bytes(noise, 10), random_bytes(noise, 200_000), random_bytes(noise, 10)]
    for i, raw in enumerate(raws):
        line.encoder.add(T0 + i, RosMessage(raw, A))
    line.encoder.flush()
    found = [messages_of(payload, {})[1] for payload in line.messages()]
    assert [raw for messages in found if messages is not None for raw in messages.raw] == [raws[0], raws[2]]
    assert (line.counts.refused, line.counts.stored) == (1, 2)


def test_messages_stay_below_the_limit() -> None:
    line = Line()
    names = [f"f{i}" for i in range(400)]
    for i in range(200):
        # Doubles without a pattern, which no compression helps.
        line.encoder.add(T0 + i * 1000, {name: math.sin(i * 7919 + k) for k, name in enumerate(names)})
    line.encoder.flush()
    assert len(line.samples()) == 200
    assert all(len(message) <= MAX_MESSAGE_BYTES for message in line.messages())
    assert all(len(b.times_us) * 400 <= MAX_VALUES for b in line.batches())
    assert len(line.batches()) > 200 * 400 // MAX_VALUES, "some were split"


def test_what_holds_too_many_values_for_a_batch_is_halved() -> None:
    line = Line()
    fields = dict.fromkeys((f"f{i}" for i in range(300)), 0)
    # Nothing closes the batch before it is flushed: with so many fields, its values alone would.
    line.encoder._open[0, 0] = _Open(0.0, [(t_us, fields) for t_us in range(400)])
    line.encoder.flush()
    assert [t_us for t_us, _ in line.samples()] == list(range(400))
    assert [len(batch.times_us) for batch in line.batches()] == [100] * 4
    assert all(len(batch.times_us) * 300 <= MAX_BATCH_VALUES for batch in line.batches())
    assert [batch.seq for batch in line.batches()] == [0, 1, 2, 3]
    assert line.counts.refused == 0


@pytest.mark.parametrize(
    "bad",
    [b"bytes", [1, 2], {"a": 1}, object(), 2**70, "x" * 5000, "\ud800"],
    ids=["bytes", "list", "mapping", "object", "too big", "too long", "not Unicode"],
)
def test_a_bad_value_costs_only_its_sample(bad: Any) -> None:
    line = Line()
    for i in range(20):
        line.encoder.add(T0 + i, {"speed": bad if i == 13 else i})
    line.encoder.flush()
    assert [values["speed"] for _, values in line.samples()] == [i for i in range(20) if i != 13]
    assert (line.counts.samples, line.counts.refused) == (20, 1)
    assert [batch.seq for batch in line.batches()] == list(range(line.counts.batches))


def test_a_sample_that_fits_no_message_is_refused() -> None:
    line = Line()
    line.encoder.add(T0, {f"f{i}": math.sin(i) for i in range(513)})
    line.encoder.add(T0 + 1, {"not a field": 1})
    # Distinct characters, so that compression does not make them fit.
    text = "".join(chr(0x4E00 + i) for i in range(4000))
    line.encoder.add(T0 + 2, {f"f{i}": text[i:] + text[:i] for i in range(64)})
    line.encoder.add(2**60, {"speed": 1})
    line.encoder.add(T0 + 3, {"speed": 1})
    line.encoder.flush()
    assert [values for _, values in line.samples()][-1] == {"speed": 1}
    assert line.counts.refused + len(line.samples()) == 5
    assert line.counts.refused >= 3


def test_nan_and_infinity_are_nulled_and_counted() -> None:
    line = Line()
    line.encoder.add(T0, {"a": math.nan, "b": 1.5})
    line.encoder.add(T0 + 1, {"a": -math.inf, "b": math.inf})
    line.encoder.flush()
    assert [values for _, values in line.samples()] == [{"a": None, "b": 1.5}, {"a": None, "b": None}]
    assert line.counts.nulled == 3
    assert line.batches()[0].nonfinite == 3
