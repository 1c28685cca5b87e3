"""The VESC's serial protocol: frames, their checks, and what COMM_GET_VALUES answers. Pure functions.

A frame is ``02 length payload crc crc 03``, or ``03 length length payload crc crc 03`` for a payload of 255
bytes and more; the CRC is CRC-16/XMODEM of the payload. A payload starts with its command, and its numbers
are scaled big-endian integers. Firmware only ever added fields at the end, so the length tells the version; a
length that is not in `LAYOUTS` is rejected.

The sources are vedderb/bldc (packet.c, commands.c), firmware 2 to 6, and the ROS 2 driver's vesc_packet.cpp.
"""

from __future__ import annotations

import binascii
import struct
from typing import Iterator, NamedTuple

from iort_contract.limits import Value

COMM_GET_VALUES = 4
COMM_FORWARD_CAN = 34

SHORT, LONG, END = 2, 3, 3
# The firmware's own limit (PACKET_MAX_PL_LEN) was 1024 and is 512 today.
MAX_PAYLOAD = 1024
_LONG_FROM = 255
_MAX_FRAME = MAX_PAYLOAD + 6
_MAX_BUFFER = 4 * _MAX_FRAME


class ProtocolError(ValueError):
    """A payload that the protocol does not allow."""


def frame(payload: bytes) -> bytes:
    """The payload as it goes over the line."""
    n = len(payload)
    if not 1 <= n <= MAX_PAYLOAD:
        raise ProtocolError(f"a payload must have 1 to {MAX_PAYLOAD} bytes, got {n} bytes")
    head = bytes((SHORT, n)) if n <= _LONG_FROM else bytes((LONG, n >> 8, n & 0xFF))
    return head + payload + struct.pack(">HB", binascii.crc_hqx(payload, 0), END)


class FrameParser:
    """Finds the frames in a stream of bytes, whatever is between them.

    The parser follows every place where a frame may begin, and accepts each with the right end and CRC. So a
    stray start byte or half a frame neither loses nor delays the frames after it, however the bytes are cut
    into chunks. The parser holds a few of the longest frames.

    ``skipped`` bytes and frames of ``bad_crc`` are counted once the next frame shows that they are not part
    of a frame.
    """

    def __init__(self) -> None:
        self.bad_crc = 0
        self.skipped = 0
        self._buffer = bytearray()
        # The end of the bytes that have been scanned, and of those that are a frame's or counted as skipped.
        self._seen = self._counted = 0
        # The possible end of a frame -> its possible beginnings and the lengths of their heads.
        self._ends: dict[int, list[tuple[int, int]]] = {}
        # The beginnings of frames with the right end and a wrong CRC; within a frame they are chance.
        self._failed: list[int] = []

    @property
    def pending(self) -> int:
        """The bytes that may still become a frame."""
        return len(self._buffer) - self._counted

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
                    self._counted = i + 1
                    self._failed = []
                elif begin >= self._counted:
                    self._failed.append(begin)
        self._seen = len(buffer)

    def _skip(self, end: int) -> None:
        """Count the bytes before the end that are in no frame, and the broken frames among them."""
        self.skipped += max(0, end - self._counted)
        self._counted = max(end, self._counted)
        self.bad_crc += sum(begin < end for begin in self._failed)
        self._failed = [begin for begin in self._failed if begin >= end]

    def _trim(self) -> None:
        # A frame that begins earlier has ended by now, even the longest.
        gone = len(self._buffer) - _MAX_FRAME
        self._skip(gone)
        del self._buffer[:gone]
        self._seen -= gone
        self._counted -= gone
        self._failed = [begin - gone for begin in self._failed]
        self._ends = {
            end - gone: [(begin - gone, head) for begin, head in begins] for end, begins in self._ends.items()
        }


def request(command: int, can_id: int | None = None) -> bytes:
    """The frame of a command to the controller on the line, or through it to one on the CAN bus."""
    if can_id is None:
        return frame(bytes((command,)))
    return frame(bytes((COMM_FORWARD_CAN, can_id, command)))


class _Number(NamedTuple):
    """A number on the wire: its name, its `struct` code, and its divisor."""

    name: str
    code: str
    scale: float = 1.0


_COUNTERS = (
    *(_Number(f"{what}_{way}", "i") for what in ("charge", "energy") for way in ("drawn", "regen")),
    _Number("displacement", "i"),
    _Number("distance_traveled", "i"),
    _Number("fault_code", "B"),
)
# Firmware 3 to 6. The ROS 2 message has all but `status`: 1 if the controller has stopped the motor because
# no command came in time, 2 if the kill switch is active.
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
    *(_Number(f"ntc_temp_mos{i}", "h", 10.0) for i in range(1, 4)),
    _Number("avg_vd", "i", 1000.0),
    _Number("avg_vq", "i", 1000.0),
    _Number("status", "B"),
)
# Firmware 2, which is the only one that the PyPI package pyvesc knows.
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


class _Layout(NamedTuple):
    struct: struct.Struct
    numbers: tuple[_Number, ...]


def _layout(numbers: tuple[_Number, ...]) -> _Layout:
    return _Layout(struct.Struct(">x" + "".join(number.code for number in numbers)), numbers)


def _layouts() -> Iterator[_Layout]:
    yield _layout(_NUMBERS_2)
    for i, number in enumerate(_NUMBERS, 1):
        if number.name in _LAST:
            yield _layout(_NUMBERS[:i])


# The last number of each firmware's answer.
_LAST = ("fault_code", "pid_pos_now", "controller_id", "ntc_temp_mos3", "avg_vq", "status")
# By the payload's length, the command included: 56, 54, 58, 59, 65, 73 and 74 bytes.
LAYOUTS = {layout.struct.size: layout for layout in _layouts()}


def decode_values(payload: bytes) -> dict[str, Value]:
    """The sample in an answer to COMM_GET_VALUES, in the contract's names and units.

    Raises `ProtocolError` for a length that no known firmware sends.
    """
    layout = LAYOUTS.get(len(payload))
    if layout is None or payload[0] != COMM_GET_VALUES:
        known = ", ".join(map(str, sorted(LAYOUTS)))
        raise ProtocolError(f"values must have one of {known} bytes, got {len(payload)} bytes")
    return {
        number.name: raw if number.scale == 1.0 else raw / number.scale
        for number, raw in zip(layout.numbers, layout.struct.unpack(payload))
    }
