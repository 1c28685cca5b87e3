"""The VESC's serial protocol: frames, their checks, and what COMM_GET_VALUES answers. Pure functions.

A frame is ``02 length payload crc crc 03``, or ``03 length length payload crc crc 03`` for a payload of
255 bytes and more; the CRC is CRC-16/XMODEM of the payload. A payload starts with its command; numbers
are big-endian integers, scaled. Firmware only ever added fields at the end, so the length tells the
version; a length that is none of those in `LAYOUTS` is refused, not guessed at.

Read off vedderb/bldc (packet.c, commands.c) from firmware 2 to 6 and the ROS 2 driver's vesc_packet.cpp.
"""

from __future__ import annotations

import binascii
import struct
from typing import Callable, NamedTuple

from iort_contract.limits import Value

COMM_FW_VERSION = 0
COMM_GET_VALUES = 4
COMM_FORWARD_CAN = 34

SHORT, LONG, END = 2, 3, 3
# The firmware's own limit (PACKET_MAX_PL_LEN) was 1024 once and is 512 today.
MAX_PAYLOAD = 1024
_LONG_FROM = 255
_MAX_FRAME = MAX_PAYLOAD + 6
_MAX_BUFFER = 4 * _MAX_FRAME


class ProtocolError(ValueError):
    """A payload that is not what it should be; the text says what it is."""


# --- frames ----------------------------------------------------------------------------------------


def frame(payload: bytes) -> bytes:
    """The payload as it goes over the line."""
    n = len(payload)
    if not 1 <= n <= MAX_PAYLOAD:
        raise ProtocolError(f"a payload of {n} bytes: allowed is 1 to {MAX_PAYLOAD}")
    head = bytes((SHORT, n)) if n <= _LONG_FROM else bytes((LONG, n >> 8, n & 0xFF))
    return head + payload + struct.pack(">HB", binascii.crc_hqx(payload, 0), END)


class FrameParser:
    """Finds the frames in a stream of bytes, whatever stands between them.

    Every place where a frame may begin is followed up, each by itself, and what turns out to have the
    right end and CRC is a frame. So neither a stray start byte nor half a frame costs the frames after
    it a byte or a moment, however the bytes are cut into chunks. Holds a few of the longest frames.

    ``skipped`` bytes and frames of ``bad_crc`` are counted when the next frame shows that they are none.
    """

    def __init__(self) -> None:
        self.bad_crc = 0
        self.skipped = 0
        self._clear()

    def _clear(self) -> None:
        self._buffer = bytearray()
        # Up to where the bytes have been looked at, and up to where they are a frame's or counted as skipped.
        self._seen = self._told = 0
        # Where a frame would end -> where it would begin and how long its head would be.
        self._ends: dict[int, list[tuple[int, int]]] = {}
        # Where something began that had a frame's end and not its CRC; within a frame that is chance.
        self._failed: list[int] = []

    @property
    def pending(self) -> int:
        """Bytes that a frame may yet be made of."""
        return len(self._buffer) - self._told

    def reset(self) -> None:
        """Forget what is begun: nothing that comes now continues it."""
        self._skip(len(self._buffer))
        self._clear()

    def feed(self, data: bytes) -> list[bytes]:
        """The payloads of the frames that these bytes complete."""
        found: list[bytes] = []
        for start in range(0, len(data), _MAX_FRAME):
            self._buffer += data[start : start + _MAX_FRAME]
            self._scan(found)
            if len(self._buffer) > _MAX_BUFFER:
                self._trim()
        return found

    def _scan(self, found: list[bytes]) -> None:
        buffer, ends = self._buffer, self._ends
        for i in range(self._seen, len(buffer)):
            byte = buffer[i]
            if i >= 1 and buffer[i - 1] == SHORT and byte:
                ends.setdefault(i + byte + 3, []).append((i - 1, 2))
            if i >= 2 and buffer[i - 2] == LONG:
                length = buffer[i - 1] << 8 | byte
                if _LONG_FROM <= length <= MAX_PAYLOAD:
                    ends.setdefault(i + length + 3, []).append((i - 2, 3))
            for begin, head in ends.pop(i, ()):
                if byte != END:
                    continue
                payload = bytes(buffer[begin + head : i - 2])
                if binascii.crc_hqx(payload, 0) == buffer[i - 2] << 8 | buffer[i - 1]:
                    found.append(payload)
                    self._skip(begin)
                    self._told = i + 1
                    self._failed = []
                elif begin >= self._told:
                    self._failed.append(begin)
        self._seen = len(buffer)

    def _skip(self, end: int) -> None:
        """Count the bytes before the end that are no frame's, and the broken frames among them."""
        self.skipped += max(0, end - self._told)
        self._told = max(end, self._told)
        self.bad_crc += sum(begin < end for begin in self._failed)
        self._failed = [begin for begin in self._failed if begin >= end]

    def _trim(self) -> None:
        # Whatever begins before the longest frame that ends here has been decided on.
        gone = len(self._buffer) - _MAX_FRAME
        self._skip(gone)
        del self._buffer[:gone]
        self._seen -= gone
        self._told -= gone
        self._failed = [begin - gone for begin in self._failed]
        self._ends = {
            end - gone: [(begin - gone, head) for begin, head in begins] for end, begins in self._ends.items()
        }


