"""What `iort-agent check` says of recordings: those that can be played, and those that cannot."""

from __future__ import annotations

import shutil
import struct
from functools import partial
from pathlib import Path
from typing import Any, Callable

import pytest
from rosbags import rosbag2
from rosbags.rosbag1 import Writer as Writer1
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from iort_agent.config import load_config
from iort_agent.errors import SourceError
from iort_agent.sources import FAIL, OK, Finding
from tests.unit.agent.sources.test_bag import START, STORAGES, needs_mcap, play, write_ros1, write_ros2
from tests.unit.agent.sources.test_vesc_csv import row, write
from tests.unit.agent.test_agent import config_file


def found(folder: Path, path: Path, settings: str = "") -> Finding:
    config = load_config(config_file(folder, f"{{type: bag, path: {path}, {settings}}}"))
    (finding,) = config.sources[0].check("source 0")
    return finding


def mcap_of(folder: Path) -> Path:
    return next(write_ros2(folder / "drive", "mcap").glob("*.mcap"))


@pytest.mark.parametrize(
    ("settings", "streams"), [("", "vesc"), ("topics: {/servo: servo, /sensors/core: car}", "car, servo")]
)
def test_a_recording_that_can_be_played(tmp_path: Path, settings: str, streams: str) -> None:
    finding = found(tmp_path, write_ros1(tmp_path / "a.bag"), settings)
    assert (finding.level, finding.text) == (OK, f"can be opened, for {streams}")


def test_a_log_that_can_be_played(tmp_path: Path) -> None:
    path = write(tmp_path, row(1000), name="2024-06-12_00-34-31.csv")
    assert found(tmp_path, path, "stamps: original").level == OK


def test_a_topic_without_a_message(tmp_path: Path) -> None:
    finding = found(tmp_path, write_ros1(tmp_path / "a.bag", count=0))
    assert (finding.level, finding.text) == (FAIL, "it has no message of vesc")


def test_a_log_with_more_columns_than_a_sample_may_have(tmp_path: Path) -> None:
    names = [f"x{i}" for i in range(754)]
    path = write(tmp_path, ";".join(["1000", *["1"] * 754]), header=";".join(["ms_today", *names]))
    finding = found(tmp_path, path)
    assert finding.level == FAIL
    assert "754 of its columns hold numbers, and a sample has at most 512 fields" in finding.text


def cut(folder: Path) -> Path:
    path = folder / "cut.mcap"
    path.write_bytes(mcap_of(folder).read_bytes()[:-500])
    return path


def misnamed(folder: Path) -> Path:
    return Path(shutil.copy(mcap_of(folder), folder / "drive.bag"))


def without_metadata(folder: Path) -> Path:
    path = write_ros2(folder / "drive", STORAGES[0])
    (path / "metadata.yaml").unlink()
    return path


def bad_metadata(folder: Path) -> Path:
    path = write_ros2(folder / "drive", STORAGES[0])
    (path / "metadata.yaml").write_text("x: [1")
    return path


def in_capitals(folder: Path) -> Path:
    return write_ros1(folder / "a.bag").rename(folder / "A.BAG")


def ros1_as_mcap(folder: Path) -> Path:
    return write_ros1(folder / "a.bag").rename(folder / "a.mcap")


def cut_database(folder: Path) -> Path:
    path = folder / "cut.db3"
    path.write_bytes(next(write_ros2(folder / "drive", "sqlite3").glob("*.db3")).read_bytes()[:6000])
    return path


def zeros(folder: Path) -> Path:
    path = folder / "zeros.bag"
    path.write_bytes(bytes(1000))
    return path


def service_events(folder: Path) -> Path:
    """As ROS 2 writes them: the service's own definition instead of the event's (ros2/rosbag2#2365)."""
    from mcap.writer import Writer

    path = folder / "services.mcap"
    event = b"=" * 80 + b"\nSRV: std_srvs/srv/SetBool\nbool data\n---\nbool success\nstring message\n"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="test")
        number = writer.register_schema("std_msgs/msg/Float64", "ros2msg", b"float64 data\n")
        service = writer.register_schema("std_srvs/srv/SetBool_Event", "ros2msg", event)
        for topic, schema in (("/servo", number), ("/set/_service_event", service)):
            channel = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channel, START, b"\0\1\0\0" + bytes(8), START)
        writer.finish()
    return path


