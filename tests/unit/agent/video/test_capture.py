"""The thread that takes pictures: only while somebody looks, with numbers and times that rise."""

from __future__ import annotations

import math
import threading
from collections import deque
from fractions import Fraction
from typing import Iterator

import pytest
from av import VideoFrame

from iort_agent.common.threads import WATCH, SystemClock
from iort_agent.errors import VideoError
from iort_agent.video import RTP_HZ, Frame, Pictures, first_number
from iort_agent.video.camera import Camera, Newest, Pacer
from iort_agent.video.capture import Capture
from iort_contract.counter import counter_bits
from testkit.agent import ManualClock
from testkit.waiting import until


class Eye(Camera):
    """A camera in memory: it gives what is put into ``shots``, and raises errors that are in it."""

    def __init__(self) -> None:
        self.shots: deque[float | Exception] = deque()
        self.opened = self.closed = 0
        self.numbers: list[int] = []

    def open(self) -> None:
        self.opened += 1

    def read(self, number: int, stop: threading.Event) -> Frame | None:
        while not stop.wait(0.001):
            if self.shots:
                shot = self.shots.popleft()
                if isinstance(shot, Exception):
                    raise shot
                self.numbers.append(number)
                return Frame(number, round(shot * 1e6), shot, VideoFrame(64, 64, "yuv420p"))
        return None

    def close(self) -> None:
        self.closed += 1


class Rig:
    def __init__(self, **how: int) -> None:
        self.eye, self.pictures = Eye(), Pictures()
        self.taken: list[Frame] = []
        self.capture = Capture(
            lambda: self.eye, SystemClock(), take=self.taken.append, pictures=self.pictures, **how
        )
        self.capture.start()

    def shoot(self, *times: float) -> list[Frame]:
        """The frames of pictures at these times."""
        before = len(self.taken)
        self.eye.shots.extend(times)
        until(lambda: len(self.taken) == before + len(times))
        return self.taken[before:]


@pytest.fixture
def rig() -> Iterator[Rig]:
    rig = Rig()
    yield rig
    rig.capture.close()
    until(lambda: not rig.capture._thread.is_alive(), "the thread's end")
    assert rig.eye.opened == rig.eye.closed, "nothing stays open"


def test_nothing_is_captured_unless_somebody_looks(rig: Rig) -> None:
    rig.eye.shots.append(1.0)
    assert rig.capture.report() == {"captured": 0, "open": False}
    assert rig.eye.opened == 0
    rig.capture.want(wanted=True)
    until(lambda: rig.taken)
    assert rig.capture.report() == {"captured": 1, "open": True}
    rig.capture.want(wanted=False)
    until(lambda: rig.eye.closed == 1)
    rig.eye.shots.append(2.0)
    assert rig.capture.report() == {"captured": 1, "open": False}
    rig.capture.want(wanted=True)
    until(lambda: len(rig.taken) == 2)
    assert rig.eye.numbers == [1, 2], "numbers count on"


def test_numbers_and_times_rise_whatever_the_stamps_say(rig: Rig) -> None:
    rig.capture.want(wanted=True)
    frames = rig.shoot(10.0, 10.1, 10.1, 9.0, 10.2)
    assert [frame.number for frame in frames] == [1, 2, 3, 4, 5]
    times = [frame.picture.pts for frame in frames]
    assert times == [900_000, 909_000, 909_001, 909_002, 918_000]
    assert {frame.picture.time_base for frame in frames} == {Fraction(1, RTP_HZ)}
    assert rig.pictures.age_ms(4, 10.2) == pytest.approx(1200)


def test_a_picture_of_the_former_run_is_never_fresh_in_this_one() -> None:
    """Also if each has captured only a few: a command may name the former one's for as long as it likes."""
    ages: list[float | None] = []
    for run in ("00000002d1d9b8f1", "fffffffe0c1b7a55"):
        first = first_number(run)
        rig = Rig(first=first)
        try:
            rig.capture.want(wanted=True)
            frames = rig.shoot(*(10 + i / 10 for i in range(5)))
            assert [frame.number for frame in frames] == [first + i for i in range(5)]
            assert rig.capture.report() == {"captured": 5, "open": True}
            ages += [rig.pictures.age_ms(number, 10.4) for number in (2, 4, 2**31, 2**31 + 3)]
        finally:
            rig.capture.close()
    own, late = pytest.approx, math.inf
    assert ages == [own(400), own(200), None, None, late, late, own(400), own(100)]


def test_the_numbers_of_a_run_are_within_half_of_what_a_picture_shows() -> None:
    assert [first_number(run) for run in ("0" * 16, "f" * 16)] == [1, 2**31]
    counter_bits(2**31 + 365 * 86_400 * 60)


def test_a_camera_that_fails_is_an_alarm_and_is_opened_again(rig: Rig) -> None:
    rig.capture.want(wanted=True)
    rig.shoot(1.0)
    rig.eye.shots.append(VideoError("/dev/video0 gave no picture for 2 s"))
    until(lambda: rig.eye.closed)
    (frame,) = rig.shoot(2.0)
    assert frame.number == 2
    assert rig.eye.opened == 2
    (alarm,) = [alarm for alarm in WATCH.alarms() if "camera" in alarm]
    assert "the thread camera failed and starts again: 1 time(s)" in alarm
    assert alarm.endswith("VideoError: /dev/video0 gave no picture for 2 s")


def test_after_the_end_nobody_can_look() -> None:
    rig = Rig()
    rig.capture.close()
    rig.capture.want(wanted=True)
    rig.eye.shots.append(1.0)
    until(lambda: not rig.capture._thread.is_alive(), "the thread's end")
    assert rig.eye.opened == 0


@pytest.mark.parametrize(
    ("source_hz", "rate_hz", "expected"),
    [(30, 15, 15), (30, 10, 10), (15, 15, 15), (25, 15, 12.5), (10, 15, 10)],
)
def test_a_rate_is_kept(source_hz: float, rate_hz: float, expected: float) -> None:
    pacer = Pacer(rate_hz)
    jitter = [0.0, 0.004, -0.005, 0.002, -0.003]
    times = [i / source_hz + jitter[i % 5] for i in range(round(source_hz * 20))]
    taken = sum(map(pacer.takes, times)) / 20
    assert taken == pytest.approx(expected, rel=0.25)
    assert taken <= rate_hz * 1.05


def test_after_a_pause_pictures_do_not_come_in_a_burst() -> None:
    pacer = Pacer(10)
    assert pacer.left_s(0.0) == 0
    assert pacer.takes(0.0)
    assert pacer.left_s(0.04) == pytest.approx(0.06)
    assert sum(pacer.takes(100 + i / 100) for i in range(20)) <= 3


def test_what_failed_is_told_once_nothing_waits() -> None:
    newest: Newest[int] = Newest(ManualClock(), "the camera")
    newest.put(1)
    newest.put(2)
    assert newest.take(threading.Event(), 1.0) == 2
    newest.fail(VideoError("it is gone"))
    with pytest.raises(VideoError, match="it is gone"):
        newest.take(threading.Event(), 1.0)
