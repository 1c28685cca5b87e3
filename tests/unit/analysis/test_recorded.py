"""A drive's stream has the samples of its run and its time alone, and notes what is missing among them."""

from __future__ import annotations

import random

from iort_analysis.drives.stretches import Recorded, recorded
from iort_contract.messages.analysis import DriveKey
from iort_contract.messages.batch import Batch
from testkit.dynamodb import item_of

START_US, S = 1_700_000_000_000_000, 1_000_000
RUN = "00c0ffee"
KEY = DriveKey("car", START_US, RUN)


def item(second: float, seq: int, run: str = RUN) -> dict:
    """Two samples, whose value is the batch's number."""
    t_us = START_US + round(second * S)
    return item_of(Batch(run, seq, [t_us, t_us + S // 2], {"speed": [float(seq)] * 2}))


def read(items: list, end_s: float = 100) -> Recorded:
    random.Random(1).shuffle(items)
    return recorded(KEY, START_US + round(end_s * S), "vesc", items)


def numbers(found: Recorded) -> list[int]:
    assert all(found.block.times_us[1:] >= found.block.times_us[:-1])
    return [int(value) for value in found.block.columns["speed"][::2]]


def test_the_samples_are_of_the_run_and_the_time() -> None:
    found = read([*(item(i - 2, i) for i in range(10)), item(3, 70, "bbbbbbbb")], end_s=5.4)

    assert numbers(found) == [2, 3, 4, 5, 6, 7]
    assert len(found.block.times_us) == 11
    assert found.notes == {}


def test_a_batch_in_quarantine_is_missed() -> None:
    assert (
        "2 of 10 are not stored"
        in read([item(i, i) for i in range(10) if i not in {4, 5}]).notes["vesc batches"]
    )


def test_a_refused_item_is_counted() -> None:
    bad = item(3, 3)
    bad["samples"] = {"S": "not a column"}
    found = read([item(0, 0), item(1, 1), item(2, 2), bad])

    assert numbers(found) == [0, 1, 2]
    assert "1 cannot be decoded" in found.notes["vesc items"]


def test_after_a_clock_was_set_back_the_longest_part_counts() -> None:
    before = [item(20 + i, i) for i in range(10)]
    after = [item(22 + i, 10 + i) for i in range(30)]
    found = read([*before, *after])

    assert numbers(found) == list(range(10, 40))
    assert "set back by 7.0 s: 10 of 40 batches" in found.notes["vesc clock"]


def test_nothing_is_nothing() -> None:
    found = read([])

    assert (len(found.block.times_us), found.notes) == (0, {})
