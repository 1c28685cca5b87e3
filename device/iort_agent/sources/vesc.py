"""Polls a VESC for its values over its serial line, at a set rate.

One request is open at a time. Each is sent at its absolute deadline, or as soon as the answer before it is
there; a slow line or controller skips deadlines, which are counted. Answers carry neither time nor number, so
a sample's time is the middle between request and answer, by the machine's clock. The error is at most half
the round trip: about 4 ms at 115200 baud, and below 1 ms over USB. An answer after its timeout is dropped,
unless the next request is already out: then it is taken for that one's.

The port is opened by its path again and again until it is there, and again when it goes away: name it by
``/dev/serial/by-id/...``, which does not change with the numbers. The open port is locked, because two
programs that read one port each get half of the bytes.
"""

from __future__ import annotations

import errno
import importlib.util
import logging
import os
import random
import stat
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Iterator, Mapping, Sequence

from iort_agent.common.schema import number, setting, text
from iort_agent.common.threads import Clock
from iort_agent.errors import SourceError
from iort_agent.sources import FAIL, OK, Emit, Finding, SourceConfig
from iort_agent.sources.vesc_protocol import (
    COMM_GET_VALUES,
    FrameParser,
    ProtocolError,
    decode_values,
    frame,
    request,
)
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.topics import check_stream


def load_pyserial() -> tuple[Any, tuple[type[Exception], ...]]:
    """The port of pyserial, and the errors of one that is not there, goes away or misbehaves. Raises
    `SourceError` if it is not installed."""
    try:
        # Only a robot that reads its VESC by itself needs it: pip install iort-agent[serial].
        import termios  # noqa: PLC0415 - only where there is a port

        import serial  # noqa: PLC0415 - optional
    except ImportError as error:
        raise SourceError(
            "reading a VESC needs the package pyserial: pip install 'iort-agent[serial]'"
        ) from error
    return serial.Serial, (OSError, termios.error)


def why(error: Exception, *, was_open: bool) -> str:
    """The operating system's error, in words that help."""
    # pyserial keeps the number of some errors, and only chains others.
    numbers = {first for e in (error, error.__context__) if e is not None for first in e.args[:1]}
    if numbers & {errno.ENOENT, errno.ENODEV, errno.ENXIO}:
        return "is not there: waiting for it to be plugged in"
    if numbers & {errno.EACCES, errno.EPERM}:
        return "may not be opened: add the user to its group, mostly `sudo usermod -aG dialout $USER`"
    if numbers & {errno.EBUSY, errno.EAGAIN}:
        return "is in use by another program, perhaps the ROS driver of the VESC"
    if errno.ENOTTY in numbers:
        return "is no serial port"
    return f"went away: {error}" if was_open else f"cannot be opened: {error}"


_log = logging.getLogger(__name__)

# A read returns after this at the latest, so that a stop is noticed.
_READ_S = 0.05
# After this long without an answer a warning is logged, and after `_REOPEN_S` the port is opened again.
_SILENT_S = 1.0
_REOPEN_S = 3.0
_BACKOFF_S = (0.1, 2.0)
_REPORT_S = 60.0


