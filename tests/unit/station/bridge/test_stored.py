"""What is played comes from table or archive alike, in order, and is what a query returns."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import pytest

from iort_contract.catalog.streams import TYPES_STREAM
from iort_contract.messages.batch import Batch
from iort_contract.ros.message import Messages, MessageType, RosType
from iort_contract.topics import RECORD, build_topic
from iort_station import data
from iort_station.bridge.channels import Message, waiting
from iort_station.bridge.stored import McapFile, Range
from iort_station.data.bags import mcap
from iort_station.data.export import write
from iort_station.data.recorded import select
from iort_station.errors import StationError
from testkit.dynamodb import ROBOTS, TELEMETRY, item_of, serialize
from tests.archived import FakeS3, archive, expire
from tests.unit.station.data.test_queries import START, cloud_of

KIND = MessageType("made", "/lab/made", "lab_msgs/Made", "", "float64 x\n")
SECONDS = 5400


def put(cloud: Any, robot: str, stream: str, *batches: Batch) -> None:
    for batch in batches:
        cloud.table.put(TELEMETRY, item_of(batch, build_topic(RECORD, robot, stream)))


def recorded(cloud: Any, robot: str) -> None:
    """An hour and a half: a sample every ten seconds, and messages whose batches overlap."""
    kind = RosType(KIND.topic, KIND.kind, KIND.md5sum, KIND.definition)
    for second in range(0, SECONDS, 10):
        at = START + second * 1_000_000
        put(cloud, robot, "vesc", Batch("0badcafe", second, [at], {"speed": [second / 2]}))
        for boot in (0, 1):
            times = [at + boot * 150_000 + i * 200_000 for i in range(4)]
            raws = [struct.pack("<d", second + boot / 2 + i) for i in range(4)]
            put(
                cloud,
                robot,
                "made",
                Batch(f"0badcaf{boot}", second, times, {}, 0, Messages(kind.id, kind.layout, raws)),
            )
    types = {name: [value] for name, value in KIND.sample().items()}
    put(cloud, robot, TYPES_STREAM, Batch("0badcafe", 0, [START], types))
    row = {"robot": robot, "streams": {"vesc", "made"}}
    cloud.table.put(ROBOTS, {name: serialize(value) for name, value in row.items()})


@pytest.fixture
def cloud() -> Any:
    made = cloud_of(page_items=50)
    made.bucket = FakeS3()
    recorded(made, "car")
    return made


def everything(source: Range, start_ns: int) -> list[Message]:
    every = frozenset(range(len(source.topics)))
    said: list[str] = []
    found = list(source.messages(start_ns, every, lambda: None, said.append))
    assert said == []
    return found


def test_the_archive_gives_what_the_table_gave_and_both_what_a_query_returns(cloud: Any) -> None:
    end = START + SECONDS * 1_000_000
    # In the middle of a batch, in the first hour.
    seek = START + 1_000 * 1_000_000 + 300_000
    source = Range(cloud, ["car"], START, end)
    before = everything(source, seek * 1000)
    archive(cloud.table, cloud.bucket)
    expire(cloud.table)
    assert not any(key[0].endswith("/vesc") for key in cloud.table.items[TELEMETRY])
    after = everything(Range(cloud, ["car"], START, end), seek * 1000)
    assert after == before
    numbers = {topic.name: number for number, topic in enumerate(source.topics)}
    for stream in ("vesc", "made"):
        result = data.query(cloud, "car", stream, seek, end)
        columns = {name: data.values(column) for name, column in result.columns.items()}
        expected = [
            (t_us * 1000, {name: column[i] for name, column in columns.items()})
            for i, t_us in enumerate(result.times_us.tolist())
        ]
        played = [one for one in after if one.topic == numbers[f"/iort/{stream}"]]
        assert [(one.t_ns, json.loads(one.data)) for one in played] == expected
    raw = [one for one in after if one.topic == numbers["/lab/made"]]
    assert [struct.unpack("<d", one.data)[0] for one in raw] == [
        json.loads(one.data)["x"] for one in after if one.topic == numbers["/iort/made"]
    ]
    assert [one.t_ns for one in after] == sorted(one.t_ns for one in after)


def test_the_first_message_does_not_wait_for_the_rest_of_the_range(cloud: Any) -> None:
    archive(cloud.table, cloud.bucket)
    expire(cloud.table)
    played = Range(cloud, ["car"], START, START + SECONDS * 1_000_000)
    reads: list[None] = []
    every = frozenset(range(len(played.topics)))
    messages = played.messages(played.start_ns, every, lambda: reads.append(None), lambda _text: None)
    next(messages)
    before = len(reads)
    assert sum(1 for _ in messages) > SECONDS // 10
    assert before < len(reads) / 5


def test_topics_of_several_robots_begin_with_their_names(cloud: Any) -> None:
    recorded(cloud, "car2")
    source = Range(cloud, ["car", "car2"], None, None)
    assert {topic.name for topic in source.topics} == {
        f"/{robot}{topic}" for robot in ("car", "car2") for topic in ("/iort/vesc", "/iort/made", "/lab/made")
    }


def test_a_file_that_was_cut_says_what_mends_it(cloud: Any, tmp_path: Path) -> None:
    path = tmp_path / "ride.mcap"
    with mcap(path) as file:
        write(cloud, select("car", "made"), file)
    whole = path.read_bytes()
    assert len(McapFile(path).topics) == 1
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(StationError, match=r"ride\.mcap"):
        McapFile(path)
    with pytest.raises(StationError, match="must be an MCAP file"):
        McapFile(tmp_path)


def test_large_messages_let_fewer_wait() -> None:
    assert [waiting(size) for size in (1, 100_000, 10**7, 10**12)] == [4096, 1342, 64, 64]