def bomb(folder: Path, compress: str) -> Path:
    """A bag of some kB with a message of 65 MB."""
    path = folder / "bomb.bag"
    writer = Writer1(path)
    writer.set_compression(Writer1.CompressionFormat[compress])
    with writer:
        topic = writer.add_connection("/blob", "lab_msgs/msg/Blob", msgdef="uint8[] data\n", md5sum="0" * 32)
        writer.write(topic, START, struct.pack("<I", 65 << 20) + bytes(65 << 20))
    return path


def mcap_bomb(folder: Path, mode: str, storage: str) -> Path:
    """The same in a folder of ROS 2, with its chunks or its messages compressed."""
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg("uint8[] data\n", "lab_msgs/msg/Blob"))
    plugin, compressed = rosbag2.StoragePlugin[storage], rosbag2.CompressionMode[mode]
    writer = rosbag2.Writer(folder / "bomb", version=8, storage_plugin=plugin)
    writer.set_compression(compressed, rosbag2.CompressionFormat.ZSTD)
    with writer:
        topic = writer.add_connection("/blob", "lab_msgs/msg/Blob", typestore=store)
        writer.write(topic, START, b"\0\1\0\0" + struct.pack("<I", 65 << 20) + bytes(65 << 20))
    return folder / "bomb"


BOMBS = [
    *(partial(bomb, compress=kind) for kind in ("BZ2", "LZ4")),
    *(partial(mcap_bomb, mode=mode, storage="MCAP") for mode in ("STORAGE", "MESSAGE")),
    partial(mcap_bomb, mode="MESSAGE", storage="SQLITE3"),
]


@needs_mcap
@pytest.mark.parametrize("make", BOMBS)
def test_what_inflates_without_end_is_not_inflated(tmp_path: Path, make: Callable[[Path], Path]) -> None:
    path = make(tmp_path)
    with pytest.raises(
        SourceError, match=rf"{path.name}: a chunk of [\d,]+ bytes inflates to more than 67,1"
    ):
        play(path, topics=(("/blob", "blob"),), large="upload")


def wrong_index(folder: Path) -> Path:
    """A bag whose index has other times than its messages."""
    path = write_ros1(folder / "a.bag")
    content = path.read_bytes()
    time = b"time=" + struct.pack("<LL", START // 10**9, 0)
    path.write_bytes(content.replace(time, b"time=" + bytes(8), 1))
    return path


ANYWHERE = [
    (wrong_index, "is damaged: its records do not fit together: AssertionError at `assert entry.time =="),
    (without_metadata, "`ros2 bag reindex FOLDER` writes its metadata.yaml; or name the .mcap or .db3"),
    (bad_metadata, "`ros2 bag reindex FOLDER`"),
    (in_capitals, "is a bag of ROS 1 by its content: rename it to A.bag"),
    (ros1_as_mcap, "is a bag of ROS 1 by its content: rename it to a.bag"),
    (zeros, "was it copied whole?"),
]
# The newest rosbags for Python 3.8 writes no MCAP, and says other things.
NEWER = [
    (cut, "`mcap recover IN.mcap -o OUT.mcap`"),
    (misnamed, "is MCAP by its content: rename it to drive.mcap"),
    (cut_database, "`sqlite3 IN.db3 .recover | sqlite3 OUT.db3`"),
    (service_events, "--exclude-topic-regex '.*/_service_event'`"),
]


@pytest.mark.parametrize(("make", "advice"), ANYWHERE + (NEWER if "mcap" in STORAGES else []))
def test_what_cannot_be_read_comes_with_what_to_do(tmp_path: Path, make: Any, advice: str) -> None:
    path = make(tmp_path)
    topics = (("/set/_service_event", "event"),) if make is service_events else None
    with pytest.raises(SourceError) as raised:
        play(path, topics=topics)
    assert advice in str(raised.value)
    assert "\n" not in str(raised.value)
    finding = found(tmp_path, path, "topics: {/set/_service_event: event}" if topics else "")
    assert (finding.level, finding.text) == (FAIL, str(raised.value))
