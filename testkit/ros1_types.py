"""ROS 1 message types and the bytes of their messages, without ROS or a library.

A `Message` is a type with its nested types; it has the text that a publisher sends and its checksum.
`serialize` makes a message with values of a `Chance`, byte by byte; `fields` reads one as a flat list."""

from __future__ import annotations

import hashlib
import re
import struct
from collections.abc import Mapping
from typing import NamedTuple, Protocol

SIZES = {
    "bool": 1, "int8": 1, "uint8": 1, "byte": 1, "char": 1, "int16": 2, "uint16": 2, "int32": 4, "uint32": 4,
    "int64": 8, "uint64": 8, "float32": 4, "float64": 8, "time": 8, "duration": 8,
}  # fmt: skip
_LETTERS = {
    "bool": "?", "int8": "b", "uint8": "B", "byte": "b", "char": "B", "int16": "h", "uint16": "H",
    "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q", "float32": "f", "float64": "d",
    "time": "II", "duration": "ii",
}  # fmt: skip
STRING, HEADER = "string", "std_msgs/Header"
HEADER_TEXT = "uint32 seq\ntime stamp\nstring frame_id"
VARIABLE = -1
_FIELD = re.compile(r"(?P<base>[\w/]+?)(?P<array>\[(?P<length>\d*)\])?\s+(?P<name>\w+)\s*(=(?P<value>.*))?")


class Field(NamedTuple):
    """``kind`` is a full name; ``length`` is None for one value, `VARIABLE`, or the length of a fixed
    array.
    """

    name: str
    kind: str
    length: int | None


class Chance(Protocol):
    """Chooses the values of a message."""

    def number(self, kind: str, name: str) -> bytes:
        """Return a number of a type in `SIZES`, in its wire format."""

    def text(self, name: str) -> bytes:
        """Return a text, possibly with invalid UTF-8."""

    def length(self, name: str) -> int:
        """Return the length of a variable array."""


class Message:
    """A type and its nested types, from each type's own text."""

    def __init__(self, kind: str, texts: Mapping[str, str]) -> None:
        self.kind = kind
        self._texts = {HEADER: HEADER_TEXT, **texts}
        self.types: dict[str, list[Field]] = {}
        self._read(kind)
        first, *others = self.types
        rule = "=" * 80
        self.definition = "\n".join(
            [self._texts[first], *(f"{rule}\nMSG: {other}\n{self._texts[other]}" for other in others)]
        )
        self.md5sum = self._md5sum(kind)

    def __repr__(self) -> str:
        return f"{self.kind}:\n{self.definition}"

    @property
    def stamped(self) -> bool:
        """Return whether it begins with a header."""
        return self.types[self.kind][:1] == [Field("header", HEADER, None)]

    def _read(self, kind: str) -> None:
        if kind in self.types:
            return
        found: list[Field] = []
        self.types[kind] = found
        for match in self._lines(kind):
            if match["value"] is None:
                length = None if match["array"] is None else int(match["length"] or VARIABLE)
                found.append(Field(match["name"], self._full(kind, match["base"]), length))
        for field in found:
            if field.kind not in SIZES and field.kind != STRING:
                self._read(field.kind)

    def _lines(self, kind: str) -> list[re.Match[str]]:
        found = [_FIELD.match(line) for line in self._texts[kind].splitlines() if line.strip()]
        assert None not in found, self._texts[kind]
        return [match for match in found if match is not None]

    def _full(self, kind: str, name: str) -> str:
        if name in SIZES or name == STRING or "/" in name:
            return name
        return HEADER if name == "Header" else f"{kind.partition('/')[0]}/{name}"

    def _md5sum(self, kind: str) -> str:
        """Compute it as genmsg does: the constants, then the fields, with a nested type as its own
        checksum.
        """
        constants, plain = [], []
        for match in self._lines(kind):
            base, name, full = match["base"], match["name"], self._full(kind, match["base"])
            if match["value"] is not None:
                constants.append(f"{base} {name}={match['value'].strip()}")
            elif full in self.types:
                plain.append(f"{self._md5sum(full)} {name}")
            else:
                plain.append(f"{base}{match['array'] or ''} {name}")
        return hashlib.md5("\n".join(constants + plain).encode()).hexdigest()


