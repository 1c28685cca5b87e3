"""The judgement of the proof, by drives whose verdict is known."""

from __future__ import annotations

import math

import pytest

from tests.video.account import (
    Motion,
    Said,
    Shown,
    again_s,
    ages_ms,
    judge,
    live_share,
    longest_gap_ms,
    motions,
    said_again_s,
    said_wrong_ms,
    struck,
)

LIMIT_MS = 500
# Pictures 1 to 20, ten a second, each on the screen 80 ms after its capture.
CAPTURED = {number: number * 100_000 for number in range(1, 21)}
SHOWN = [Shown(at_us + 80_000, number) for number, at_us in CAPTURED.items()]
EVER = (0, 10_000_000)


def command(at_us: int, frame: int | None = None, **change: object) -> Motion:
    age_ms = None if frame is None else (at_us - CAPTURED[frame]) / 1000
    return Motion(at_us, 1, "accepted", frame, age_ms, blind=False, drives=True)._replace(**change)


def wrong(*commands: Motion, **settings: float) -> tuple[str, ...]:
    return judge(commands, SHOWN, CAPTURED, LIMIT_MS, EVER, **settings).wrong


def test_a_command_by_the_newest_picture_is_right() -> None:
    assert wrong(command(1_100_000, 10), command(2_500_000, 20)) == ()


@pytest.mark.parametrize(
    ("late", "why"),
    [
        (command(2_501_000, 20), "its picture was 501 ms old"),
        (command(2_700_000, 20, frame_age_ms=10.0), "the newest on the screen, 20, was 700.0 ms old"),
        (command(1_100_000), "names picture None"),
        (command(1_100_000, 10, frame_age_ms=None), "names picture 10"),
        (command(1_100_000, 10, blind=True), "blind"),
        (command(1_050_000, 10), "picture 10 was not on the screen"),
    ],
)
def test_every_wrong_command_is_told(late: Motion, why: str) -> None:
    (told,) = wrong(late)
    assert why in told


def test_a_refused_command_and_one_that_ends_are_not_wrong() -> None:
    refused = command(4_000_000, 20, outcome="picture_late")
    verdict = judge([refused, command(4_000_000, drives=False)], SHOWN, CAPTURED, LIMIT_MS, EVER)
    assert (verdict.passed, verdict.refused, verdict.wrong) == (0, 2, ())


def test_a_browser_tells_only_about_when_a_picture_is_on_the_screen() -> None:
    assert wrong(command(1_075_000, 10), screen_ms=5) == ()
    early = [*SHOWN[:9], SHOWN[9]._replace(shown_us=1_200_000, early_ms=120)]
    assert judge([command(1_085_000, 10)], early, CAPTURED, LIMIT_MS, EVER).wrong == ()
    # That makes no late picture younger.
    assert wrong(command(2_505_000, 20), screen_ms=50)
    assert wrong(command(2_505_000, 20, frame_age_ms=499.0), screen_ms=50)
    assert wrong(command(2_505_000, 20, frame_age_ms=499.0), slack_ms=10) == ()


def test_only_the_commands_of_the_time_count() -> None:
    verdict = judge([command(9_000_000, 20)], SHOWN, CAPTURED, LIMIT_MS, (0, 5_000_000))
    assert verdict.passed == 0


def test_the_age_is_that_on_the_screen() -> None:
    assert set(ages_ms([*SHOWN, Shown(5_000_000, None), Shown(5_000_000, 99)], CAPTURED)) == {80.0}


def test_a_picture_is_live_until_it_is_late() -> None:
    # The last one comes at 2.08 s and is late at 2.5 s.
    assert live_share(SHOWN, CAPTURED, (2_080_000, 2_920_000), LIMIT_MS) == pytest.approx(0.5)
    assert live_share(SHOWN, CAPTURED, (500_000, 1_500_000), LIMIT_MS) == pytest.approx(1.0)


def test_pictures_are_back_when_a_new_one_is_not_late() -> None:
    late = [Shown(3_000_000, 18), Shown(3_100_000, 19)]
    assert again_s(late, CAPTURED, 1_800_000, LIMIT_MS) is None
    assert again_s([*late, *SHOWN], CAPTURED, 1_850_000, LIMIT_MS) == pytest.approx(0.13)


def test_the_pages_own_word_is_held_to_the_truth() -> None:
    said = [
        Said(1_000_000, "live", 9, 103.0),
        Said(2_200_000, "frozen", 20, 190.0),
        Said(2_300_000, "live", 20, 310.0),
        Said(2_400_000, "live", 77, 1.0),
    ]
    assert said_wrong_ms(said, CAPTURED) == pytest.approx([3.0, -10.0, 10.0])
    assert said_again_s(said, CAPTURED, 1_900_000) == pytest.approx(0.4)
    assert said_again_s(said, CAPTURED, 2_100_000) is None


def test_the_longest_gap_reaches_to_the_ends() -> None:
    assert longest_gap_ms(SHOWN, (0, 5_000_000)) == pytest.approx(2920)


def test_nulls_of_a_query_are_none() -> None:
    (one,) = motions(
        [5],
        {
            "seq": [3.0],
            "outcome": ["accepted"],
            "frame": [math.nan],
            "frame_age_ms": [math.nan],
            "blind": [False],
            "driver": [None],
        },
    )
    assert one == Motion(5, 3, "accepted", None, None, blind=False, drives=False)
    assert not one.passed


def test_a_picture_that_was_overtaken_before_it_was_read_was_on_the_screen() -> None:
    shown = [*SHOWN[:9], *SHOWN[10:]]
    judged = judge([command(1_190_000, 10)], shown, CAPTURED, LIMIT_MS, EVER)
    assert judged.wrong == ()
    (told,) = judge([command(1_150_000, 10)], shown, CAPTURED, LIMIT_MS, EVER).wrong
    assert "picture 10 was not on the screen, 0 of its second unread" in told
    (told,) = wrong(command(2_100_000, 20)._replace(frame=21))
    assert "picture 21 was not on the screen" in told


def test_the_picture_of_a_strike_is_known_by_the_commands_that_name_it() -> None:
    recorded = {number: at_us for number, at_us in CAPTURED.items() if number != 20}
    told = [command(2_100_000, 20), command(2_200_000, 20)]
    assert wrong(*told) == ()
    assert len(judge(told, SHOWN, recorded, LIMIT_MS, EVER).wrong) == 2
    assert struck(told, recorded, (1_500_000, 2_500_000)) == {20: 2_000_000}
    assert struck(told, recorded, (2_500_000, 3_000_000)) == {}
    assert struck(told, CAPTURED, (1_500_000, 2_500_000)) == {}
    # Without the robot's word it is not known.
    assert struck([told[0]._replace(frame_age_ms=None)], recorded, (1_500_000, 2_500_000)) == {}
