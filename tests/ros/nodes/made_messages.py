"""Random message definitions, and messages of them by ROS' genpy."""

from __future__ import annotations

import io
import random
import struct
from typing import NamedTuple

import genpy
import genpy.dynamic

from iort_contract.ros1.definition import LETTERS

RULE = "=" * 80
KINDS = [*LETTERS, "string", "time", "duration"]
BYTES = ("uint8", "char")


class Made(NamedTuple):
    """A type: its definition, whether it begins with a header, and genpy's classes of it and its parts."""

    kind: str
    text: str
    stamped: bool
    classes: dict


def made(case, *, large):
    """The type of a number; ``large`` allows arrays of bytes and long ones, which our decoder leaves out."""
    chance, stamped = random.Random(case), case % 3 == 0
    text = "\n".join(
        [
            ("Header header\n" if stamped else "") + _fields(chance, ["Inner", "Deep"], large), RULE,
            "MSG: made_msgs/Inner", _fields(chance, ["Deep", "std_msgs/Header"], large), RULE,
            "MSG: made_msgs/Deep", _fields(chance, [], large), RULE,
            "MSG: std_msgs/Header", "uint32 seq", "time stamp", "string frame_id",
        ]
    )  # fmt: skip
    kind = f"made_msgs/Case{case}"
    return Made(kind, text, stamped, genpy.dynamic.generate_dynamic(kind, text))


def message(made, chance, floats):
    """A message with random values, and its bytes; a float is one of ``floats``."""
    value, buffer = _value(made.kind, made.classes, chance, floats), io.BytesIO()
    value.serialize(buffer)
    return value, buffer.getvalue()


def _fields(chance, nested, large):
    lines = []
    for i in range(chance.randint(0, 8)):
        kind = chance.choice(KINDS + nested)
        lengths = ["", "", "[]", "[3]", "[70]"] if large else ["", "", "[]", "[3]"]
        length = chance.choice(lengths) if large or kind not in BYTES else ""
        lines.append(f"{kind}{length} f{i}  # comment")
        if chance.random() < 0.3:
            lines.append(
                chance.choice([f"int32 C{i}={i}", f"string S{i}= a # b ", f"float32 F{i} =  1.50 # c"])
            )
    return "\n".join(lines)


def _value(kind, classes, chance, floats):
    base, _, length = kind.partition("[")
    if length:
        count = chance.randint(0, 4) if length == "]" else int(length[:-1])
        many = [_value(base, classes, chance, floats) for _ in range(count)]
        return bytes(many) if base in BYTES else many
    if base == "string":
        return chance.choice(["", "abc", "grün"])
    if base in ("time", "duration"):
        return (genpy.Time if base == "time" else genpy.Duration)(chance.randint(0, 2**31 - 1), 5)
    if base == "bool":
        return chance.random() < 0.5
    letter = LETTERS.get(base)
    if letter in ("f", "d"):
        number = chance.choice(floats)
        return struct.unpack("<f", struct.pack("<f", number))[0] if letter == "f" else number
    if letter is not None:
        bits = 8 * struct.calcsize(letter)
        return chance.getrandbits(bits) - (0 if letter.isupper() else 2 ** (bits - 1))
    value = classes[base]()
    for name, slot in zip(value.__slots__, value._slot_types, strict=True):
        setattr(value, name, _value(slot, classes, chance, floats))
    return value


def plain(value):
    """Return genpy's values as our samples have them."""
    if isinstance(value, genpy.rostime.TVal):
        return {"sec": value.secs, "nanosec": value.nsecs}
    if isinstance(value, genpy.Message):
        return {name: plain(getattr(value, name)) for name in value.__slots__}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    return value