def header(seq: int, stamp_us: int, frame: bytes) -> bytes:
    """A std_msgs/Header as bytes."""
    sec, us = divmod(stamp_us, 1_000_000)
    return struct.pack("<IIII", seq % 2**32, sec, us * 1000, len(frame)) + frame


def serialize(message: Message, chance: Chance, *, headed: bytes | None = None) -> bytes:
    """Make a message with values of ``chance``; ``headed`` is its header."""
    out: list[bytes] = []

    def one(kind: str, name: str) -> None:
        if kind in SIZES:
            out.append(chance.number(kind, name))
        elif kind == STRING:
            text = chance.text(name)
            out.append(struct.pack("<I", len(text)) + text)
        else:
            for field in message.types[kind]:
                several(field)

    def several(field: Field) -> None:
        count = 1 if field.length is None else field.length
        if count == VARIABLE:
            count = chance.length(field.name)
            out.append(struct.pack("<I", count))
        for _ in range(count):
            one(field.kind, field.name)

    for i, field in enumerate(message.types[message.kind]):
        if not i and headed is not None:
            out.append(headed)
        else:
            several(field)
    return b"".join(out)


def fields(message: Message, data: bytes) -> list[tuple[str, object]]:
    """Return path and value of every part of a message, in wire order; array and text lengths, as bytes,
    are values, too. A message that is too short or too long ends with a path that says so.
    """
    found: list[tuple[str, object]] = []

    def one(kind: str, path: str, at: int) -> int:
        if kind in SIZES:
            # NaN equals nothing, and -0.0 equals 0.0: compare bytes and value.
            raw = data[at : at + SIZES[kind]]
            found.append((path, (*struct.unpack(f"<{_LETTERS[kind]}", raw), raw.hex())))
            return at + SIZES[kind]
        if kind == STRING:
            (length,) = struct.unpack_from("<I", data, at)
            found.append((path, data[at + 4 : at + 4 + length]))
            return int(at + 4 + length)
        for field in message.types[kind]:
            at = several(field, f"{path}.{field.name}" if path else field.name, at)
        return at

    def several(field: Field, path: str, at: int) -> int:
        if field.length is None:
            return one(field.kind, path, at)
        count = field.length
        if count == VARIABLE:
            (count,) = struct.unpack_from("<I", data, at)
            found.append((f"{path}.length", count))
            at += 4
        if field.kind in {"uint8", "int8", "byte", "char"}:
            found.append((path, data[at : at + count]))
            return at + count
        for i in range(count):
            at = one(field.kind, f"{path}.{i}", at)
        return at

    try:
        end = one(message.kind, "", 0)
    except struct.error:
        found.append(("cut short", len(data)))
    else:
        if end != len(data):
            found.append(("too long", len(data) - end))
    return found


TYPE = "vesc_msgs/VescStateStamped"
FIELDS = [
    "voltage_input",
    "temperature_pcb",
    "current_motor",
    "current_input",
    "speed",
    "duty_cycle",
    "charge_drawn",
    "charge_regen",
    "energy_drawn",
    "energy_regen",
    "displacement",
    "distance_traveled",
]
STATE = "\n".join([*(f"float64 {name}" for name in FIELDS), "int32 fault_code"])
# The firmware sends integers; the driver divides these fields by the number, and the others by 1.
_PARTS = {
    "voltage_input": 10,
    "temperature_pcb": 10,
    "current_motor": 100,
    "current_input": 100,
    "duty_cycle": 1000,
}


def values(i: int) -> list[float]:
    """Return the fields of the i-th message with a VESC's digits; the speed is ``i``."""
    return [float(i) if name == "speed" else (115 + i % 97) / _PARTS.get(name, 1) for name in FIELDS]


def body(i: int) -> bytes:
    """Return the i-th message as ROS 1 serializes it, from the frame_id on."""
    return struct.pack(f"<I9s{len(FIELDS)}di", 9, b"base_link", *values(i), 0)