@dataclass(frozen=True)
class VescConfig(SourceConfig):
    """A VESC on a serial port.

    ``can_id`` asks the controller with that id on the CAN bus, through the one on the port. ``timeout_s``
    is how long an answer may take. 115200 baud carry about 130 answers a second; USB has no baud rate.
    """

    port: str = setting(text())
    baudrate: int = setting(number(1200, 4_000_000, whole=True, unit="baud"), 115200)
    rate_hz: float = setting(number(1, 1000, unit="Hz"), 50.0)
    stream: str = setting(text(check_stream), VESC_STREAM)
    can_id: int | None = setting(number(0, 254, whole=True), None)
    timeout_s: float = setting(number(0.01, 5, unit="s"), 0.2)

    def streams(self) -> Sequence[str]:
        return [self.stream]

    def describe(self) -> str:
        behind = "" if self.can_id is None else f", CAN id {self.can_id},"
        return f"VESC on {self.port}{behind} at {self.rate_hz:g} Hz"

    def build(self, clock: Clock) -> VescSource:
        return VescSource(self, clock)

    def check(self, title: str) -> Iterator[Finding]:
        """Whether pyserial and the port are there, and the port may be opened."""
        if importlib.util.find_spec("serial") is None:
            yield Finding(title, FAIL, "Python finds no pyserial", "pip install 'iort-agent[serial]'")
        port = Path(self.port)
        if not port.exists():
            todo = "is the VESC plugged in and switched on? The agent waits for it. `ls /dev/serial/by-id`"
            yield Finding(title, FAIL, f"{port} is not there", todo)
        elif not stat.S_ISCHR(port.stat().st_mode):
            yield Finding(title, FAIL, f"{port} is no serial port")
        elif not os.access(port, os.R_OK | os.W_OK):
            todo = "sudo usermod -aG dialout $USER, then log in again"
            yield Finding(title, FAIL, f"{port} may not be opened", todo)
        else:
            yield Finding(title, OK, f"{port} is there")


@dataclass
class VescCounts:
    """Counts of requests, answers and noise on the line.

    ``timeouts`` were not answered in time, and ``late`` answers came after that. ``skipped_polls`` are
    deadlines that passed while another request was open. ``unknown`` answers have a length of no known
    firmware. ``bad_crc`` counts frames, ``garbage`` bytes.
    """

    samples: int = 0
    timeouts: int = 0
    late: int = 0
    skipped_polls: int = 0
    unknown: int = 0
    bad_crc: int = 0
    garbage: int = 0
    opened: int = 0


class VescSource:
    """Emits a sample for each answer until it is stopped."""

    def __init__(self, config: VescConfig, clock: Clock) -> None:
        self.counts = VescCounts()
        self._config = config
        self._clock = clock
        self._trouble = ""
        self._unknown: set[int] = set()

    def report(self) -> Mapping[str, Any]:
        """The samples, and the problems of the line."""
        return vars(self.counts)

    def run(self, emit: Emit, stop: threading.Event) -> None:
        """Poll until ``stop`` is set. Raises `SourceError` without pyserial."""
        serial_port, errors = load_pyserial()
        backoff_s = _BACKOFF_S[0]
        while not stop.is_set():
            samples, opened = self.counts.samples, self.counts.opened
            try:
                with self._open(serial_port) as port:
                    self.counts.opened += 1
                    _Session(self._config, self._clock, self, port).run(emit, stop)
            except errors as error:
                self.trouble(why(error, was_open=self.counts.opened > opened))
            if self.counts.samples > samples:
                backoff_s = _BACKOFF_S[0]
            # Jitter, because other programs may wait for this port, too.
            self._clock.wait(stop, backoff_s * random.uniform(0.5, 1.0))  # noqa: S311 - jitter, not secrets
            backoff_s = min(_BACKOFF_S[1], backoff_s * 2)
        _log.info("%s: %s", self._config.port, ", ".join(f"{k} {v}" for k, v in vars(self.counts).items()))

    def trouble(self, what: str) -> None:
        """Log why no samples come, once until it changes."""
        if what != self._trouble:
            _log.warning("%s: %s", self._config.port, what)
        self._trouble = what

    def answered(self) -> None:
        """Count a sample, which ends the trouble."""
        self.counts.samples += 1
        if self._trouble:
            _log.info("%s: samples are coming again", self._config.port)
            self._trouble = ""

    def unknown(self, payload: bytes, error: ProtocolError) -> None:
        """Count an answer that cannot be decoded, and log each length once."""
        self.counts.unknown += 1
        if len(payload) not in self._unknown:
            self._unknown.add(len(payload))
            _log.error("%s: the answer is dropped: %s", self._config.port, error)

    def _open(self, serial_port: Any) -> Any:
        config = self._config
        port = serial_port(
            config.port,
            config.baudrate,
            timeout=min(_READ_S, config.timeout_s),
            write_timeout=max(_READ_S, config.timeout_s),
            exclusive=True,
        )
        port.reset_input_buffer()
        return port


