"""Compares our decoder with ROS' genpy, by random message definitions."""

# ruff: noqa: T201 - standard output goes to the test that started it

from __future__ import annotations

import io
import random
import sys

import genpy
import genpy.dynamic

from iort_contract.ros1.decode import Decoder, stamp_ns
from iort_contract.ros1.definition import LETTERS, parse
from tests.flatten import flatten

RULE = "=" * 80
KINDS = [*LETTERS, "string", "time", "duration"]


def fields(chance, nested):
    lines = []
    for i in range(chance.randint(1, 6)):
        kind = chance.choice(KINDS + nested)
        # We leave out uint8[], which is a blob.
        length = "" if kind in ("uint8", "char") else chance.choice(["", "", "[]", "[3]"])
        lines.append(f"{kind}{length} f{i}  # comment")
        if chance.random() < 0.2:
            lines.append(f"int32 C{i}={i}")
    return "\n".join(lines)


def fill(chance, kind, classes):
    base, _, length = kind.partition("[")
    if length:
        count = chance.randint(0, 4) if length == "]" else int(length[:-1])
        return [fill(chance, base, classes) for _ in range(count)]
    if base == "string":
        return chance.choice(["", "abc", "grün"])
    if base in ("time", "duration"):
        return (genpy.Time if base == "time" else genpy.Duration)(chance.randint(0, 2**31 - 1), 5)
    if base == "bool":
        return chance.random() < 0.5
    letter = LETTERS.get(base)
    if letter in ("f", "d"):
        return chance.choice([0.0, -1.5, 2.0**70, float("inf")])
    if letter is not None:
        bits = 8 * {"b": 1, "h": 2, "i": 4, "q": 8}[letter.lower()]
        return (
            chance.randint(0, 2**bits - 1)
            if letter.isupper()
            else chance.randint(-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
        )
    message = classes[base]()
    for name, slot in zip(message.__slots__, message._slot_types, strict=True):
        setattr(message, name, fill(chance, slot, classes))
    return message


class Two:
    """A time with the member names of our samples."""

    def __init__(self, value):
        self.sec, self.nanosec = value.secs, value.nsecs


def members(value):
    if isinstance(value, Two):
        return vars(value)
    if isinstance(value, genpy.Message):
        return {name: getattr(value, name) for name in value.__slots__}
    return None


def with_times(value):
    if isinstance(value, genpy.rostime.TVal):
        return Two(value)
    if isinstance(value, list):
        return [with_times(item) for item in value]
    if isinstance(value, genpy.Message):
        for name in value.__slots__:
            setattr(value, name, with_times(getattr(value, name)))
    return value


for case in range(80):
    chance = random.Random(case)
    stamped = case % 3 == 0
    text = "\n".join(
        [
            ("Header header\n" if stamped else "") + fields(chance, ["Inner", "Deep"]), RULE,
            "MSG: made_msgs/Inner", fields(chance, ["Deep"]), RULE,
            "MSG: made_msgs/Deep", fields(chance, []), RULE,
            "MSG: std_msgs/Header", "uint32 seq", "time stamp", "string frame_id",
        ]
    )  # fmt: skip
    kind = f"made_msgs/Case{case}"
    classes = genpy.dynamic.generate_dynamic(kind, text)
    message = fill(chance, kind, classes)
    buffer = io.BytesIO()
    message.serialize(buffer)
    decoder = Decoder(parse(kind, text))
    values = decoder.decode(buffer.getvalue())
    assert decoder.stamped == stamped
    if stamped:
        assert stamp_ns(buffer.getvalue()) == message.header.stamp.to_nsec(), case
    expected = flatten(with_times(message), members)
    assert values == expected, (case, text, values, expected)
print("agreed", sys.version_info[:2])
