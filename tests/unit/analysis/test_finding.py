"""Drives are the runs of the agent, cut where the car stood for longer than a minute."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from iort_analysis.drives.stretches import LONGEST_US, Heard, Stretch, find
from iort_contract.messages.batch import BatchId

START_US, S = 1_700_000_000_000_000, 1_000_000
A, B = "aaaaaaaa", "bbbbbbbb"


def batches(moving: Sequence[bool], run: str = A, from_s: int = 0) -> list[Heard]:
    """A batch a second."""
    return [
        Heard(BatchId(START_US + (from_s + i) * S, run, i), lambda moves=moves: moves)
        for i, moves in enumerate(moving)
    ]


def parts(*lengths: int) -> list[bool]:
    """Stands and drives in turn, in seconds."""
    return [i % 2 == 1 for i, length in enumerate(lengths) for _ in range(length)]


def in_seconds(found: Sequence[Stretch]) -> list[tuple[float, float, str]]:
    return [((one.start_us - START_US) / S, (one.last_us - START_US) / S, one.run) for one in found]


def test_a_stand_of_more_than_a_minute_cuts() -> None:
    found = find(batches(parts(30, 100, 59, 100, 90, 200, 300)))

    # Ten seconds of the stands belong to the drives beside them.
    assert in_seconds(list(found)) == [(20, 298, A), (369, 588, A)]


def test_runs_and_pauses_cut() -> None:
    first = batches(parts(0, 100))
    pause = batches(parts(0, 50), from_s=200)
    again = batches(parts(0, 100), B, from_s=260)

    assert in_seconds(list(find([*first, *pause, *again]))) == [(0, 99, A), (200, 249, A), (260, 359, B)]


def test_a_drive_that_begins_in_a_range_is_read_to_its_end() -> None:
    heard = batches(parts(0, 100, 100, 200, 100, 300, 100, 300))
    left = iter(heard)
    found = find(left, until_us=START_US + 250 * S)

    assert in_seconds(list(found)) == [(0, 109, A), (190, 409, A)]
    # The rest is not read.
    assert len(list(left)) > 600


def test_two_runs_at_the_same_time_are_apart() -> None:
    both = sorted([*batches(parts(0, 100)), *batches(parts(0, 100), B, from_s=50)], key=lambda one: one.id)

    assert sorted(in_seconds(list(find(both)))) == [(0, 99, A), (50, 149, B)]


def test_a_drive_is_the_same_wherever_the_reading_began() -> None:
    """The car is nudged for a second, and drives half a minute later."""
    moving = parts(1000, 1, 30, 100, 200)
    found = {tuple(find(batches(moving[skipped:], from_s=skipped))) for skipped in range(30)}

    assert len(found) == 1


def test_a_robot_that_never_stands_has_a_drive_every_two_hours() -> None:
    hour = 3600
    whole = list(find(batches([True] * 9 * hour)))
    later = list(find(batches([True] * 7 * hour, from_s=2 * hour)))

    cuts = [one.start_us for one in whole[1:]]
    assert len(cuts) == 3
    assert not any(cut % LONGEST_US for cut in cuts)
    # A drive's last batch has samples for a second.
    assert [one.last_us + S for one in whole[:-1]] == cuts
    assert in_seconds(whole)[-1][1] == 9 * hour - 1
    assert later[1:] == whole[2:]


def test_a_car_that_stands_has_no_drive() -> None:
    assert list(find(batches(parts(1000)))) == []


@given(st.lists(st.integers(20, 200), min_size=1, max_size=12))
def test_few_batches_are_looked_at_and_no_stand_is_missed(lengths: list[int]) -> None:
    moving = parts(0, *lengths)
    looks = 0

    def look(moves: bool) -> bool:
        nonlocal looks
        looks += 1
        return moves

    heard = [Heard(one.id, lambda one=one: look(one.moves())) for one in batches(moving)]
    found = list(find(heard))

    # The plain way: look at everything, and cut where more than a minute lies between two that move.
    moved = [i for i, moves in enumerate(moving) if moves]
    cuts = [i for i in range(1, len(moved)) if moved[i] - moved[i - 1] > 60]
    edges = [0, *cuts, len(moved)]
    plain = [(moved[a], moved[b - 1]) for a, b in pairwise(edges)]
    assert len(found) == len(plain)
    for one, (first, last) in zip(in_seconds(found), plain, strict=True):
        assert first - 10 <= one[0] <= first
        assert last <= one[1] <= last + 10
    assert looks <= len(moving) / 2 + 20 * len(lengths)
