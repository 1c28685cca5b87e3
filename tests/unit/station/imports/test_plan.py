"""Which recordings and topics an import takes."""

from __future__ import annotations

from pathlib import Path

import pytest

from iort_station.cost.imports import Imported, archive_units, dollars, table_units
from iort_station.errors import UsageError
from iort_station.imports.choice import Choice
from iort_station.imports.plan import recordings


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
    only, _ = Choice(only=("/camera/*",)).of(there)
    assert list(only) == ["/camera/info"]
    with pytest.raises(UsageError, match="has no such topic"):
        Choice(only=("/none",)).of(there)


def test_the_archive_costs_less_than_the_table() -> None:
    one = Imported(seconds=5 * 3600.0, stream_hours=5, size=1_000_000_000)
    table, archive = sum(dollars(table_units(one, 90))), sum(dollars(archive_units(one)))
    assert 0 < archive < table
    # Items of 33 KB, each written with its second, and read three times.
    writes, reads = 18_000 * (33 + 1) * 0.705e-6, 3 * 18_000 * 9 * 0.141e-6
    assert dollars(table_units(one, 90))[0] == pytest.approx(writes + reads, rel=0.01)
