"""Recordings with fragile contents, played by the agent: the table has all of it, and exports return it."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from rosbags.rosbag1 import Writer

from iort_station.fleet import robots
from iort_station.operations import audit
from local.cloud import EmbeddedCloud
from testkit.ros1_types import Message, header
from tests.local.conftest import run_agent
from tests.local.data.drives import Agent
from tests.ros.mixed.compare import compare, read
from tests.ros.mixed.robot import TOPICS, Maker, Topic
from tests.unit.station.data.test_export import KNOWN

COUNT, RATE_HZ = 500, 50
Recorded = Mapping[str, tuple[Message, Sequence[bytes]]]


def bag_of(path: Path, topics: Recorded, start_ns: int) -> Path:
    """Write a bag of these messages, at 50 Hz."""
    with Writer(path) as writer:
        for topic, (message, those) in topics.items():
            connection = writer.add_connection(
                topic,
                message.kind.replace("/", "/msg/"),
                msgdef=message.definition,
                md5sum=message.md5sum,
            )
            for i, content in enumerate(those):
                writer.write(connection, start_ns + i * 1_000_000_000 // RATE_HZ, content)
    return path


def playing(path: Path, streams: Mapping[str, str], **settings: Any) -> dict[str, Any]:
    return {"type": "bag", "path": str(path), "topics": dict(streams), "speed": 0, **settings}


def test_a_recording_played_twice_is_stored_twice(
    embedded: EmbeddedCloud, bundle: Callable[..., robots.Bundle], tmp_path: Path
) -> None:
    ticks = Topic("/count", "std_msgs/Float32", RATE_HZ)
    maker = Maker(ticks, 1)
    content = {ticks.name: (ticks.message, [maker.made(n, b"") for n in range(COUNT)])}
    path = bag_of(tmp_path / "count.bag", content, time.time_ns() - 600 * 10**9)
    car = bundle(
        sources=[playing(path, {ticks.name: "count"}, stamps="original")],
        queue={"path": "spool.db"},
        live={"enabled": False},
    )
    for _ in range(2):
        assert run_agent(car)["streams"]["count"]["samples"] == COUNT
    runs: Counter[str] = Counter()
    for batch in audit.batches(embedded.cloud, car.robot, "count"):
        runs[batch.boot] += len(batch.times_us)
    assert sorted(runs.values()) == [COUNT, COUNT]


START_US = 1_700_000_000_000_000


def shapes() -> Recorded:
    """Return one topic for each shape that needs care, and one for each type of the mixed robot."""
    known = {f"/known/{name.replace(' ', '_')}": made for name, made in KNOWN.items()}
    for topic in TOPICS.values():
        # Another test covers an image that is too large for a message.
        if topic.name != "/camera/large":
            maker = Maker(topic, 7)
            headers = [header(n, START_US + n * 1_000_000 // RATE_HZ, b"odom") for n in range(20)]
            known[topic.name] = topic.message, [maker.made(n, one) for n, one in enumerate(headers)]
    return known


SHAPES = shapes()


@pytest.fixture(scope="module")
def shaped(embedded: EmbeddedCloud, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """Return a robot that has played a bag of every shape, and the bag."""
    folder = tmp_path_factory.mktemp("shapes")
    path = bag_of(folder / "shapes.bag", SHAPES, START_US * 1000)
    streams = {topic: topic[1:].replace("/", "_") for topic in SHAPES}
    # One source each, so that a failing source does not hide the others.
    sources = [playing(path, {topic: stream}, stamps="original") for topic, stream in streams.items()]
    settings = {"sources": sources, "live": {"enabled": False}}
    car = robots.add(embedded.cloud, "shapes", out=folder, settings=settings)
    Agent(car).process.wait(300)
    return car.robot, path


@pytest.mark.parametrize("topic", SHAPES)
def test_every_shape_is_exported_as_it_was_recorded(
    iort: Callable[..., Any], shaped: tuple[str, Path], topic: str, tmp_path: Path
) -> None:
    (robot, path), exported = shaped, tmp_path / "exported.bag"
    stream = topic[1:].replace("/", "_")
    done = iort("export", robot, stream, "--last", "all", "--out", str(exported))
    assert done.exit_code == 0, done.exception
    whole = read(path)
    recorded = whole._replace(kinds={topic: whole.kinds[topic]})
    assert [str(one) for one in compare(recorded, read(exported))] == []
