"""Pictures for the event recorder: `sensor_msgs/CompressedImage` with a JPEG, in the form of the robot's ROS.

The header's stamp is the capture time, and its ``frame_id`` the picture's number, which commands name; in
ROS 1 its ``seq``, too."""

from __future__ import annotations

import struct
from typing import Callable

from iort_agent.video import Frame
from iort_agent.video.pictures import jpeg
from iort_contract.ros.definition import md5sum, parse
from iort_contract.ros.message import RosMessage, RosType

TOPIC, STREAM = "/iort/video/compressed", "pictures"
# Of the whole size; a ring is of minutes, and a driver's picture must be seen again.
_QUALITY = 60
_RULE = "=" * 80
_STAMPS = {1: "uint32 seq\ntime stamp", 2: "builtin_interfaces/Time stamp"}
_KINDS = {1: "sensor_msgs/CompressedImage", 2: "sensor_msgs/msg/CompressedImage"}
_TIME = f"{_RULE}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
_U32, _ENCAPSULATION = struct.Struct("<I"), b"\0\1\0\0"

# Takes a message for the ring: its stream, its time in microseconds, and itself.
Take = Callable[[str, int, RosMessage], object]


def compressed_image(ros: int) -> RosType:
    """The type of the pictures, in ROS 1 or 2."""
    definition = f"""std_msgs/Header header
string format
uint8[] data
{_RULE}
MSG: std_msgs/Header
{_STAMPS[ros]}
string frame_id
{_TIME if ros == 2 else ""}"""
    kind = _KINDS[ros]
    return RosType(TOPIC, kind, md5sum(parse(kind, definition), definition) if ros == 1 else "", definition)


def message(frame: Frame, picture: bytes, ros: int) -> bytes:
    """A picture's message."""
    seconds, us = divmod(frame.captured_us, 1_000_000)
    head = b"" if ros == 2 else _U32.pack(frame.number & 0xFFFFFFFF)
    parts = bytearray(head + _U32.pack(seconds) + _U32.pack(us * 1000))
    for text in (str(frame.number), "jpeg"):
        content = text.encode() + (b"\0" if ros == 2 else b"")
        parts += _U32.pack(len(content)) + content
        if ros == 2:
            parts += bytes(-len(parts) % 4)
    return (_ENCAPSULATION if ros == 2 else b"") + bytes(parts) + _U32.pack(len(picture)) + picture


def keeper(take: Take, ros: int) -> Callable[[Frame], None]:
    """What gives each picture to the ring."""
    kind = compressed_image(ros)

    def keep(frame: Frame) -> None:
        # A camera's own JPEG is kept as it is.
        raw = message(frame, frame.jpeg or jpeg(frame.picture, quality=_QUALITY), ros)
        take(STREAM, frame.captured_us, RosMessage(raw, kind))

    return keep
