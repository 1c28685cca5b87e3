"""What the page calculates without a browser: the way from positions, and the labels of an axis."""

from __future__ import annotations

import itertools
import math

import pytest

from tests.web.logic.node import call, run


def test_the_noise_of_positions_is_no_way() -> None:
    # 20 Hz: ten seconds of standing, then 10 m in ten seconds, all with 2 cm of noise.
    times = [i / 20 for i in range(400)]
    x = [max(0.0, t - 10) + 0.02 * math.sin(7 * i) for i, t in enumerate(times)]
    y = [0.02 * math.cos(11 * i) for i in range(400)]
    found = call(
        "history/align.ts", "distance", {"times_s": times, "fields": {"x": {"mean": x}, "y": {"mean": y}}}
    )
    assert found[200] < 0.3
    assert found[-1] == pytest.approx(10, rel=0.1)


def test_a_tachometer_counts_samples_that_were_taken_at_once_and_no_restart() -> None:
    # 50 Hz at 5 m/s, in bursts of ten within a millisecond; then the VESC starts again from zero.
    times = [i // 10 * 0.2 + i % 10 / 10_000 for i in range(200)]
    # 1 m is 100 counts: at 1 m/s a minute has 6,000, of six a revolution.
    counts = [1_000_000 + 10 * i for i in range(100)] + [10 * i for i in range(100)]
    speed = {"scale": 1 / 1000, "shift": 0}
    drive = {"times_s": times, "fields": {"distance_traveled": {"mean": counts}}}
    assert call("history/align.ts", "distance", drive, speed)[-1] == pytest.approx(19.8)


@pytest.mark.parametrize(
    ("splits", "labels"),
    [
        ([0, 2.5, 5, 7.5], ["0.0", "2.5", "5.0", "7.5"]),
        ([11.75, 12, 12.25], ["11.75", "12.00", "12.25"]),
        ([0, 20, 40], ["0", "20", "40"]),
        ([-0.2, 0, 0.2], ["\u22120.2", "0.0", "0.2"]),
        ([0, 5000, 10_000], ["0", "5000", "10k"]),
    ],
)
def test_an_axis_is_labelled_with_its_values(splits: list[float], labels: list[str]) -> None:
    assert call("charts/axes.ts", "labels", splits) == labels


@pytest.mark.parametrize(
    ("least", "most", "zero", "expected"),
    [
        # The highest value is not at the edge, though it is a round number.
        (11.9, 12.5, False, [11.8, 12.6]),
        # Zero is one, for values that do not cross it.
        (0.02, 8, True, [0, 10]),
        (-3, -1, True, [-3.5, 0]),
    ],
)
def test_an_axis_has_room_above_and_below_its_values(
    least: float, most: float, zero: bool, expected: list[float]
) -> None:
    assert call("charts/axes.ts", "roundRange", least, most, 0.1, zero) == pytest.approx(expected)


def test_every_range_of_time_has_several_labels() -> None:
    steps = run("charts/axes.ts", "return page.TIME_STEPS_S")
    assert max(after / before for before, after in itertools.pairwise(steps)) <= 2.5
