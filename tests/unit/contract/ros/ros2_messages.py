"""ROS 2 messages as middlewares write them: definitions, and bytes of CDR assembled by hand."""

from __future__ import annotations

import struct

from tests.unit.contract.ros.ros1_messages import LINE

HEADER = f"\n{LINE}MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
STAMPED = f"std_msgs/Header header\nB b{HEADER}{LINE}MSG: a_msgs/B\n"


class Cdr:
    """Writes values one behind the other, each aligned."""

    def __init__(self, order: str = "<") -> None:
        self._order = order
        self.data = b"\0\1\0\0" if order == "<" else b"\0\0\0\0"

    def put(self, letter: str, *values: float) -> Cdr:
        """Add numbers of a type of `struct`."""
        for value in values:
            size = struct.calcsize(letter)
            self.data += bytes(-(len(self.data) - 4) % size) + struct.pack(self._order + letter, value)
        return self

    def text(self, *values: str) -> Cdr:
        """Add strings."""
        for value in values:
            content = value.encode() + b"\0"
            self.put("I", len(content)).data += content
        return self

    def wide(self, value: str) -> Cdr:
        """Add a wstring."""
        units = struct.unpack(f"<{len(value.encode('utf-16-le')) // 2}H", value.encode("utf-16-le"))
        return self.put("I", len(units), *units)

    def header(self, sec: int = 5, nanosec: int = 7000, frame: str = "base_link") -> Cdr:
        """Add a header."""
        return self.put("i", sec).put("I", nanosec).text(frame)
