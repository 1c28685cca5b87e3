"""What clients publish as a stick: its limits, its silence, and who holds it."""

from __future__ import annotations

import json
import struct
from typing import Any

import pytest
from typing_extensions import Self

from iort_contract.messages.commands import DriveLimits
from iort_station.bridge.driving import MOST_OFFERED, SETTLES_US, SILENT_US, TOPIC, PublishedWheel, twist
from iort_station.fleet.driving import Driver, Phase, Stick
from testkit.waiting import until

LIMITS = DriveLimits("drive", "drive.speed", "drive.steering_angle", 2.0, 0.4, 500)
CHANNEL = {"id": 7, "topic": TOPIC, "encoding": "json", "schemaName": "geometry_msgs/Twist"}


class Broker:
    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        pass


class Seat:
    """Keeps what the wheel tells it."""

    def __init__(self) -> None:
        self.driver, self.broker = Driver(LIMITS, "ada", 1.0), Broker()
        self.ticks: list[tuple[bool, Stick]] = []
        self.left = 0

    def tick(self, *, held: bool, stick: Stick, now_us: int) -> None:
        self.ticks.append((held, stick))

    def leave(self) -> None:
        self.left += 1


@pytest.fixture
def seat() -> Seat:
    return Seat()


class Clock:
    """A clock that is set; in microseconds."""

    def __init__(self) -> None:
        self.us = 1_000_000

    def __call__(self) -> int:
        return self.us


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def wheel(seat: Seat, clock: Clock) -> PublishedWheel:
    """A wheel whose thread does not run."""
    return PublishedWheel(seat, lambda _text, _level: None, clock)  # type: ignore[arg-type]  # a fake


def held(wheel: PublishedWheel, clock: Clock, client: int, sent: bytes) -> str:
    """Publish for as long as a hold needs to begin; returns why the last message was not taken."""
    problem = wheel.publish(client, sent)
    clock.us += SETTLES_US
    return wheel.publish(client, sent) or problem


def message(speed: float, steering: float, channel: int = 7) -> bytes:
    body = {"linear": {"x": speed, "y": 0, "z": 0}, "angular": {"x": 0, "y": 0, "z": steering}}
    return struct.pack("<I", channel) + json.dumps(body).encode()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"topic": "/odom"}, "only /cmd_vel can be published here, got '/odom'"),
        ({"topic": None}, "only /cmd_vel can be published here, got None"),
        ({"id": "seven"}, "a channel's id must be a whole number, got 'seven'"),
        ({"id": -1}, "a channel's id must be a whole number, got -1"),
        ({"id": True}, "a channel's id must be a whole number, got True"),
        ({"encoding": "protobuf"}, "/cmd_vel must be geometry_msgs/Twist as json, ros1, cdr"),
        ({"schemaName": "std_msgs/String"}, "got 'std_msgs/String' as 'json'"),
    ],
)
def test_what_cannot_be_published_is_told(wheel: PublishedWheel, change: Any, words: str) -> None:
    assert words in wheel.advertise(1, {**CHANNEL, **change})
    assert "was not offered" in wheel.publish(1, message(1, 0))


def test_a_channel_that_is_no_object_is_told(wheel: PublishedWheel) -> None:
    assert "must be a whole number" in wheel.advertise(1, "/cmd_vel")
    wheel.unadvertise(1, "/cmd_vel")


@pytest.mark.parametrize(
    ("speed", "steering", "stick"),
    [(0.5, 0.1, Stick(0.5, 0.25)), (-3.0, -9.0, Stick(-1.0, -1.0)), (1e308, 0.0, Stick(1.0, 0.0))],
)
def test_a_twist_moves_the_stick_within_the_limits(
    wheel: PublishedWheel, clock: Clock, speed: float, steering: float, stick: Stick
) -> None:
    assert wheel.advertise(1, CHANNEL) == ""
    assert held(wheel, clock, 1, message(speed, steering)) == ""
    assert wheel._stick(clock()) == (True, stick)


def test_silence_lets_go(wheel: PublishedWheel, clock: Clock) -> None:
    wheel.advertise(1, CHANNEL)
    held(wheel, clock, 1, message(0.5, 0))
    assert wheel._stick(clock() + SILENT_US - 1)[0]
    assert wheel._stick(clock() + SILENT_US) == (False, Stick())


