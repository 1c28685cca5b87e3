"""Batches: every sample once and in order, whichever rule closes them."""

from __future__ import annotations

import math
import operator
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import contract
from device.batch import MAX_VALUES, Batcher, StreamCounts
from device.clock import ManualClock
from device.pack import Packer
from device.spool import MemorySpool

T0 = 1_700_000_000_000_000
BOOT = "0123456789abcdef"


class Line:
    """A batcher, a packer and a spool in a row, as the agent wires them."""

    def __init__(self, *, batch_s: float = 1.0) -> None:
        self.clock = ManualClock(now_us=T0)
        self.counts = StreamCounts()
        self.spool = MemorySpool(max_bytes=2**40)
        self.packer = Packer(stream="vesc", boot=BOOT, spool=self.spool, counts=self.counts)
        self.batcher = Batcher(self.packer.store, batch_s=batch_s, clock=self.clock, counts=self.counts)

    def messages(self) -> list[bytes]:
        out, after = [], 0
        while (entry := self.spool.next(after)) is not None:
            out.append(entry.payload)
            after = entry.id
        return out

    def batches(self) -> list[contract.Batch]:
        return [contract.decode(payload) for payload in self.messages()]

    def samples(self) -> list[tuple[int, dict[str, Any]]]:
        return [
            (t_us, {name: column[i] for name, column in batch.columns.items()})
            for batch in self.batches()
            for i, t_us in enumerate(batch.times_us)
        ]


fields = st.sampled_from([("speed",), ("speed", "duty_cycle"), ("mode",), ()])
number = st.one_of(st.integers(-1000, 1000), st.floats(-1e3, 1e3, width=16), st.none(), st.text(max_size=3))
# Steps between samples: mostly forward; sometimes none, or back by less or more than a second.
steps = st.one_of(st.integers(1, 400_000), st.integers(-999_999, 0), st.integers(-5_000_000, -1_000_000))


@st.composite
def drives(draw: Any) -> list[tuple[int, dict[str, Any], float]]:
    t_us, out = T0, []
    for step in draw(st.lists(steps, max_size=60)):
        t_us += step
        pause_s = draw(st.sampled_from([0.0, 0.0, 0.02, 2.0]))
        out.append((t_us, {name: draw(number) for name in draw(fields)}, pause_s))
    return out


