"""A robot with video takes a motion only by a live picture, and tells of each what its driver saw."""

from __future__ import annotations

from typing import Any

import pytest

from iort_agent.control.commands import Sight
from iort_agent.video import KEPT_S, Frame, Pictures
from testkit.agent import ManualClock
from tests.unit.agent.control.downlink_rig import T0, Rig, doubles

pytestmark = pytest.mark.usefixtures("ros")
LATE = "picture late, sent 0.000 s ago, to within 0.000 s"


class Seeing(Rig):
    """A robot whose camera has numbered some pictures, the newest of them `age_s` before now."""

    def __init__(self, age_s: float = 0.0, numbers: int = 9, max_age_ms: int = 500) -> None:
        clock, self.pictures = ManualClock(now_us=T0), Pictures()
        super().__init__(clock=clock, sight=Sight(max_age_ms, self.pictures.age_ms))
        for number in range(1, numbers + 1):
            self.capture(number)
            clock.advance(age_s if number == numbers else 1 / 16)

    def capture(self, number: int) -> None:
        picture: Any = None
        self.pictures.add(Frame(number, self.clock.now_us(), self.clock.monotonic(), picture))


def told(rig: Rig) -> list[tuple[Any, ...]]:
    keys = ("outcome", "frame", "frame_age_ms", "blind", "speed")
    return [tuple(sample[key] for key in keys if key in sample) for sample in rig.drove]


@pytest.mark.parametrize(
    ("age_s", "sent", "passes", "expected"),
    [
        (0.25, {"frame": 9}, True, ("accepted", 9, 250.0, False)),
        (0.25, {"frame": 8}, True, ("accepted", 8, 312.5, False)),
        (0.5, {"frame": 9}, True, ("accepted", 9, 500.0, False)),
        (0.501, {"frame": 9}, False, ("picture_late", 9, 501.0, False)),
        (0.0, {"frame": 10}, False, ("picture_late", 10, None, False)),  # the next one, or a former run's
        (0.0, {"frame": 2**32 - 1}, False, ("picture_late", 2**32 - 1, None, False)),
        (0.0, {}, False, ("no_picture", None, None, False)),
        (0.501, {"frame": 9, "blind": True}, True, ("accepted", 9, 501.0, True)),
        (0.0, {"blind": True}, True, ("accepted", None, None, True)),
    ],
)
def test_a_motion_passes_by_a_live_picture_or_blind(
    age_s: float, sent: dict[str, Any], passes: bool, expected: tuple[Any, ...]
) -> None:
    rig = Seeing(age_s)
    rig.send({"data": 2.5}, answer=True, **sent)
    assert [data for _, data in rig.graph.published] == [doubles(2.5)] * passes
    assert [sample[:4] for sample in told(rig)] == [expected]
    assert [why is None for _, _, why in rig.answers] == [passes]
    # To stand still is a motion, too.
    still = Seeing(age_s)
    still.send({"data": 0.0}, **sent)
    assert len(still.graph.published) == passes


def test_the_limit_is_car_yamls() -> None:
    rig = Seeing(0.25, max_age_ms=200)
    rig.send({"data": 2.5}, frame=9, answer=True)
    assert rig.answers == [("speed", 0, LATE)]


def test_a_picture_that_is_no_longer_known_is_late() -> None:
    rig = Seeing()
    rig.clock.advance(KEPT_S + 1)
    rig.capture(10)
    rig.send({"data": 2.5}, frame=9)
    rig.send({"data": 2.5}, frame=10)
    assert [sample[:3] for sample in told(rig)] == [("picture_late", 9, None), ("accepted", 10, 0.0)]


def test_a_new_run_knows_no_picture_of_a_former_one() -> None:
    rig = Seeing(numbers=3)
    for frame in (900, 3):
        rig.send({"data": 2.5}, frame=frame)
    assert [sample[:3] for sample in told(rig)] == [("picture_late", 900, None), ("accepted", 3, 0.0)]


def test_what_is_no_motion_needs_no_picture() -> None:
    rig = Seeing()
    rig.send({"data": "hello"}, name="say", lease_ms=None)
    assert rig.graph.published[-1][0] == "/say"
    assert rig.drove == []


