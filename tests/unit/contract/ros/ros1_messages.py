"""ROS 1 messages as publishers write them: definitions, and bytes assembled by hand."""

from __future__ import annotations

import struct

LINE = "=" * 80 + "\n"
HEADER = """
================================================================================
MSG: std_msgs/Header
# the sequence ID: consecutively increasing
uint32 seq
time stamp
string frame_id
"""


def u32(*values: int) -> bytes:
    return struct.pack(f"<{len(values)}I", *values)


def text(value: str) -> bytes:
    return u32(len(value.encode())) + value.encode()


def header(sec: int = 5, nanosec: int = 7000, frame: str = "base_link") -> bytes:
    return u32(1, sec, nanosec) + text(frame)


STAMPED = "Header header\nB b" + HEADER + "=" * 80 + "\nMSG: a_msgs/B\n"
