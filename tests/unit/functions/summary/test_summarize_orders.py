"""Lambda 2: the summary depends on the stored batches, not on the order of the stream's records."""

from __future__ import annotations

from collections import defaultdict
from itertools import cycle, groupby, islice, pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iort_contract.messages.batch import split_batch
from iort_contract.statistics import missing_before
from testkit.dynamodb import ROBOTS, FakeDynamoDB
from tests.examples import examples
from tests.unit.functions.summary.summarizing import T0, S, Stream, batch, clean


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


@examples(60)
@given(drives())
def test_a_batch_sent_in_two_halves_gives_the_same_samples(drive):
    whole, halved = Stream(), Stream()
    whole.deliver(*drive)
    # Batches may overlap here; two that start at the same time would be one item.
    taken = {b.t_us for b in drive}
    for b in drive:
        halves = split_batch(b) if len(b.times_us) > 1 and split_batch(b)[1].t_us not in taken else (b,)
        taken.add(halves[-1].t_us)
        halved.deliver(*halves)
    for second, item in whole.summary().items():
        other = halved.summary()[second]
        assert {k: v for k, v in other.items() if k.endswith(("_min", "_max")) or k == "n"} == {
            k: v for k, v in item.items() if k.endswith(("_min", "_max")) or k == "n"
        }
