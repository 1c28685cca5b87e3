"""Samples made into messages again, of every shape that a message has."""

from __future__ import annotations

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from contract import ContractError, MessageType, message_type
from device.sources.flatten import flatten
from station.blocks import Block, column_of
from station.errors import StationError
from station.messages import Maker, made_of

LINE = "=" * 80 + "\n"
HEADER = LINE + "MSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
STAMPED = "Header header\nB b\n" + HEADER + LINE + "MSG: a_msgs/B\nfloat64 x\nint32 code\n"
RICH = (
    "uint8 KIND=3\nbool on\nuint8 small\nint64 large\nstring name\ntime at\nduration took\n"
    "float32[2] pair\nuint8[] bytes\nB[2] parts\nstring[] names\n" + LINE + "MSG: a_msgs/B\nfloat64 x\n"
)
T_US = 1_700_000_000_123_456


def made(definition, sample, kind="a_msgs/A"):
    maker = Maker(MessageType("s", "/t", kind, "", definition), list(sample))
    block = Block(np.array([T_US]), {name: column_of([value]) for name, value in sample.items()})
    ((t_ns, raw),) = maker.messages(block)
    assert t_ns == T_US * 1000
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(definition, "a_msgs/msg/A"))
    return maker, store, store.deserialize_ros1(raw, "a_msgs/msg/A")


def test_a_header_and_one_thing():
    maker, _, message = made(STAMPED, {"x": 1.5, "code": 7.0})
    assert (message.b.x, message.b.code) == (1.5, 7)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1_700_000_000, 123_456_000)
    assert maker.lacking == maker.foreign == []


def test_what_flattens_is_made_again():
    sample = {
        "on": True, "small": 7, "large": 2**60 + 1, "name": "ü", "at.sec": 5, "at.nanosec": 6,
        "took.sec": -1, "took.nanosec": 2, "pair.0": 0.5, "pair.1": -2.0, "bytes.0": 1, "bytes.1": 255,
        "parts.0.x": 1.25, "parts.1.x": 2.5, "names.0": "a", "names.1": "b",
    }  # fmt: skip
    maker, store, message = made(RICH, sample)
    fields = {name: [field for field, _ in definition[1]] for name, definition in store.fielddefs.items()}
    assert flatten(message, lambda value: fields.get(getattr(value, "__msgtype__", ""))) == sample
    assert maker.lacking == maker.foreign == []


def test_null_lacking_and_foreign_fields():
    maker, _, message = made(STAMPED, {"x": None, "y": 1})
    assert np.isnan(message.b.x)
    assert message.b.code == 0
    assert (maker.lacking, maker.foreign) == (["code"], ["y"])


def test_samples_without_a_type_get_one():
    columns = {"rule_ms": column_of([1.5]), "pose.x": column_of([2]), "ok": column_of([True])}
    kind = made_of("rtt-2", columns)
    maker = Maker(kind, list(columns), own=True)
    assert maker.lacking == maker.foreign == []
    assert kind.kind == "iort_msgs/Rtt_2"
    assert "float64 pose_x" in kind.definition
    ((_, raw),) = maker.messages(Block(np.array([T_US]), columns))
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(kind.definition, "iort_msgs/msg/Rtt_2"))
    message = store.deserialize_ros1(raw, "iort_msgs/msg/Rtt_2")
    assert (message.rule_ms, message.pose_x, message.ok) == (1.5, 2.0, True)


def test_a_type_survives_the_wire_and_a_wrong_one_is_refused():
    kind = MessageType("s", "/t", "a_msgs/A", "x" * 32, STAMPED + "# " + "ü" * 9000)
    assert message_type(kind.sample()) == kind
    with pytest.raises(ContractError, match="characters"):
        kind._replace(definition="x" * 300_000).sample()
    with pytest.raises(ContractError, match="without 'topic'"):
        message_type({"stream": "s"})
    with pytest.raises(StationError, match="not that of its checksum"):
        Maker(kind, ["x"])
    with pytest.raises(StationError, match="cannot be made again"):
        Maker(kind._replace(definition="nonsense nonsense nonsense"), ["x"])
