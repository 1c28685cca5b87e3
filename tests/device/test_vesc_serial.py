"""The VESC source over a real pseudo-terminal, against a stand-in with faults."""

from __future__ import annotations

import logging
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import serial

from iort_agent.common.threads import SystemClock
from iort_agent.config import load_config
from iort_agent.errors import SourceError
from iort_agent.sources.vesc import VescConfig, why
from testkit.waiting import GUARD_S, until
from tests.device.running import Running
from tests.unit.agent.test_agent import config_file
from tests.vesc_standin import FIRMWARE, VescStandin, framed, values


def numbers(running: Running) -> list[int]:
    return [values["displacement"] for _, _, values in running.samples]


@pytest.fixture
def vesc(tmp_path: Path) -> Iterator[VescStandin]:
    with VescStandin(tmp_path / "usb-STMicroelectronics_ChibiOS_RT_Virtual_COM_Port") as standin:
        yield standin


@pytest.fixture
def log(caplog: pytest.LogCaptureFixture) -> pytest.LogCaptureFixture:
    caplog.set_level(logging.DEBUG, "iort_agent")
    return caplog


def config(vesc: VescStandin, **settings: Any) -> VescConfig:
    return VescConfig(port=str(vesc.link), **{"rate_hz": 200.0, "timeout_s": 10.0, **settings})


def test_values_arrive_at_the_configured_rate(vesc: VescStandin, log: pytest.LogCaptureFixture) -> None:
    started = time.time_ns() // 1000
    with Running(config(vesc)) as running:
        running.wait_for(200)
    ended = time.time_ns() // 1000
    assert numbers(running) == list(range(len(running.samples)))
    stream, _, first = running.samples[0]
    assert (stream, first["voltage_input"], first["charge_drawn"]) == ("vesc", 11.8, 281)
    times = [t_us for _, t_us, _ in running.samples]
    assert started < times[0] < times[-1] < ended
    # Deadlines are 5 ms apart; a busy machine may skip some, and the first may be late.
    assert times[199] - times[0] > 199 * 5_000 / 2
    assert "WARNING" not in log.text


def test_a_controller_behind_the_can_bus_is_read(vesc: VescStandin) -> None:
    with Running(config(vesc, can_id=17, stream="rear")) as running:
        running.wait_for(5)
    assert set(vesc.asked) == {b"\x22\x11\x04"}
    assert (running.samples[0][0], running.samples[0][2]["controller_id"]) == ("rear", 17)


def test_garbage_around_every_answer_costs_no_sample(vesc: VescStandin) -> None:
    noise = b"\x02\x03\xff\x00\x02\x4a\x04"
    vesc.answer = lambda frame, n: [noise, frame[:30], frame[30:], noise]
    with Running(config(vesc)) as running:
        running.wait_for(100)
    counts = running.source.counts
    assert numbers(running) == list(range(len(running.samples)))
    assert counts.timeouts == 0
    assert counts.garbage >= 99 * 2 * len(noise) - 100
    assert running.samples[50][2]["voltage_input"] == 11.8


def test_unrequested_frames_are_ignored(vesc: VescStandin) -> None:
    """A script on the controller prints; another program's answer is still in transit."""
    vesc.answer = lambda frame, n: [framed(b"\x15hello"), framed(FIRMWARE), frame]
    with Running(config(vesc)) as running:
        running.wait_for(20)
    assert numbers(running) == list(range(len(running.samples)))
    assert (running.source.counts.unknown, running.source.counts.timeouts) == (0, 0)


def test_a_broken_frame_costs_only_its_own_sample(vesc: VescStandin, log: pytest.LogCaptureFixture) -> None:
    def answer(frame: bytes, n: int) -> list[bytes]:
        if n % 10 == 3:
            return [frame[:40]]
        if n % 10 == 7:
            return [frame[:20] + bytes([frame[20] ^ 0x40]) + frame[21:]]
        return [frame]

    vesc.answer = answer
    with Running(config(vesc, timeout_s=0.4)) as running:
        running.wait_for(24)
    counts = running.source.counts
    got = numbers(running)
    assert got == sorted(set(got))
    assert {n % 10 for n in got} == {0, 1, 2, 4, 5, 6, 8, 9}
    # Each loss has its own timeout; a busy machine has more of them.
    assert vesc.sent - len(got) <= counts.timeouts + 1
    assert counts.timeouts >= 5
    assert counts.bad_crc >= 2
    assert counts.opened == 1, "the port stays open"
    assert "WARNING" not in log.text, "no warning is logged"


def test_an_unknown_length_is_logged_once_and_never_misread(
    vesc: VescStandin, log: pytest.LogCaptureFixture
) -> None:
    vesc.answer = lambda frame, n: [framed(values(n) + b"\x00\x00")]
    with Running(config(vesc)) as running:
        until(lambda: running.source.counts.unknown >= 20)
    assert running.samples == []
    errors = [record for record in log.records if record.levelno >= logging.WARNING]
    assert len(errors) == 1
    assert "values must have one of 54, 56, 58, 59, 65, 73, 74 bytes, got 76" in errors[0].getMessage()