# --- requests ----------------------------------------------------------------------------------------


def request(command: int, can_id: int | None = None) -> bytes:
    """The frame that asks for something: the controller on the line, or one behind it on the CAN bus."""
    if can_id is None:
        return frame(bytes((command,)))
    return frame(bytes((COMM_FORWARD_CAN, can_id, command)))


# --- answers -----------------------------------------------------------------------------------------


class Firmware(NamedTuple):
    """What COMM_FW_VERSION answers; old firmware does not name its hardware."""

    major: int
    minor: int
    hardware: str

    def __str__(self) -> str:
        on = f" on {self.hardware}" if self.hardware else ""
        return f"firmware {self.major}.{self.minor:02}{on}"


def decode_firmware(payload: bytes) -> Firmware:
    """The version in an answer to COMM_FW_VERSION. Raises `ProtocolError`."""
    if len(payload) < 3 or payload[0] != COMM_FW_VERSION:
        raise ProtocolError(f"{len(payload)} bytes are no firmware version")
    name = payload[3:].split(b"\0", 1)[0].decode("ascii", "replace")
    return Firmware(payload[1], payload[2], name if name.isprintable() else "")


class _Number(NamedTuple):
    """A number on the wire: its name, its `struct` code and what it is divided by."""

    name: str
    code: str
    scale: float = 1.0


_COUNTERS = (
    _Number("charge_drawn", "i"),
    _Number("charge_regen", "i"),
    _Number("energy_drawn", "i"),
    _Number("energy_regen", "i"),
    _Number("displacement", "i"),
    _Number("distance_traveled", "i"),
    _Number("fault_code", "B"),
)
# Firmware 3 to 6. The ROS 2 message has all but `status`: 1 the controller has stopped the motor
# because no command came in time, 2 the kill switch is active.
_NUMBERS = (
    _Number("temp_fet", "h", 10.0),
    _Number("temp_motor", "h", 10.0),
    _Number("current_motor", "i", 100.0),
    _Number("current_input", "i", 100.0),
    _Number("avg_id", "i", 100.0),
    _Number("avg_iq", "i", 100.0),
    _Number("duty_cycle", "h", 1000.0),
    _Number("speed", "i"),
    _Number("voltage_input", "h", 10.0),
    *_COUNTERS,
    _Number("pid_pos_now", "i", 1e6),
    _Number("controller_id", "B"),
    _Number("ntc_temp_mos1", "h", 10.0),
    _Number("ntc_temp_mos2", "h", 10.0),
    _Number("ntc_temp_mos3", "h", 10.0),
    _Number("avg_vd", "i", 1000.0),
    _Number("avg_vq", "i", 1000.0),
    _Number("status", "B"),
)
# Firmware 2, which the PyPI package pyvesc expects of every controller.
_NUMBERS_2 = (
    *(_Number(f"ntc_temp_mos{i}", "h", 10.0) for i in range(1, 7)),
    _Number("temperature_pcb", "h", 10.0),
    _Number("current_motor", "i", 100.0),
    _Number("current_input", "i", 100.0),
    _Number("duty_cycle", "h", 1000.0),
    _Number("speed", "i"),
    _Number("voltage_input", "h", 10.0),
    *_COUNTERS,
)

Decode = Callable[[bytes], "dict[str, Value]"]


def _decoder(numbers: tuple[_Number, ...]) -> tuple[int, Decode]:
    """The length of the payload and the function that decodes it."""
    layout = struct.Struct(">x" + "".join(number.code for number in numbers))
    scaled = tuple((number.name, number.scale) for number in numbers)

    def decode(payload: bytes) -> dict[str, Value]:
        return {
            name: raw if scale == 1.0 else raw / scale
            for (name, scale), raw in zip(scaled, layout.unpack(payload))
        }

    return layout.size, decode


def _up_to(last: str) -> tuple[_Number, ...]:
    names = [number.name for number in _NUMBERS]
    return _NUMBERS[: names.index(last) + 1]


# By the payload's length, the command included: 54, 58, 59, 65, 73, 74 and 56 bytes.
LAYOUTS: dict[int, Decode] = dict(
    [
        *(
            _decoder(_up_to(last))
            for last in ("fault_code", "pid_pos_now", "controller_id", "ntc_temp_mos3", "avg_vq", "status")
        ),
        _decoder(_NUMBERS_2),
    ]
)


def decode_values(payload: bytes) -> dict[str, Value]:
    """The sample in an answer to COMM_GET_VALUES, in the contract's names and units.

    Raises `ProtocolError` for a length that no known firmware sends.
    """
    decode = LAYOUTS.get(len(payload))
    if decode is None or payload[0] != COMM_GET_VALUES:
        known = ", ".join(map(str, sorted(LAYOUTS)))
        raise ProtocolError(f"values of {len(payload)} bytes; known are those of {known}")
    return decode(payload)