def test_few_messages_that_waited_move_nothing(wheel: PublishedWheel, clock: Clock) -> None:
    """A panel at 10 Hz was held while the way stood still for a second; since then it was let go."""
    wheel.advertise(1, CHANNEL)
    held(wheel, clock, 1, message(0.5, 0))
    clock.us += 1_000_000
    assert wheel._stick(clock()) == (False, Stick())
    for _ in range(8):
        wheel.publish(1, message(0.5, 0))
    while clock.us < 3_000_000:
        assert wheel._stick(clock()) == (False, Stick())
        clock.us += 50_000


def test_one_client_drives_at_a_time_and_the_next_once_it_is_silent_or_gone(
    wheel: PublishedWheel, clock: Clock
) -> None:
    for client in (1, 2):
        assert wheel.advertise(client, CHANNEL) == ""
    assert held(wheel, clock, 1, message(0.5, 0)) == ""
    assert wheel.publish(2, message(-0.5, 0)) == "another client of this bridge drives"
    assert wheel._stick(clock())[1] == Stick(0.5, 0.0)
    wheel.gone(1)
    assert wheel._stick(clock()) == (False, Stick())
    assert wheel.publish(2, message(-0.5, 0)) == ""
    assert "was not offered" in wheel.publish(1, message(0.5, 0))


def test_a_client_that_offers_without_end_is_told_so_and_can_take_back_anything(
    wheel: PublishedWheel,
) -> None:
    for number in range(MOST_OFFERED):
        assert wheel.advertise(1, {**CHANNEL, "id": number}) == ""
    assert "may offer 16 channels" in wheel.advertise(1, {**CHANNEL, "id": MOST_OFFERED})
    assert wheel.advertise(2, CHANNEL) == ""
    for channel in ([1], {}, None, 1.5):
        wheel.unadvertise(1, channel)
    wheel.unadvertise(1, 0)
    assert wheel.advertise(1, {**CHANNEL, "id": MOST_OFFERED}) == ""


def test_messages_that_waited_move_nothing_until_they_fail_to_come(
    wheel: PublishedWheel, clock: Clock
) -> None:
    wheel.advertise(1, CHANNEL)
    held(wheel, clock, 1, message(1, 0))
    for _ in range(20):
        wheel.publish(1, message(1, 0))
    assert wheel._stick(clock()) == (False, Stick())
    clock.us += SILENT_US - SETTLES_US - 1
    held(wheel, clock, 1, message(1, 0))
    assert wheel._stick(clock()) == (False, Stick())


@pytest.mark.parametrize(
    ("body", "encoding"),
    [
        (b"no json", "json"),
        (b"[]", "json"),
        (b'{"linear": 1, "angular": 2}', "json"),
        (b'{"linear": {"x": "fast"}, "angular": {"z": 0}}', "json"),
        (b'{"linear": {"x": true}, "angular": {"z": 0}}', "json"),
        (b'{"linear": {"x": NaN}, "angular": {"z": 0}}', "json"),
        (b'{"linear": {"x": 1e999}, "angular": {"z": 0}}', "json"),
        (b'{"linear": {"x": ' + b"1" * 400 + b'}, "angular": {"z": 0}}', "json"),
        (struct.pack("<5d", *range(5)), "ros1"),
        (struct.pack("<6d", float("inf"), 0, 0, 0, 0, 0), "ros1"),
        (b"\0\0\0\0" + struct.pack("<6d", *range(6)), "cdr"),
        (b"", "cdr"),
    ],
)
def test_what_is_no_twist_is_refused(body: bytes, encoding: str) -> None:
    with pytest.raises(ValueError, match="must"):
        twist(body, encoding)


def test_a_twist_is_read_in_every_encoding() -> None:
    raw = struct.pack("<6d", 1.5, 0, 0, 0, 0, -0.25)
    for body, encoding in ((message(1.5, -0.25)[4:], "json"), (raw, "ros1"), (b"\0\1\0\0" + raw, "cdr")):
        assert twist(body, encoding) == (1.5, -0.25)


def test_the_seat_is_used_only_while_somebody_may_publish_and_is_left_after_that(
    seat: Seat, wheel: PublishedWheel, clock: Clock
) -> None:
    with wheel:
        assert seat.ticks == []
        wheel.advertise(1, CHANNEL)
        held(wheel, clock, 1, message(0.5, 0))
        until(lambda: (True, Stick(0.5, 0.0)) in seat.ticks)
        wheel.gone(1)
        until(lambda: seat.left == 1)
        before = len(seat.ticks)
        wheel.advertise(2, CHANNEL)
        until(lambda: len(seat.ticks) > before)
        assert seat.ticks[-1] == (False, Stick())
    assert seat.left == 2
    assert seat.driver.phase is Phase.FREE