def test_a_late_answer_is_not_used_for_the_next_request(vesc: VescStandin) -> None:
    """The second answer comes only after its timeout, before the next request."""
    kept: list[tuple[bytes, int]] = []

    def answer(frame: bytes, n: int) -> list[bytes]:
        if n == 1:
            kept.append((frame, running.source.counts.timeouts))
            return []
        return [frame]

    running = Running(config(vesc, rate_hz=0.5, timeout_s=0.3))
    vesc.answer = answer
    with running:
        until(lambda: kept and running.source.counts.timeouts > kept[0][1])
        vesc.say(kept[0][0])
        until(lambda: any(n > 1 for n in numbers(running)))
        until(lambda: running.source.counts.late >= 1)
    assert 1 not in numbers(running)


def test_the_source_resumes_after_a_replug(vesc: VescStandin, log: pytest.LogCaptureFixture) -> None:
    with Running(config(vesc)) as running:
        for i in range(3):
            running.wait_for(10, more=True)
            vesc.unplug()
            until(lambda: log.text.count("waiting for it to be plugged in") == i + 1)  # noqa: B023 - called within the iteration
            vesc.plug()
        running.wait_for(10, more=True)
        assert running.source.counts.opened == 4
    assert log.text.count("samples are coming again") == 3
    assert numbers(running) == sorted(set(numbers(running))), "no sample is repeated"


def test_the_source_finds_a_controller_plugged_in_later(
    tmp_path: Path, log: pytest.LogCaptureFixture
) -> None:
    vesc = VescStandin(tmp_path / "vesc")
    with Running(config(vesc)) as running:
        until(lambda: "waiting for it to be plugged in" in log.text)
        with vesc:
            running.wait_for(3)


def test_silence_is_reported_and_overcome(vesc: VescStandin, log: pytest.LogCaptureFixture) -> None:
    with Running(config(vesc, timeout_s=0.05)) as running:
        running.wait_for(5)
        vesc.answer = lambda frame, n: []
        until(lambda: "no answer: is it a VESC" in log.text)
        until(lambda: running.source.counts.opened >= 2)
        vesc.answer = lambda frame, n: [frame]
        running.wait_for(5, more=True)
    assert log.text.count("no answer: is it a VESC") == 1
    assert log.text.count("samples are coming again") == 1


def test_a_wrong_baud_rate_is_reported_as_noise(vesc: VescStandin, log: pytest.LogCaptureFixture) -> None:
    vesc.answer = lambda frame, n: [bytes(byte ^ 0x5A for byte in frame) * 20]
    with Running(config(vesc, timeout_s=0.05)):
        until(lambda: "is the baud rate right?" in log.text)


def test_a_slow_controller_skips_polls_and_never_queues(vesc: VescStandin) -> None:
    release = threading.Semaphore(0)

    def answer(frame: bytes, n: int) -> list[bytes]:
        release.acquire(timeout=0.02)
        return [frame]

    vesc.answer = answer
    with Running(config(vesc, rate_hz=1000.0)) as running:
        running.wait_for(20)
    counts = running.source.counts
    assert numbers(running) == list(range(len(running.samples)))
    assert counts.skipped_polls > 10 * 20
    assert counts.timeouts == 0


def test_two_programs_cannot_share_the_port(vesc: VescStandin, log: pytest.LogCaptureFixture) -> None:
    with Running(config(vesc)) as first:
        first.wait_for(3)
        with Running(config(vesc)) as second:
            until(lambda: "in use by another program" in log.text)
        assert second.samples == []
        first.wait_for(3, more=True)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda path: path.write_bytes(b""), "is no serial port"),
        (lambda path: path.mkdir(), "cannot be opened"),
    ],
)
def test_a_file_other_than_a_serial_port_is_reported(
    tmp_path: Path, log: pytest.LogCaptureFixture, make: Callable[[Path], Any], words: str
) -> None:
    make(tmp_path / "port")
    with Running(VescConfig(port=str(tmp_path / "port"))):
        until(lambda: words in log.text)


def test_an_error_names_the_group_of_the_port() -> None:
    error = serial.SerialException(13, "could not open port /dev/ttyACM0: Permission denied")
    assert "usermod -aG dialout" in why(error, was_open=False)


@pytest.mark.parametrize("trouble", ["plugged", "silent", "absent"])
def test_the_source_stops_at_once(vesc: VescStandin, trouble: str) -> None:
    if trouble == "silent":
        vesc.answer = lambda frame, n: []
    if trouble == "absent":
        vesc.unplug()
    with Running(config(vesc, timeout_s=30.0)) as running:
        until(lambda: trouble == "absent" or bool(vesc.asked))
        running.stop.set()
        running.thread.join(GUARD_S)
        assert not running.thread.is_alive(), "it waited for an answer"


def test_an_error_names_the_missing_pyserial_package(
    vesc: VescStandin, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "serial", None)
    with pytest.raises(SourceError, match=r"pip install 'iort-agent\[serial\]'"):
        config(vesc).build(SystemClock()).run(lambda *_: None, threading.Event())


def test_the_configuration_is_validated(tmp_path: Path) -> None:
    rear_yaml = "port: /dev/vesc2, baudrate: 57600, rate_hz: 20, stream: rear, can_id: 3"
    file = config_file(tmp_path, f"{{type: vesc, port: /dev/vesc}}, {{type: vesc, {rear_yaml}}}")
    front, rear = load_config(file).sources
    assert front == VescConfig(port="/dev/vesc")
    assert rear.describe() == "VESC on /dev/vesc2, CAN id 3, at 20 Hz"
    assert (list(front.streams()), list(rear.streams())) == (["vesc"], ["rear"])