@settings(max_examples=300)
@given(drives(), st.sampled_from([0.0, 0.1, 0.5, 1.0]))
def test_every_sample_comes_out_once_and_in_order(
    drive: list[tuple[int, dict[str, Any], float]], batch_s: float
) -> None:
    line = Line(batch_s=batch_s)
    for t_us, values, pause_s in drive:
        line.batcher.add(t_us, values)
        line.clock.advance(pause_s)
        line.batcher.tick()
    line.batcher.flush()

    assert [values for _, values in line.samples()] == [values for _, values, _ in drive]
    assert line.counts.samples == len(drive)
    assert line.counts.batches == len(line.batches())
    assert line.counts.refused == 0
    assert [batch.seq for batch in line.batches()] == list(range(line.counts.batches))

    times = [t for t, _ in line.samples()]
    kept = sum(map(operator.eq, times, [t_us for t_us, _, _ in drive]))
    assert line.counts.restamped == len(drive) - kept
    for batch in line.batches():
        assert len({t // 1_000_000 for t in batch.times_us}) == 1, "a batch lies within one second"
        assert batch.times_us[-1] - batch.times_us[0] < (batch_s or 0.000_001) * 1_000_000


def test_a_batch_closes_with_the_second() -> None:
    line = Line()
    for i in range(100):
        line.batcher.add(T0 + i * 20_000, {"speed": i})
    assert [len(batch.times_us) for batch in line.batches()] == [50]
    line.batcher.flush()
    assert [len(batch.times_us) for batch in line.batches()] == [50, 50]


def test_one_sample_a_message_as_the_thesis() -> None:
    line = Line(batch_s=0)
    for i in range(5):
        line.batcher.add(T0 + i * 20_000, {"speed": i})
    assert [len(batch.times_us) for batch in line.batches()] == [1, 1, 1, 1, 1]


def test_a_silent_topic_closes_its_batch_by_the_clock() -> None:
    line = Line()
    line.batcher.add(T0, {"speed": 1})
    line.clock.advance(0.9)
    line.batcher.tick()
    assert line.batches() == []
    line.clock.advance(0.3)
    line.batcher.tick()
    assert len(line.batches()) == 1


@pytest.mark.parametrize(
    ("stamps", "expected", "restamped", "batches"),
    [
        ([0, 0, 0], [0, 1, 2], 2, 1),
        ([10, 5, 11], [10, 11, 12], 2, 1),
        ([999_999, 10, 1_000_000], [999_999, 1_000_000, 1_000_001], 2, 2),
        ([3_000_000, 1_000_000, 1_000_020], [3_000_000, 1_000_000, 1_000_020], 0, 2),
    ],
)
def test_times_strictly_increase(
    stamps: list[int], expected: list[int], restamped: int, batches: int
) -> None:
    line = Line()
    for stamp in stamps:
        line.batcher.add(T0 + stamp, {"speed": 1})
    line.batcher.flush()
    assert [t - T0 for t, _ in line.samples()] == expected
    assert line.counts.restamped == restamped
    assert line.counts.batches == batches


def test_another_set_of_fields_is_another_batch() -> None:
    line = Line()
    line.batcher.add(T0, {"a": 1, "b": 2})
    line.batcher.add(T0 + 1, {"b": 3, "a": 4})
    line.batcher.add(T0 + 2, {"a": None})
    line.batcher.flush()
    assert [dict(batch.columns) for batch in line.batches()] == [{"a": [1, 4], "b": [2, 3]}, {"a": [None]}]


def test_messages_stay_below_the_limit() -> None:
    line = Line()
    names = [f"f{i}" for i in range(400)]
    for i in range(200):
        # Doubles without a pattern, which no compression helps.
        line.batcher.add(T0 + i * 1000, {name: math.sin(i * 7919 + k) for k, name in enumerate(names)})
    line.batcher.flush()
    assert len(line.samples()) == 200
    assert all(len(message) <= contract.MAX_MESSAGE_BYTES for message in line.messages())
    assert all(len(b.times_us) * 400 <= MAX_VALUES for b in line.batches())
    assert len(line.batches()) > 200 * 400 // MAX_VALUES, "some were split"


def test_what_holds_too_many_values_for_a_batch_is_halved() -> None:
    line = Line()
    fields = dict.fromkeys((f"f{i}" for i in range(300)), 0)
    line.packer.store(list(range(400)), [fields] * 400)
    assert [t_us for t_us, _ in line.samples()] == list(range(400))
    assert [len(batch.times_us) for batch in line.batches()] == [100] * 4
    assert all(len(batch.times_us) * 300 <= contract.MAX_BATCH_VALUES for batch in line.batches())
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
        line.batcher.add(T0 + i, {"speed": bad if i == 13 else i})
    line.batcher.flush()
    assert [values["speed"] for _, values in line.samples()] == [i for i in range(20) if i != 13]
    assert (line.counts.samples, line.counts.refused) == (20, 1)
    assert [batch.seq for batch in line.batches()] == list(range(line.counts.batches))


def test_a_sample_that_fits_no_message_is_refused() -> None:
    line = Line()
    line.batcher.add(T0, {f"f{i}": math.sin(i) for i in range(513)})
    line.batcher.add(T0 + 1, {"not a field": 1})
    # Distinct characters, so that compression does not make them fit.
    text = "".join(chr(0x4E00 + i) for i in range(4000))
    line.batcher.add(T0 + 2, {f"f{i}": text[i:] + text[:i] for i in range(64)})
    line.batcher.add(2**60, {"speed": 1})
    line.batcher.add(T0 + 3, {"speed": 1})
    line.batcher.flush()
    assert [values for _, values in line.samples()][-1] == {"speed": 1}
    assert line.counts.refused + len(line.samples()) == 5
    assert line.counts.refused >= 3


def test_nan_and_infinity_are_nulled_and_counted() -> None:
    line = Line()
    line.batcher.add(T0, {"a": math.nan, "b": 1.5})
    line.batcher.add(T0 + 1, {"a": -math.inf, "b": math.inf})
    line.batcher.flush()
    assert [values for _, values in line.samples()] == [{"a": None, "b": 1.5}, {"a": None, "b": None}]
    assert line.counts.nulled == 3
    assert line.batches()[0].nonfinite == 3