TEXTS = {
    "std_msgs/Empty": "",
    "std_msgs/String": "string data",
    "std_msgs/Float32": "float32 data",
    "std_msgs/MultiArrayDimension": "string label\nuint32 size\nuint32 stride",
    "std_msgs/MultiArrayLayout": "MultiArrayDimension[] dim\nuint32 data_offset",
    "std_msgs/ByteMultiArray": "MultiArrayLayout layout\nbyte[] data",
    "std_msgs/UInt64MultiArray": "MultiArrayLayout layout\nuint64[] data",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/PointStamped": "Header header\nPoint point",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
    "geometry_msgs/Pose": "Point position\nQuaternion orientation",
    "geometry_msgs/PoseStamped": "Header header\nPose pose",
    "geometry_msgs/PoseWithCovariance": "Pose pose\nfloat64[36] covariance",
    "geometry_msgs/Twist": "Vector3 linear\nVector3 angular",
    "geometry_msgs/TwistWithCovariance": "Twist twist\nfloat64[36] covariance",
    "geometry_msgs/Transform": "Vector3 translation\nQuaternion rotation",
    "geometry_msgs/TransformStamped": "Header header\nstring child_frame_id\nTransform transform",
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "sensor_msgs/JointState": (
        "Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort"
    ),
    "sensor_msgs/Imu": (
        "Header header\ngeometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n"
        "geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\n"
        "geometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance"
    ),
    "sensor_msgs/LaserScan": (
        "Header header\nfloat32 angle_min\nfloat32 angle_max\nfloat32 angle_increment\n"
        "float32 time_increment\nfloat32 scan_time\nfloat32 range_min\nfloat32 range_max\n"
        "float32[] ranges\nfloat32[] intensities"
    ),
    "sensor_msgs/Image": (
        "Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\n"
        "uint32 step\nuint8[] data"
    ),
    "nav_msgs/Odometry": (
        "Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n"
        "geometry_msgs/TwistWithCovariance twist"
    ),
    "nav_msgs/Path": "Header header\ngeometry_msgs/PoseStamped[] poses",
    "nav_msgs/MapMetaData": (
        "time map_load_time\nfloat32 resolution\nuint32 width\nuint32 height\ngeometry_msgs/Pose origin"
    ),
    "nav_msgs/OccupancyGrid": "Header header\nMapMetaData info\nint8[] data",
    "diagnostic_msgs/KeyValue": "string key\nstring value",
    "diagnostic_msgs/DiagnosticStatus": (
        "byte OK=0\nbyte WARN=1\nbyte ERROR=2\nbyte STALE=3\nbyte level\nstring name\nstring message\n"
        "string hardware_id\nKeyValue[] values"
    ),
    "diagnostic_msgs/DiagnosticArray": "Header header\nDiagnosticStatus[] status",
    "vesc_msgs/VescState": STATE,
    "vesc_msgs/VescStateStamped": "Header header\nVescState state",
    # Custom types of a lab. A field called header need not be a std_msgs/Header, and a header need not come
    # first.
    "lab_msgs/Contact": "Header header\nfloat32 force\nbool touching",
    "lab_msgs/LabelledContact": "string label\nContact grip",
    "lab_msgs/Packet": "uint16 id\nuint8 version\nstring note",
    "lab_msgs/Reading": "Packet header\nfloat64 value\nstd_msgs/Header at",
    "lab_msgs/Part": "Header header\nReading reading",
    "lab_msgs/Envelope": "Packet header\nuint8[] payload\nPart[] parts\nPart[2] both",
    "lab_msgs/Limits": (
        "uint8 LEFT=0\nstring WHO=a # b\nbool on\nbyte low\nchar letter\nint64 least\nuint64 most\n"
        "uint64[2] pair\nfloat32 f\nfloat64 d\nfloat64[] list\nbyte[] signed\nstring name\nstring[] names\n"
        "time at\nduration took\nduration[] tooks"
    ),
    "lab_msgs/Empties": "std_msgs/Empty nothing\nstd_msgs/Empty[] many\nfloat64[] none\nPart[] parts",
}
MESSAGES = {kind: Message(kind, TEXTS) for kind in sorted({*TEXTS, "std_msgs/Header"})}
