"""ROS messages made of samples, and the files that hold them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from iort_analysis.samples.blocks import Block, column_of
from iort_contract.catalog.streams import TYPES_STREAM
from iort_contract.limits import ContractError, Value
from iort_contract.messages.batch import Batch
from iort_contract.ros.message import ROS2, MessageType, message_type
from iort_contract.topics import build_topic
from iort_station.data import bags
from iort_station.data.ros_messages import Maker, in_ros1, made_of, types
from iort_station.errors import StationError
from testkit.dynamodb import TELEMETRY, item_of
from tests.flatten import flatten
from tests.foxglove import flat, opened
from tests.unit.contract.ros.ros1_messages import LINE
from tests.unit.contract.ros.ros_values import HEADER
from tests.unit.station.data.test_queries import cloud_of

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


def test_a_message_has_its_header_and_its_nested_fields():
    maker, _, message = made(STAMPED, {"x": 1.5, "code": 7.0})
    assert (message.b.x, message.b.code) == (1.5, 7)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1_700_000_000, 123_456_000)
    assert maker.lacking == maker.foreign == []


def test_headers_have_sequence_numbers_and_the_samples_time():
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


def test_a_flattened_message_is_restored():
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


def test_fields_may_have_names_of_python_keywords():
    _, _, message = made("float64 from\nB class\n" + LINE + "MSG: a_msgs/B\nint32 lambda\n",
                         {"from": 1.5, "class.lambda": 3})  # fmt: skip
    assert (message.from_, message.class_.lambda_) == (1.5, 3)


def test_a_type_of_ros_2_becomes_one_of_ros_1_with_the_same_fields():
    text = "wstring<=9 label\nint32[<=3] D\nbuiltin_interfaces/Duration took\nuint8 KIND=3\n"
    kind = in_ros1(MessageType("s", "/t", "a_msgs/msg/A", "RIHS01_" + "0" * 64, text))
    assert (kind.kind, kind.converted_from) == ("a_msgs/A", ROS2)
    assert kind.definition == "uint8 KIND=3\nstring label\nint32[] D\nduration took\n"
    assert in_ros1(kind) == kind
    Maker(kind, ["label", "D.0", "took.sec"])


def test_null_missing_and_unknown_fields_are_handled():
    maker, _, message = made(STAMPED, {"x": None, "y": 1})
    assert np.isnan(message.b.x)
    assert message.b.code == 0
    assert (maker.lacking, maker.foreign) == (["code"], ["y"])


def has_said(*samples):
    """A cloud with these message types of a robot, sent one a millisecond."""
    cloud, topic = cloud_of(), build_topic("dt", "car", TYPES_STREAM)
    for i, one in enumerate(samples):
        columns = {name: [value] for name, value in one.sample().items()}
        cloud.table.put(TELEMETRY, item_of(Batch("0badcafe", i, [1000 * (i + 1)], columns), topic))
    return cloud


def test_the_types_that_a_robot_sent_are_read_in_their_order():
    first = MessageType("s", "/t", "a_msgs/A", "1" * 32, STAMPED)
    second, other = first._replace(md5sum="2" * 32), first._replace(stream="o", topic="/o")
    elsewhere = first._replace(topic="/u")
    cloud = has_said(first, other, second, elsewhere, first)
    # Each type once; batches refer to types by id.
    assert list(types(cloud, "car").items()) == [
        (kind.id, kind) for kind in (first, other, second, elsewhere)
    ]
    assert len({first.id, second.id, elsewhere.id}) == 3
    assert types(cloud, "van") == {}


def test_a_missing_definition_is_taken_from_another_publisher():
    whole = MessageType("s", "/t", "a_msgs/A", "1" * 32, STAMPED)
    cloud = has_said(whole._replace(definition=""), whole)
    assert types(cloud, "car") == {whole.id: whole}


def test_samples_without_a_type_get_a_generated_type():
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


def test_a_type_is_decoded_as_it_was_encoded_and_an_invalid_one_is_refused():
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


COUNT = 2500

RICH_SAMPLE: dict[str, Value] = {
    "on": True, "small": 7, "large": 5, "name": "ü", "at.sec": 5, "at.nanosec": 6,
    "took.sec": -1, "took.nanosec": 2, "pair.0": 0.5, "pair.1": -2.0, "bytes.0": 1, "bytes.1": 255,
    "parts.0.x": 1.25, "parts.1.x": 2.5, "names.0": "a", "names.1": "b",
}  # fmt: skip


def blocks(samples: Sequence[Mapping[str, Value]]) -> list[Block]:
    """The samples, one a millisecond, a few hundred in a block."""
    return [
        Block(
            np.arange(len(samples))[at : at + 700] * 1000 + T_US,
            {name: column_of([sample[name] for sample in samples[at : at + 700]]) for name in samples[0]},
        )
        for at in range(0, len(samples), 700)
    ]


@pytest.mark.parametrize("suffix", [".mcap", ".bag", "2.mcap"])
def test_foxglove_reads_every_message_of_every_type(tmp_path: Path, suffix: str) -> None:
    ros2 = suffix == "2.mcap"
    stamped = [{"x": i / 7, "code": i} for i in range(COUNT)]
    rich = [{**RICH_SAMPLE, "large": 2**53 + i, "parts.1.x": i / 3, "name": f"ü{i}"} for i in range(COUNT)]
    untyped = [{"rule_ms": None if i % 3 == 0 else i / 9, "pose.x": i} for i in range(COUNT)]
    own = made_of("rtt", blocks(untyped)[0].columns)
    makers = {
        "/stamped": Maker(MessageType("stamped", "/stamped", "a_msgs/S", "", STAMPED), ["x", "code"]),
        "/rich": Maker(MessageType("rich", "/rich", "a_msgs/A", "", RICH), list(rich[0])),
        "/rtt": Maker(own, list(untyped[0]), own=True),
    }
    path, kinds = tmp_path / f"ride{suffix}", {}
    with bags.mcap(path, ros2=True) if ros2 else bags.KINDS[suffix](path) as file:
        for maker, samples in zip(makers.values(), (stamped, rich, untyped), strict=True):
            write, form = file.topic(maker.kind)
            kinds[maker.kind.topic] = form.kind, form.md5sum
            assert form.ros2 == ros2
            for block in blocks(samples):
                for t_ns, message in maker.messages(block):
                    write(t_ns, message)

    found = opened(path)
    assert found.types == kinds
    times = [(T_US + 1000 * i) * 1000 for i in range(COUNT)]
    for topic in makers:
        assert [t_ns for t_ns, _ in found.messages[topic]] == times
    messages = {topic: [message for _, message in found.messages[topic]] for topic in makers}
    assert [message["b"] for message in messages["/stamped"]] == stamped
    headers = [message["header"] for message in messages["/stamped"]]
    assert [header.get("seq") for header in headers] == ([None] * COUNT if ros2 else list(range(COUNT)))
    part = "nanosec" if ros2 else "nsec"
    assert [header["stamp"]["sec"] * 10**9 + header["stamp"][part] for header in headers] == times
    assert {header["frame_id"] for header in headers} == {""}
    # JavaScript's 64-bit integers are printed as texts.
    assert [flat(message) for message in messages["/rich"]] == [
        {**sample, "large": str(sample["large"])} for sample in rich
    ]
    # NaN is null in JSON.
    assert [flat(message) for message in messages["/rtt"]] == [
        {"rule_ms": sample["rule_ms"], "pose_x": sample["pose.x"]} for sample in untyped
    ]


@pytest.mark.parametrize("ending", bags.KINDS)
def test_an_interrupted_export_leaves_no_file(tmp_path, ending):
    path = tmp_path / f"ride{ending}"
    with pytest.raises(StationError, match="broke off"), bags.KINDS[ending](path):
        raise StationError("broke off")
    assert list(tmp_path.iterdir()) == []
    with bags.KINDS[ending](path):
        pass
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(StationError, match="exists"), bags.KINDS[ending](path):
        pass