class _Session:
    """The time from opening the port until it fails, or has been silent for too long."""

    def __init__(self, config: VescConfig, clock: Clock, source: VescSource, port: Any) -> None:
        self._config = config
        self._clock = clock
        self._source = source
        self._counts = source.counts
        self._port = port
        self._parser = FrameParser()
        self._garbage = self._bad_crc = 0
        # The bytes that a read waits for; the known length of an answer saves most of the reads.
        self._expected = 1
        self._answered = clock.monotonic()
        self._next_report = clock.monotonic() + _REPORT_S

    def run(self, emit: Emit, stop: threading.Event) -> None:
        config, clock = self._config, self._clock
        _log.info("%s: open", config.port)
        ask = request(COMM_GET_VALUES, config.can_id)
        self._answered = start = clock.monotonic()
        tick = 0
        while not stop.is_set():
            wait_s = start + tick / config.rate_hz - clock.monotonic()
            if wait_s > 0 and clock.wait(stop, wait_s):
                return
            sent = clock.monotonic()
            self._drop_late()
            payload = self._ask(ask, stop)
            if payload is not None:
                self._take(payload, sent, emit)
            elif not stop.is_set() and not self._is_worth_waiting():
                return
            # The next deadline, or the newest that has passed already: that one is met late.
            due = max(tick + 1, int((clock.monotonic() - start) * config.rate_hz))
            if due > tick + 1:
                self._counts.skipped_polls += due - tick - 1
                self._report_slowness()
            tick = due

    def _take(self, payload: bytes, sent: float, emit: Emit) -> None:
        round_trip_us = round((self._clock.monotonic() - sent) * 1_000_000)
        t_us = self._clock.now_us() - round_trip_us // 2
        self._answered = self._clock.monotonic()
        try:
            values = decode_values(payload)
        except ProtocolError as error:
            self._source.unknown(payload, error)
            return
        self._expected = len(frame(payload))
        self._source.answered()
        emit(self._config.stream, t_us, values)

    def _is_worth_waiting(self) -> bool:
        """Count a request without an answer; False if the port should be opened again."""
        self._counts.timeouts += 1
        silent_s = self._clock.monotonic() - self._answered
        if silent_s >= _SILENT_S:
            can_id = self._config.can_id
            behind = "" if can_id is None else f", a controller with CAN id {can_id}"
            noise = self._garbage or self._parser.pending
            heard = " (the bytes that come are no frame: is the baud rate right?)" if noise else ""
            self._source.trouble(f"open, but no answer: is it a VESC{behind}, powered, UART enabled?{heard}")
        return silent_s < max(_REOPEN_S, 3 * self._config.timeout_s)

    def _ask(self, ask: bytes, stop: threading.Event) -> bytes | None:
        """Send a request and wait for its answer; None after the timeout."""
        self._port.write(ask)
        deadline = self._clock.monotonic() + self._config.timeout_s
        wanted = self._expected
        while not stop.is_set():
            for payload in self._read(wanted):
                if payload[0] == COMM_GET_VALUES:
                    return payload
            if self._clock.monotonic() >= deadline:
                return None
            wanted = 1
        return None

    def _drop_late(self) -> None:
        """Drop the answers that came after their timeout."""
        if self._port.in_waiting:
            self._counts.late += sum(payload[0] == COMM_GET_VALUES for payload in self._read(1))

    def _read(self, wanted: int) -> list[bytes]:
        parser, counts = self._parser, self._counts
        payloads = parser.feed(self._port.read(max(wanted, self._port.in_waiting)))
        counts.garbage += parser.skipped - self._garbage
        counts.bad_crc += parser.bad_crc - self._bad_crc
        self._garbage, self._bad_crc = parser.skipped, parser.bad_crc
        return payloads

    def _report_slowness(self) -> None:
        now = self._clock.monotonic()
        if now >= self._next_report:
            self._next_report = now + _REPORT_S
            counts, config = self._counts, self._config
            text = "%s: too slow for %g Hz: %d samples and %d skipped polls since the start"
            _log.warning(text, config.port, config.rate_hz, counts.samples, counts.skipped_polls)
