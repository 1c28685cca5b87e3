"""Drives a car by what a tool publishes: `/cmd_vel` of a teleop panel becomes commands with leases.

A tool publishes while somebody holds its panel, so silence means that nobody does: the car then stands. It is
left to others once the tool no longer offers to publish, or has gone. One client drives at a time. The guard,
the leases and the limits are those of every driver (`fleet.driving`); the thread and the connection to the
broker are the wheel's own.
"""

from __future__ import annotations

import json
import math
import struct
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any, NamedTuple

from typing_extensions import Self

from iort_contract.checks import shown
from iort_station.bridge.channels import Level
from iort_station.errors import StationError
from iort_station.fleet.driving import Phase, Stick
from iort_station.fleet.seat import TICK_US, Seat, monotonic_us
from iort_station.supervision import keep

TOPIC = "/cmd_vel"
# As their names are in ROS 1 and ROS 2.
_TYPES = {"geometry_msgs/Twist", "geometry_msgs/msg/Twist"}
ENCODINGS = ("json", "ros1", "cdr")
# Whoever holds a panel is heard so often at least: five times a second, and one may be late.
SILENT_US = 300_000
# A hold begins with a message this long after its first one: what has waited on its way comes all at once.
SETTLES_US = 100_000
# A client may offer so many channels; a tool has one for each of its panels.
MOST_OFFERED = 16
# So many messages between two ticks have waited on their way: whoever held the panel may have let go since.
_AT_ONCE = 10
_CDR_HEAD = 4
_TWIST = struct.Struct("<6d")


class _Held(NamedTuple):
    """What was published last: by which client, since when without silence, and where it puts the stick."""

    client: int
    since_us: int
    t_us: int
    stick: Stick


