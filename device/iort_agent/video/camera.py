"""What cameras of every kind share.

No picture waits for the one before it: whoever is late gets the newest."""

from __future__ import annotations

import threading
from typing import Any, Generic, Mapping, NamedTuple, Protocol, TypeVar

from iort_agent.common.threads import Clock
from iort_agent.errors import VideoError
from iort_agent.video import Frame

T = TypeVar("T")

# A camera that gives no picture for so long has failed; the first one may take longer.
SILENT_S, FIRST_S = 2.0, 10.0
# A stamp further from now is of a clock that is not set, or of a simulation.
BELIEVABLE_S = 5.0
# How soon a thread that waits for a picture sees that nobody looks any more.
_LOOK_S = 0.1
# Cameras are not even: a picture may come so much of a period earlier.
_EARLY = 0.25


class Camera(Protocol):
    """A camera. One thread opens, reads and closes it."""

    def open(self) -> None:
        """Begin. Raises `VideoError`."""

    def read(self, number: int, stop: threading.Event) -> Frame | None:
        """The newest picture after the last one, which gets this number; None if ``stop`` is set. Raises
        `VideoError` if there is none for `SILENT_S`, or the camera is gone."""

    def report(self) -> Mapping[str, Any]:
        """Its own counts."""
        return {}

    def close(self) -> None:
        """End; never waits for a camera that hangs."""


class Pacer:
    """Keeps pictures to a rate: those between are left out, and none is sent later than it came."""

    def __init__(self, rate_hz: float) -> None:
        self._period_s = 1 / rate_hz
        self._due: float | None = None

    def left_s(self, now: float) -> float:
        """The seconds until the next picture is due; 0 if it is."""
        return 0.0 if self._due is None else max(0.0, self._due - now)

    def takes(self, now: float) -> bool:
        """Whether a picture that comes now is to be taken."""
        due = now if self._due is None else self._due
        if now < due - self._period_s * _EARLY:
            return False
        # One that is late does not delay all those after it.
        self._due = max(due, now - self._period_s / 2) + self._period_s
        return True


class Newest(Generic[T]):
    """A place for the newest picture, between the thread that hears a camera and the one that reads it."""

    def __init__(self, clock: Clock, what: str) -> None:
        self._clock, self._what = clock, what
        self._lock, self._arrived = threading.Lock(), threading.Event()
        self._item: T | None = None
        self._error: VideoError | None = None

    def put(self, item: T) -> None:
        """Replace what waits."""
        with self._lock:
            self._item = item
        self._arrived.set()

    def fail(self, error: VideoError) -> None:
        """Let the reader raise an error."""
        self._error = error
        self._arrived.set()

    def take(self, stop: threading.Event, within_s: float) -> T | None:
        """The newest, once; None if ``stop`` is set. Raises `VideoError` if none comes within the time."""
        until = self._clock.monotonic() + within_s
        while not stop.is_set():
            if self._error is not None:
                raise self._error
            with self._lock:
                item, self._item = self._item, None
                self._arrived.clear()
            if item is not None:
                return item
            left = until - self._clock.monotonic()
            if left <= 0:
                raise VideoError(f"{self._what} gave no picture for {within_s:g} s")
            self._clock.wait(self._arrived, min(left, _LOOK_S))
        return None


class Moment(NamedTuple):
    """A time by both clocks."""

    us: int
    monotonic: float


def moment(clock: Clock) -> Moment:
    """Now."""
    return Moment(clock.now_us(), clock.monotonic())


def captured(stamp_us: int | None, arrival: Moment) -> Moment:
    """When a picture was captured: at its stamp, if that can be; else it is its arrival."""
    age_us = arrival.us - stamp_us if stamp_us is not None else 0
    if not 0 < age_us <= BELIEVABLE_S * 1e6:
        return arrival
    return Moment(arrival.us - age_us, arrival.monotonic - age_us / 1e6)
