"""ROS 1 messages as publishers write them: definitions, and bytes assembled by hand."""

from __future__ import annotations

import struct

from iort_contract.ros.definition import RULE

LINE = f"{RULE}\n"
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


STAMPED = "Header header\nB b" + HEADER + LINE + "MSG: a_msgs/B\n"


def nested(length: str, leaf: str) -> str:
    """A definition of 20 types within each other, by arrays of a length or nine fields each."""
    kinds = [f"T{i}" for i in range(20)]
    line = "".join(f"{{0}}{length} a{i}\n" for i in range(9 if not length else 1))
    definition = line.format(kinds[0])
    for kind, inner in zip(kinds, kinds[1:]):
        definition += f"{LINE}MSG: a_msgs/{kind}\n{line.format(inner)}"
    definition += f"{LINE}MSG: a_msgs/{kinds[-1]}\n{leaf}\n"
    return definition
