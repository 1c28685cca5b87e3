"""Samples made into messages again, of every shape that a message has."""

from __future__ import annotations

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from iort_contract.catalog.streams import TYPES_STREAM
from iort_contract.limits import ContractError
from iort_contract.messages.batch import Batch
from iort_contract.messages.message_type import MessageType, message_type
from iort_contract.topics import build_topic
from iort_station.data.blocks import Block, column_of
from iort_station.errors import StationError
from iort_station.recordings.messages import Maker, made_of, types
from tests.fakes import TELEMETRY, item_of
from tests.flatten import flatten
from tests.unit.station.test_data import cloud_of

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


def test_a_header_of_ros_2_becomes_one_of_ros_1():
    of_ros2 = STAMPED.replace("uint32 seq\n", "")
    assert of_ros2 != STAMPED
    maker = Maker(MessageType("s", "/t", "a_msgs/A", "", of_ros2), ["x", "code"])
    assert maker.definition == STAMPED
    assert maker.md5sum == Maker(MessageType("s", "/t", "a_msgs/A", "", STAMPED), ["x", "code"]).md5sum
    of_ros2_md5sum = get_typestore(Stores.EMPTY)
    of_ros2_md5sum.register(get_types_from_msg(of_ros2, "a_msgs/msg/A"))
    said = of_ros2_md5sum.generate_msgdef("a_msgs/msg/A")[1]
    assert Maker(MessageType("s", "/t", "a_msgs/A", said, of_ros2), []).md5sum == maker.md5sum != said
    block = Block(np.array([T_US]), {"x": column_of([1.5]), "code": column_of([7.0])})
    ((_, raw),) = maker.messages(block)
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(STAMPED, "a_msgs/msg/A"))
    message = store.deserialize_ros1(raw, "a_msgs/msg/A")
    assert (message.header.seq, message.b.x) == (0, 1.5)


def test_headers_are_numbered_and_have_the_samples_time():
    path = "Header header\nB[2] parts\n" + HEADER + LINE + "MSG: a_msgs/B\nHeader header\nfloat64 x\n"
    maker = Maker(MessageType("s", "/t", "a_msgs/A", "", path), ["parts.0.x", "parts.1.x"])
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(path, "a_msgs/msg/A"))
    seen = []
    for start in (T_US, T_US + 3):
        block = Block(np.arange(start, start + 3), {"parts.0.x": column_of([1.0] * 3)})
        for t_ns, raw in maker.messages(block):
            message = store.deserialize_ros1(raw, "a_msgs/msg/A")
            within = [part.header for part in message.parts]
            seen.append((t_ns // 1000 - T_US, message.header.seq, message.header.frame_id))
            assert [(header.seq, header.frame_id) for header in within] == [(message.header.seq, "")] * 2
    assert seen == [(i, i, "") for i in range(6)]


def test_what_flattens_is_made_again():
    sample = {
        "on": True, "small": 7, "large": 2**60 + 1, "name": "ü", "at.sec": 5, "at.nanosec": 6,
        "took.sec": -1, "took.nanosec": 2, "pair.0": 0.5, "pair.1": -2.0, "bytes.0": 1, "bytes.1": 255,
        "parts.0.x": 1.25, "parts.1.x": 2.5, "names.0": "a", "names.1": "b",
    }  # fmt: skip
    maker, store, message = made(RICH, sample)
    fields = {name: [field for field, _ in definition[1]] for name, definition in store.fielddefs.items()}

    def members(value):
        names = fields.get(getattr(value, "__msgtype__", ""))
        return None if names is None else {name: getattr(value, name) for name in names}

    assert flatten(message, members) == sample
    assert maker.lacking == maker.foreign == []


def test_fields_may_be_words_of_python():
    _, _, message = made("float64 from\nB class\n" + LINE + "MSG: a_msgs/B\nint32 lambda\n",
                         {"from": 1.5, "class.lambda": 3})  # fmt: skip
    assert (message.from_, message.class_.lambda_) == (1.5, 3)


def test_null_lacking_and_foreign_fields():
    maker, _, message = made(STAMPED, {"x": None, "y": 1})
    assert np.isnan(message.b.x)
    assert message.b.code == 0
    assert (maker.lacking, maker.foreign) == (["code"], ["y"])


def has_said(*samples):
    """A cloud in which a robot has said these, a millisecond apart."""
    cloud, topic = cloud_of(), build_topic("dt", "car", TYPES_STREAM)
    for i, one in enumerate(samples):
        columns = {name: [value] for name, value in one.sample().items()}
        cloud.table.put(TELEMETRY, item_of(Batch("0badcafe", i, [1000 * (i + 1)], columns), topic))
    return cloud


def test_what_a_robot_has_said_of_its_messages():
    first = MessageType("s", "/t", "a_msgs/A", "1" * 32, STAMPED)
    second, other = first._replace(md5sum="2" * 32), first._replace(stream="o", topic="/o")
    elsewhere = first._replace(topic="/u")
    cloud = has_said(first, other, second, elsewhere, first)
    # Each once, and since when; batches refer to them by their ids.
    assert types(cloud, "car", "s") == {
        first.id: (1000, first),
        second.id: (3000, second),
        elsewhere.id: (4000, elsewhere),
    }
    assert len({first.id, second.id, elsewhere.id}) == 3
    assert types(cloud, "car", "nothing") == {}


def test_a_definition_that_one_publisher_left_out_is_taken_from_another():
    whole = MessageType("s", "/t", "a_msgs/A", "1" * 32, STAMPED)
    cloud = has_said(whole._replace(definition=""), whole)
    assert types(cloud, "car", "s") == {whole.id: (1000, whole)}


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
    with pytest.raises(ContractError, match="must have 'topic'"):
        message_type({"stream": "s"})
    with pytest.raises(StationError, match=r"must be x+, got 2416"):
        Maker(kind, ["x"])
    with pytest.raises(StationError, match="cannot be made again"):
        Maker(kind._replace(definition="nonsense nonsense nonsense"), ["x"])
