"""Which recordings and topics an import takes."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from mcap.writer import CompressionType, Writer

from iort_station.cost.report import Imported, archive_units, import_dollars, table_units
from iort_station.errors import UsageError
from iort_station.imports.choice import Choice
from iort_station.imports.plan import recordings, said_robot


def test_paths_stand_for_recordings(tmp_path: Path) -> None:
    for name in (
        "a.bag",
        "b.mcap",
        "c.db3",
        "d.csv",
        "notes.txt",
        "deep/e.bag",
        "ros2/metadata.yaml",
        "ros2/ros2_0.mcap",
    ):
        (file := tmp_path / name).parent.mkdir(exist_ok=True)
        file.write_text("")
    there = ["a.bag", "b.mcap", "c.db3", "d.csv", "deep/e.bag", "ros2"]
    assert list(recordings([str(tmp_path)])) == [tmp_path / one for one in there]
    assert list(recordings([str(tmp_path / "*.bag")])) == [tmp_path / "a.bag"]
    # Its file stands for the folder, and nothing comes twice.
    twice = [str(tmp_path / "ros2" / "ros2_0.mcap"), str(tmp_path / "ros2"), str(tmp_path / "a.bag")]
    assert list(recordings(twice)) == [tmp_path / "ros2", tmp_path / "a.bag"]
    for absent in ("none.bag", "*.none"):
        with pytest.raises(UsageError, match="no such file or folder"):
            list(recordings([str(tmp_path / absent)]))


def test_streams_are_named_as_init_names_them() -> None:
    there = {
        "/sensors/core": "vesc_msgs/msg/VescStateStamped",
        "/camera/info": "sensor_msgs/msg/CameraInfo",
        "/agent": "std_msgs/msg/String",
        "/rosout": "rcl_interfaces/msg/Log",
        "/_hidden/a": "std_msgs/msg/String",
    }
    chosen, left_out = Choice().of(there)
    assert {topic: one.stream for topic, one in chosen.items()} == {
        "/sensors/core": "vesc",
        "/camera/info": "camera-info",
        "/agent": "topic-agent",
    }
    assert left_out == {"/rosout": "ROS' own", "/_hidden/a": "ROS' own"}
    # Names that ROS would not have.
    odd = dict.fromkeys(("/a b", "/ä", "", "odom", "/odom"), "std_msgs/msg/String")
    chosen, left_out = Choice().of(odd)
    assert {topic: one.stream for topic, one in chosen.items()} == {"/odom": "odom"}
    assert left_out["odom"] == "its stream odom is that of /odom: --config can name another"
    assert all("is none of ROS'" in left_out[topic] for topic in ("/a b", "/ä", ""))
    only, _ = Choice(only=("/camera/*",)).of(there)
    assert list(only) == ["/camera/info"]
    with pytest.raises(UsageError, match="has no such topic"):
        Choice(only=("/none",)).of(there)


def test_the_archive_costs_less_than_the_table() -> None:
    one = Imported(seconds=5 * 3600.0, stream_hours=5, size=1_000_000_000)
    table, archive = sum(import_dollars(table_units(one, 90))), sum(import_dollars(archive_units(one)))
    assert 0 < archive < table
    # Items of 33 KB, each written with its second, and read three times.
    writes, reads = 18_000 * (33 + 1) * 0.705e-6, 3 * 18_000 * 9 * 0.141e-6
    assert import_dollars(table_units(one, 90))[0] == pytest.approx(writes + reads, rel=0.01)


def test_patterns_and_links_are_taken_as_they_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("a.bag", "of [1].bag", "x/y/z/b.bag"):
        (file := tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        file.write_text("")
    assert list(recordings(["*.bag"])) == [tmp_path / "a.bag", tmp_path / "of [1].bag"]
    assert list(recordings(["of [1].bag"])) == [tmp_path / "of [1].bag"]
    assert list(recordings(["x/*/*/b.bag"])) == list(recordings(["x/**/*.bag"])) == [tmp_path / "x/y/z/b.bag"]
    # Links that go round, and that lead nowhere; and what only has the name of a recording.
    (tmp_path / "x" / "round").symlink_to(tmp_path / "x")
    (tmp_path / "x" / "again").symlink_to(tmp_path / "x" / "y")
    (tmp_path / "x" / "gone.bag").symlink_to(tmp_path / "none.bag")
    os.mkfifo(tmp_path / "x" / "pipe.bag")
    assert list(recordings(["x"])) == [tmp_path / "x/y/z/b.bag"]


def test_a_damaged_index_says_no_robot(tmp_path: Path) -> None:
    with (path := tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start()
        writer.add_metadata("incident", {"agent": '{"robot": "car3"}'})
        writer.finish()
    assert said_robot(path) == "car3"
    content = path.read_bytes()
    for at in range(8, len(content) - 8):
        path.write_bytes(content[:at] + b"\xff" + content[at + 1 :])
        assert said_robot(path) in {"", "car3"} or at in range(content.index(b"car3"), len(content))
