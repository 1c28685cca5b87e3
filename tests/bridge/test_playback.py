"""What is stored is played to a client that is not ours: exactly the samples of a query, and no other."""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path
from typing import Any

import pytest

from iort_contract.catalog.streams import POSE_STREAM, TYPES_STREAM
from iort_contract.messages.batch import Batch
from iort_contract.ros.message import Messages, MessageType, RosType
from iort_contract.tables import ROBOT
from iort_contract.topics import RECORD, build_topic
from iort_station import data
from iort_station.bridge.serving import Access, playing
from iort_station.bridge.stored import McapFile, Range
from iort_station.data.bags import mcap
from iort_station.data.export import write
from iort_station.data.recorded import select
from iort_station.errors import StationError
from testkit.dynamodb import ROBOTS, TELEMETRY, item_of
from testkit.waiting import until
from tests.bridge.judge import PAUSED, PLAYING, Got, Judge
from tests.unit.station.data.test_queries import START, cloud_of

START_NS = START * 1000
HOUR_S, HZ = 3600, 10
MADE = MessageType("made", "/lab/made", "lab_msgs/msg/Made", "", "float64 x\nuint8 n\n")


def put(cloud: Any, stream: str, *batches: Batch) -> None:
    for batch in batches:
        topic = build_topic(RECORD, "car", stream)
        cloud.table.put(TELEMETRY, item_of(batch, topic))


def raw(i: int) -> bytes:
    """A message of `MADE`, as ROS 2 sends it."""
    return b"\0\1\0\0" + struct.pack("<dB", i / 8, i % 256)