@pytest.mark.parametrize("frame", [None, 9, 99])
def test_the_end_of_a_lease_passes_by_any_picture_and_stops_the_robot(frame: int | None) -> None:
    rig = Seeing()
    rig.send({"data": 2.5}, frame=9)
    rig.clock.advance(0.2)
    # The picture is late by now.
    rig.pictures.add(Frame(9, 0, rig.clock.monotonic() - 5, None))  # type: ignore[arg-type]  # of no use here
    rig.send({"data": 0.0}, frame=frame, ends=True)
    rig.downlink.tick()
    assert [data for _, data in rig.graph.published][:2] == [doubles(2.5), doubles(0.0)]
    assert [sample[0] for sample in told(rig)] == ["accepted", "accepted", "stopped"]
    # Others may drive at once, by a picture.
    rig.capture(10)
    rig.send({"data": 1.0}, session="ffffffff", frame=10)
    assert rig.graph.published[-1][1] == doubles(1.0)


def test_the_end_of_a_lease_moves_nothing_whatever_it_says() -> None:
    rig = Seeing()
    for _ in range(5):
        rig.send({"data": 2.5}, ends=True)
        rig.downlink.tick()
        rig.clock.advance(0.02)
    assert {data for _, data in rig.graph.published} == {doubles(0.0)}
    assert ("accepted", None, None, False) in [sample[:4] for sample in told(rig)]
    assert [sample["speed"] for sample in rig.drove if sample["speed"]] == []
    # One that is malformed ends nothing.
    rig.send({"data": "fast"}, ends=True, answer=True)
    assert rig.answers[0][2] is not None


def test_a_frozen_picture_lets_the_lease_end_and_the_stop_tells_the_last_picture() -> None:
    rig = Seeing()
    for _ in range(40):
        rig.send({"data": 2.5}, frame=9)
        rig.clock.advance(0.05)
        rig.downlink.tick()
    accepted = [sample for sample in told(rig) if sample[0] == "accepted"]
    assert [sample[2] for sample in accepted] == [pytest.approx(50 * i) for i in range(11)]
    assert ("stopped", 9, 500.0, False) in [sample[:4] for sample in told(rig)]
    moved = [data for _, data in rig.graph.published]
    assert moved == [doubles(2.5)] * 11 + [doubles(0.0)] * (len(moved) - 11)
    assert rig.downlink.report()["commands"]["speed"]["stops"] == len(moved) - 11 > 0


def test_a_late_picture_takes_nothing_over() -> None:
    rig = Seeing(0.25)
    rig.send({"data": 2.5}, frame=9, session="aaaaaaaa", by="anna")
    rig.send({"data": 9.0}, frame=99, session="bbbbbbbb", by="bert", takeover=True)
    assert [(sample["outcome"], sample["driver_by"]) for sample in rig.drove] == [
        ("accepted", "anna"), ("picture_late", "anna"),
    ]  # fmt: skip
    assert [data for _, data in rig.graph.published] == [doubles(2.5)]


def test_an_emergency_stop_is_told_before_the_picture() -> None:
    rig = Seeing(0.501)
    rig.downlink.set_stopped(True)
    pictures: list[dict[str, Any]] = [{"frame": 9}, {}, {"frame": 9, "blind": True}]
    for sent in pictures:
        rig.send({"data": 2.5}, **sent)
        rig.clock.advance(0.1)
    assert [sample[0] for sample in told(rig)] == ["emergency_stop"] * 3


def test_the_time_that_a_command_waits_counts() -> None:
    clock, asked = ManualClock(now_us=T0), []

    def age_ms(number: int, now: float) -> float:
        asked.append((number, now))
        clock.advance(0.002)
        return 499.0

    rig = Rig(clock=clock, sight=Sight(500, age_ms))
    began = clock.monotonic()
    rig.send({"data": 2.5}, frame=7)
    assert asked == [(7, began)]
    assert told(rig)[0][:3] == ("picture_late", 7, 501.0)


def test_a_robot_without_video_needs_no_picture() -> None:
    rig = Rig()
    pictures: list[dict[str, Any]] = [{}, {"frame": 7}, {"blind": True}]
    for sent in pictures:
        rig.send({"data": 2.5}, **sent)
    assert [sample[:4] for sample in told(rig)] == [
        ("accepted", None, None, False), ("accepted", 7, None, False), ("accepted", None, None, True),
    ]  # fmt: skip