class PublishedWheel:
    """A wheel that clients of the bridge hold, within a ``with`` block. ``say`` takes a line for all clients,
    and its level; ``clock`` is the monotonic one, in microseconds."""

    def __init__(
        self, seat: Seat, say: Callable[[str, Level], None], clock: Callable[[], int] = monotonic_us
    ) -> None:
        self._seat, self._say, self._clock = seat, say, clock
        self._lock, self._end = threading.Lock(), threading.Event()
        # The encodings of what clients offer, by client and channel.
        self._offered: dict[tuple[int, int], str] = {}
        self._held: _Held | None = None
        self._since_tick = 0
        self._deaf_until_us = 0
        self._told: tuple[Phase, str] = (Phase.FREE, "")
        self._thread = threading.Thread(
            target=keep, args=("bridge's wheel", self._run, self._end), name="bridge's wheel", daemon=True
        )

    def __enter__(self) -> Self:
        self._seat.broker.__enter__()
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._end.set()
        self._thread.join()
        self._seat.broker.__exit__(*error)

    # Called by the door.

    def advertise(self, client: int, channel: Any) -> str:
        """A client wants to publish; returns why it cannot."""
        told = channel if isinstance(channel, dict) else {}
        number, topic, encoding = told.get("id"), told.get("topic"), told.get("encoding")
        if type(number) is not int or not 0 <= number < 2**32:
            return f"a channel's id must be a whole number, got {shown(number)}"
        if topic != TOPIC:
            return f"only {TOPIC} can be published here, got {shown(topic)}"
        if told.get("schemaName") not in _TYPES or encoding not in ENCODINGS:
            wanted = f"geometry_msgs/Twist as {', '.join(ENCODINGS)}"
            return f"{TOPIC} must be {wanted}, got {shown(told.get('schemaName'))} as {shown(encoding)}"
        with self._lock:
            has = sum(of == client for of, _ in self._offered)
            if has >= MOST_OFFERED and (client, number) not in self._offered:
                return f"a client may offer {MOST_OFFERED} channels"
            self._offered[client, number] = str(encoding)
        return ""

    def unadvertise(self, client: int, channel: Any) -> None:
        """A client does not want to publish any longer."""
        with self._lock:
            if type(channel) is int:
                self._offered.pop((client, channel), None)
            if self._held is not None and self._held.client == client:
                self._held = None

    def gone(self, client: int) -> None:
        """A client has ended."""
        with self._lock:
            channels = [number for of, number in self._offered if of == client]
        for number in channels:
            self.unadvertise(client, number)

    def publish(self, client: int, data: bytes) -> str:
        """Take a message: four bytes of the channel, and a Twist; returns why it cannot be taken."""
        number = int.from_bytes(data[:4], "little")
        with self._lock:
            encoding = self._offered.get((client, number))
            if encoding is None:
                return f"the channel {number} was not offered: offer {TOPIC} first"
            limits = self._seat.driver.limits
            try:
                speed_mps, steering_rad = twist(data[4:], encoding)
            except ValueError as error:
                return f"{TOPIC}: {error}"
            now_us, held = self._clock(), self._held
            if held is not None and now_us - held.t_us >= SILENT_US:
                held = None
            if held is not None and held.client != client:
                return "another client of this bridge drives"
            self._since_tick += 1
            top_mps = min(self._seat.driver.top_mps, limits.max_speed_mps)
            stick = Stick(_within(speed_mps / top_mps), _within(steering_rad / limits.max_steering_rad))
            self._held = _Held(client, now_us if held is None else held.since_us, now_us, stick)
        return ""

    # The wheel's own thread.

    def _run(self) -> None:
        taken = False
        while not self._end.wait(TICK_US / 1e6):
            with self._lock:
                offered = bool(self._offered)
                held, stick = self._stick(self._clock())
            try:
                if offered:
                    self._seat.tick(held=held, stick=stick, now_us=self._clock())
                elif taken:
                    # Nobody can drive any longer: others may.
                    self._seat.leave()
                taken = offered
                self._tell()
            except StationError as error:
                self._problem(str(error))
        with suppress(StationError):
            self._seat.leave()

    def _stick(self, now_us: int) -> tuple[bool, Stick]:
        """Whether somebody holds the stick, and where it is."""
        if self._since_tick > _AT_ONCE:
            self._held, self._deaf_until_us = None, now_us + SILENT_US
        elif self._since_tick and now_us < self._deaf_until_us:
            # Until what has waited fails to come.
            self._held, self._deaf_until_us = None, now_us + SILENT_US
        self._since_tick = 0
        held = self._held
        if held is None or now_us - held.t_us >= SILENT_US or held.t_us - held.since_us < SETTLES_US:
            return False, Stick()
        return True, held.stick

    def _problem(self, text: str) -> None:
        if self._told != (told := (Phase.OVER, text)):
            self._told = told
            self._say(text, "error")

    def _tell(self) -> None:
        driver = self._seat.driver
        told = driver.phase, driver.reason
        if told == self._told:
            return
        self._told = told
        words = {
            Phase.FREE: "nobody drives by the bridge",
            Phase.STARTING: "waiting for the car",
            Phase.DRIVING: "you drive",
            Phase.HOLDING: "the car stands, and waits for you",
            Phase.OVER: f"let go: {driver.reason}",
        }
        self._say(words[driver.phase], "error" if driver.phase is Phase.OVER else "info")


def twist(data: bytes, encoding: str) -> tuple[float, float]:
    """The speed in m/s and the steering angle in rad of a Twist: its ``linear.x`` and its ``angular.z``.

    Raises `ValueError` for anything else.
    """
    if encoding == "json":
        speed, steering = _of_json(data)
    else:
        body = data[_CDR_HEAD:] if encoding == "cdr" else data
        if len(body) != _TWIST.size or (encoding == "cdr" and data[:2] != b"\0\1"):
            raise ValueError(
                f"a Twist as {encoding} must have six little-endian numbers, got {len(data)} bytes"
            )
        speed, _, _, _, _, steering = _TWIST.unpack(body)
    if not (math.isfinite(speed) and math.isfinite(steering)):
        raise ValueError(f"linear.x and angular.z must be finite, got {speed} and {steering}")
    return speed, steering


def _of_json(data: bytes) -> tuple[float, float]:
    try:
        told = json.loads(data)
        speed, steering = told["linear"].get("x", 0.0), told["angular"].get("z", 0.0)
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError("must be an object with linear and angular") from error
    for number in (speed, steering):
        if isinstance(number, bool) or not isinstance(number, (int, float)):
            raise ValueError(f"linear.x and angular.z must be numbers, got {shown(number)}")  # noqa: TRY004 - as above
    try:
        return float(speed), float(steering)
    except OverflowError as error:
        raise ValueError("linear.x and angular.z must be finite") from error


def _within(share: float) -> float:
    return min(1.0, max(-1.0, share))
