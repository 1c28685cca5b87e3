"""Compares random genpy messages, sent as rosbridge sends them, with genpy's own bytes."""

# ruff: noqa: T201 - standard output goes to the test that started it

from __future__ import annotations

import io
import json
import math
import random
import struct
import sys

import genpy
import genpy.dynamic

from iort_agent.ros1.json_message import Writer
from iort_contract.ros1.definition import LETTERS, md5sum, parse
from tests.rosbridge_json import as_rosbridge

RULE = "=" * 80
KINDS = [*LETTERS, "string", "time", "duration"]


def fields(chance, nested):
    lines = []
    for i in range(chance.randint(0, 8)):
        length = chance.choice(["", "", "[]", "[3]", "[70]"])
        lines.append(f"{chance.choice(KINDS + nested)}{length} f{i}  # comment")
        if chance.random() < 0.3:
            lines.append(
                chance.choice([f"int32 C{i}={i}", f"string S{i}= a # b ", f"float32 F{i} =  1.50 # c"])
            )
    return "\n".join(lines)


def plain(value):
    """Return a genpy message as its fields' values."""
    if isinstance(value, genpy.rostime.TVal):
        return {"sec": value.secs, "nanosec": value.nsecs}
    if isinstance(value, genpy.Message):
        return {name: plain(getattr(value, name)) for name in value.__slots__}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    return value


def fill(chance, kind, classes):
    base, _, length = kind.partition("[")
    if length:
        count = chance.randint(0, 4) if length == "]" else int(length[:-1])
        many = [fill(chance, base, classes) for _ in range(count)]
        return bytes(many) if base in ("uint8", "char") else many
    if base == "string":
        return chance.choice(["", "abc", "grün"])
    if base in ("time", "duration"):
        return (genpy.Time if base == "time" else genpy.Duration)(chance.randint(0, 2**31 - 1), 5)
    if base == "bool":
        return chance.random() < 0.5
    letter = LETTERS.get(base)
    if letter in ("f", "d"):
        number = chance.choice([0.0, -1.5, math.nan, chance.uniform(-1e30, 1e30)])
        return struct.unpack("<f", struct.pack("<f", number))[0] if letter == "f" else number
    if letter is not None:
        bits = 8 * struct.calcsize(letter)
        return chance.getrandbits(bits) - (0 if letter.isupper() else 2 ** (bits - 1))
    message = classes[base]()
    for name, slot in zip(message.__slots__, message._slot_types, strict=True):
        setattr(message, name, fill(chance, slot, classes))
    return message


for case in range(150):
    chance = random.Random(case)
    stamped = case % 3 == 0
    text = "\n".join(
        [
            ("Header header\n" if stamped else "") + fields(chance, ["Inner", "Deep"]), RULE,
            "MSG: made_msgs/Inner", fields(chance, ["Deep", "std_msgs/Header"]), RULE,
            "MSG: made_msgs/Deep", fields(chance, []), RULE,
            "MSG: std_msgs/Header", "uint32 seq", "time stamp", "string frame_id",
        ]
    )  # fmt: skip
    kind = f"made_msgs/Case{case}"
    classes = genpy.dynamic.generate_dynamic(kind, text)
    assert md5sum(parse(kind, text), text) == classes[kind]._md5sum, (case, text)
    definition = parse(kind, text)
    for _ in range(5):
        message = fill(chance, kind, classes)
        buffer = io.BytesIO()
        message.serialize(buffer)
        # A subscriber gets these bytes, and rosbridge is a subscriber.
        received = classes[kind]().deserialize(buffer.getvalue())
        sent = json.dumps(as_rosbridge(definition, plain(received)))
        written = Writer(definition).write(json.loads(sent))
        assert written == buffer.getvalue(), (case, text, sent)
print("agreed", sys.version_info[:2])