@pytest.fixture(scope="module")
def hour() -> Any:
    """An hour of a car: numbers with nulls and a sensor that is not fitted, overlapping batches with names
    of several levels, and messages of ROS 2."""
    cloud = cloud_of(page_items=200)
    # As Lambda 2 has seen them.
    cloud.table.put(ROBOTS, {ROBOT: {"S": "car"}, "streams": {"SS": ["vesc", POSE_STREAM, "made"]}})
    for second in range(HOUR_S):
        times = [START + second * 1_000_000 + i * 1_000_000 // HZ for i in range(HZ)]
        first = second * HZ
        speed = [None if (first + i) % 97 == 0 else float(first + i) for i in range(HZ)]
        put(
            cloud,
            "vesc",
            Batch(
                "0badcafe",
                second,
                times,
                {"speed": speed, "temp_motor": [-50.0 + (second > 9)] * HZ, "fault_code": [0] * HZ},
            ),
        )
        if second % 10 == 0:
            # Two publishers, whose batches overlap.
            for boot in (0, 1):
                at = [START + second * 1_000_000 + i * 80_000 + boot * 300_000 for i in range(12)]
                columns = {"pose.position.x": [second + boot / 2] * 12, "pose.frame": ["map"] * 12}
                put(cloud, POSE_STREAM, Batch(f"0badcaf{boot}", second, at, columns))
            kind = RosType(MADE.topic, MADE.kind, MADE.md5sum, MADE.definition)
            raws = [raw(second + i) for i in range(10)]
            at = [START + second * 1_000_000 + i * 100_000 for i in range(10)]
            put(cloud, "made", Batch("0badcafe", second, at, {}, 0, Messages(kind.id, kind.layout, raws)))
    put(
        cloud,
        TYPES_STREAM,
        Batch("0badcafe", 0, [START], {name: [value] for name, value in MADE.sample().items()}),
    )
    return cloud


@pytest.fixture
def judge(hour: Any) -> Any:
    source = Range(hour, ["car"], START, START + HOUR_S * 1_000_000)
    with playing(source, "an hour", Access(port=0)) as served, Judge(served.url) as judge:
        yield judge


def flat(fields: Any, path: str = "") -> dict[str, Any]:
    if not isinstance(fields, dict):
        return {path: fields}
    return {
        name: one
        for key in fields
        for name, one in flat(fields[key], f"{path}.{key}" if path else key).items()
    }


def samples(found: Any) -> set[tuple[int, str]]:
    """Samples as a set of times and values."""
    return {(t_ns, json.dumps(flat(fields), sort_keys=True)) for t_ns, fields in found}


def queried(
    cloud: Any, stream: str, start_us: int, end_us: int = START + HOUR_S * 1_000_000
) -> set[tuple[int, str]]:
    """What `iort query` returns."""
    found = data.query(cloud, "car", stream, start_us, end_us)
    columns = {name: data.values(column) for name, column in found.columns.items()}
    return samples(
        (t_us * 1000, {name: column[i] for name, column in columns.items()})
        for i, t_us in enumerate(found.times_us.tolist())
    )


STREAMS = ("vesc", POSE_STREAM, "made")


def test_a_client_sees_the_range_the_topics_and_their_schemas(judge: Judge) -> None:
    info = judge.of("server")[0]["info"]
    assert (info["dataStartTime"]["sec"], info["dataEndTime"]["sec"]) == (
        START_NS // 10**9,
        START_NS // 10**9 + 3600,
    )
    assert "playbackControl" in info["capabilities"]
    assert "clientPublish" not in info["capabilities"]
    assert judge.topics.keys() == {"/iort/vesc", "/iort/pose", "/iort/made", "/lab/made"}
    original = judge.topics["/lab/made"]
    assert (original["encoding"], original["schemaName"]) == ("cdr", MADE.kind)
    assert (original["schemaEncoding"], original["schema"]) == ("ros2msg", MADE.definition)
    schema = json.loads(judge.topics["/iort/vesc"]["schema"])
    assert schema["properties"]["speed"]["description"].startswith("erpm: ")
    assert schema["properties"]["temp_motor"]["description"].startswith("degC")
    pose = json.loads(judge.topics["/iort/pose"]["schema"])
    assert pose["properties"]["pose"]["properties"]["position"]["properties"]["x"]["type"] == "number"


@pytest.mark.parametrize(("speed", "seconds"), [(1.0, 11), (10.0, 60)])
def test_after_a_seek_come_exactly_the_samples_of_a_query(
    judge: Judge, hour: Any, speed: float, seconds: int
) -> None:
    for topic in judge.topics:
        judge.do("subscribe", topic=topic)
    # Something is played before, and must not be mixed with what follows.
    judge.play("before", speed=speed)
    until(lambda: next(judge.got("/iort/vesc"), None))
    # Between two samples.
    seek_us = START + (HOUR_S - seconds) * 1_000_000 - 55_000
    began = judge.play("seek", seek_ns=seek_us * 1000, speed=speed)
    judge.ended(began)

    def sought(topic: str) -> list[Got]:
        return [one for one in judge.got(topic, after=began) if one.t_ns >= seek_us * 1000]

    for stream in STREAMS:
        expected_samples = queried(hour, stream, seek_us)
        # The state of the end may overtake the last messages.
        until(lambda: len(sought(f"/iort/{stream}")) >= len(expected_samples))  # noqa: B023 - within the loop
        found = [(one.t_ns, one.fields) for one in sought(f"/iort/{stream}")]
        assert len(found) >= 10
        assert samples(found) == expected_samples, stream
        assert [t_ns for t_ns, _ in found] == sorted(t_ns for t_ns, _ in found)
    # The state of the seek may overtake the last messages of what was played before, and nothing else of it.
    late = list(judge.got(after=began))
    first = next(i for i, one in enumerate(late) if one.t_ns >= seek_us * 1000)
    assert all(one.t_ns >= seek_us * 1000 for one in late[first:])
    for stream in STREAMS:
        # With them, it is what was played from the begin on, each sample once.
        former = [one for one in judge.got(f"/iort/{stream}") if one.t_ns < seek_us * 1000]
        if former:
            played = queried(hour, stream, START, former[-1].t_ns // 1000 + 1)
            assert samples((one.t_ns, one.fields) for one in former) == played
            assert len(former) == len(played)
    times = [START + (second * 10 + i) * 100_000 for second in range(0, HOUR_S, 10) for i in range(10)]
    expected = [
        (t_us * 1000, raw((t_us - START) // 100_000 % 100 + (t_us - START) // 10**6 // 10 * 10))
        for t_us in times
        if t_us >= seek_us
    ]
    assert [(one.t_ns, one.data) for one in sought("/lab/made")] == expected


def test_a_paused_client_sees_the_first_sample_from_where_it_sought_and_gets_it_once(judge: Judge) -> None:
    judge.do("subscribe", topic="/iort/vesc")
    seek_ns = START_NS + (HOUR_S - 1) * 10**9
    judge.play("pause", seek_ns=seek_ns, play=False)
    until(lambda: [one for one in judge.got("/iort/vesc") if one.t_ns == seek_ns])
    began = judge.play("play", speed=10.0)
    judge.ended(began)
    until(lambda: any(one.t_ns == seek_ns + 9 * 10**9 // HZ for one in judge.got("/iort/vesc")))
    times = [one.t_ns for one in judge.got("/iort/vesc") if one.t_ns >= seek_ns]
    assert times == [seek_ns + i * 10**9 // HZ for i in range(HZ)]


def test_play_pause_and_speed_are_confirmed_and_odd_speeds_are_bounded(judge: Judge) -> None:
    judge.do("subscribe", topic="/iort/vesc")
    state = judge.events[judge.play("fast", speed=1e9)]
    assert (state["status"], state["speed"]) == (PLAYING, 100.0)
    for odd in (0.0, -1.0, math.nan):
        judge.do("playback", play=True, speed=odd, id=f"odd {odd}")
    state = judge.events[judge.play("pause", speed=2.5, play=False, seek_ns=5)]
    assert (state["status"], state["speed"], state["seeked"]) == (PAUSED, 2.5, True)
    # A time before the range is its begin.
    assert state["at_ns"] == START_NS
    assert all(one["speed"] == 100.0 for one in judge.of("state") if str(one["id"]).startswith("odd"))


def test_an_mcap_file_is_played_byte_for_byte(hour: Any, tmp_path: Path) -> None:
    path = tmp_path / "ride.mcap"
    with mcap(path) as file:
        write(hour, select("car", "made", START, START + 20_000_000), file)
    with playing(McapFile(path), "a file", Access(port=0)) as served, Judge(served.url) as judge:
        assert judge.topics["/lab/made"]["schema"] == MADE.definition
        judge.do("subscribe", topic="/lab/made")
        judge.ended(judge.play("play", speed=100.0))
        until(lambda: len(list(judge.got())) >= 20)
        assert [one.data for one in judge.got()] == [raw(i) for i in range(20)]


@pytest.mark.parametrize(
    ("content", "words"), [(b"no mcap", "must be an MCAP file"), (b"", "must be an MCAP file")]
)
def test_a_file_that_is_none_is_refused(content: bytes, words: str, tmp_path: Path) -> None:
    path = tmp_path / "ride.mcap"
    path.write_bytes(content)
    with pytest.raises(StationError, match=words):
        McapFile(path)


def test_an_empty_range_says_what_to_do(hour: Any) -> None:
    with pytest.raises(StationError, match="car: nothing is recorded in this range; `iort runs car`"):
        Range(hour, ["car"], START - 10, START)


def test_a_whole_recording_has_every_sample(hour: Any) -> None:
    source = Range(hour, ["car"], None, None)
    # After the last sample of all.
    assert (source.start_ns, source.end_ns) == (START_NS, START_NS + (HOUR_S * 10 - 1) * 10**8 + 1000)
    found = list(source.messages(source.start_ns, frozenset(range(4)), lambda: None, lambda _text: None))
    assert [one.t_ns for one in found] == sorted(one.t_ns for one in found)
    assert len(found) == HOUR_S * HZ + 2 * 12 * HOUR_S // 10 + 2 * HOUR_S
