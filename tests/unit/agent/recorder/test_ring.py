"""The ring on disk: what it keeps, what it survives, and what it says of what it has not."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any, Iterator

import pytest
from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader, make_reader

from iort_agent.errors import AgentError
from iort_agent.recorder.config import RecorderConfig
from iort_agent.recorder.ring import DISK, EVERY, MEMORY, RESTART, Ring
from iort_agent.recorder.segment import SegmentFile
from iort_agent.sources.intake import Selected
from iort_contract.catalog.streams import TYPES_STREAM
from iort_contract.ros.message import MessageType, RosMessage, RosType
from testkit.agent import ManualClock
from testkit.waiting import GUARD_S

S = 1_000_000
T0 = 1_700_000_000_000_000
DEFINITION = "float64 x\nuint8[] data"
IMU = RosType("/imu", "a_msgs/Imu", "1" * 32, DEFINITION)
SCAN = RosType("/scan", "a_msgs/msg/Scan", "RIHS01_1", DEFINITION)
KEPT_FREE = {"keep_free_mb": 0.0}


class Desk:
    """A ring whose thread is this one."""

    def __init__(
        self, folder: Path, clock: ManualClock | None = None, run: str = "a", **settings: Any
    ) -> None:
        self.clock = clock or ManualClock(now_us=T0)
        self.folder = folder
        self.passed: list[tuple[str, int, Any]] = []
        self.ring = self.again(run, **settings)

    def again(self, run: str = "b", **settings: Any) -> Ring:
        config = RecorderConfig(**{**KEPT_FREE, **settings})
        self.ring = Ring(config, self.clock, folder=self.folder, run=run, reserve=0)
        self.emit = self.ring.around(self._emit, only={"alone"})
        return self.ring

    def _emit(self, stream: str, t_us: int, values: Any, *, more: bool = False) -> float:
        self.passed.append((stream, t_us, values))
        return 7.0

    def imu(self, first: int, count: int, size: int = 8) -> None:
        for i in range(first, first + count):
            self.emit("imu", T0 + i, RosMessage(body(i, size), IMU))

    def pass_s(self, seconds: float) -> None:
        """Let time pass as the thread would."""
        for _ in range(round(seconds / 0.2)):
            self.clock.advance(0.2)
            self.ring.work()

    def kill(self) -> None:
        """End as kill -9 does: what is not written is gone, and the lock with the process."""
        self.ring._folder.close()

    def read(self, *wanted: str) -> list[bytes]:
        return [message.data for message in self.ring.read(0, 2**62, wanted or None)]


def body(i: int, size: int = 8) -> bytes:
    return i.to_bytes(8, "little") + hashlib.sha256(b"%d" % i).digest() * (size // 32)


@pytest.fixture
def desk(tmp_path: Path) -> Iterator[Desk]:
    desk = Desk(tmp_path / "ring")
    yield desk
    desk.ring.close()


# --- what it keeps -----------------------------------------------------------------------------------


def test_messages_of_ros_are_kept_as_published_with_their_definition(desk: Desk) -> None:
    desk.emit("imu", T0 + 1, RosMessage(body(1), IMU))
    desk.emit("scan", T0 + 2, RosMessage(body(2), SCAN))
    desk.pass_s(1)
    first, second = desk.ring.read(0, 2**62)
    assert (first.data, first.t_us, first.ring_us, first.seq) == (body(1), T0 + 1, T0, 0)
    channel = first.channel
    assert (channel.stream, channel.topic, channel.encoding) == ("imu", "/imu", "ros1")
    assert (channel.schema, channel.schema_encoding) == ("a_msgs/Imu", "ros1msg")
    assert (channel.definition, channel.metadata["md5sum"]) == (DEFINITION.encode(), "1" * 32)
    channel = second.channel
    assert (channel.encoding, channel.schema, channel.schema_encoding) == (
        "cdr",
        "a_msgs/msg/Scan",
        "ros2msg",
    )
    assert channel.run == "a"


def test_other_samples_are_json_with_a_schema(desk: Desk) -> None:
    values = {
        "x": 1.5,
        "n": 2,
        "ok": True,
        "text": "é",
        "none": None,
        "odd": float("nan"),
        "raw": b"\x00\xff",
    }
    desk.emit("vesc", T0, values)
    desk.pass_s(1)
    (message,) = desk.ring.read(0, 2**62)
    assert json.loads(message.data) == {**values, "odd": None, "raw": "AP8="}
    assert (message.channel.topic, message.channel.encoding) == ("vesc", "json")
    schema = json.loads(message.channel.definition)
    assert schema["properties"]["x"] == {"type": ["number", "null"]}
    assert schema["properties"]["ok"] == {"type": ["boolean", "null"]}
    assert schema["properties"]["raw"] == {"type": "string", "contentEncoding": "base64"}


def test_samples_go_on_unchanged_and_those_for_the_ring_alone_do_not(desk: Desk) -> None:
    assert desk.emit("vesc", 5, {"x": 1}, more=True) == 7.0
    kind = MessageType("alone", "/alone", "a_msgs/A", "1", DEFINITION)
    desk.emit(TYPES_STREAM, 5, kind.sample())
    desk.emit("alone", 6, RosMessage(b"1", IMU))
    desk.emit(TYPES_STREAM, 5, kind._replace(stream="imu").sample())
    assert [stream for stream, _, _ in desk.passed] == ["vesc", TYPES_STREAM, TYPES_STREAM]
    desk.pass_s(1)
    assert [message.channel.stream for message in desk.ring.read(0, 2**62)] == ["vesc", "alone"]


def test_the_ring_has_the_message_whose_fields_are_selected(desk: Desk) -> None:
    values = Selected({"x": 1.0})
    values.whole = RosMessage(body(3), IMU)
    desk.emit("imu", T0, values)
    desk.pass_s(1)
    assert desk.read() == [body(3)]
    (_, _, passed) = desk.passed[0]
    assert passed == {"x": 1.0}
    assert passed.whole is None, "the lanes hold a second of samples"


@pytest.mark.parametrize(
    ("topics", "kept"),
    [
        (["*"], ["/imu", "/scan", "vesc"]),
        (["/i*"], ["/imu"]),
        (["scan"], ["/scan"]),
        (["vesc", "/imu"], ["/imu", "vesc"]),
    ],
)
def test_patterns_choose_topics_and_streams(tmp_path: Path, topics: list[str], kept: list[str]) -> None:
    desk = Desk(tmp_path, topics=tuple(topics))
    desk.emit("imu", 1, RosMessage(b"1", IMU))
    desk.emit("scan", 2, RosMessage(b"2", SCAN))
    desk.emit("vesc", 3, {"x": 1})
    desk.pass_s(1)
    assert [message.channel.topic for message in desk.ring.read(0, 2**62)] == kept
    assert len(desk.passed) == 3
    desk.ring.close()


def test_a_reader_chooses_a_window_and_topics(desk: Desk) -> None:
    for i in range(30):
        desk.imu(i, 1)
        desk.emit("vesc", T0, {"x": i})
        desk.pass_s(1)
    window = list(desk.ring.read(T0 + 10 * S, T0 + 12 * S, ["/im*"]))
    assert [message.data for message in window] == [body(10), body(11), body(12)]
    assert len({id(message.channel) for message in desk.ring.read(0, 2**62)}) == 2, "over segments, too"
    assert len(desk.ring.segments(0, 2**62)) >= 3


def test_a_message_that_waited_for_others_has_the_time_of_its_arrival(desk: Desk) -> None:
    desk.clock.advance(1)
    desk.emit("imu", 1, RosMessage(b"1", IMU, arrival_us=desk.clock.now_us() - 300_000))
    desk.emit("imu", 1, RosMessage(b"1", IMU, arrival_us=desk.clock.now_us() - 3600 * S))
    desk.pass_s(1)
    assert [message.ring_us for message in desk.ring.read(0, 2**62)] == [T0 + 700_000, T0 + 1_000_000]


# --- what it survives --------------------------------------------------------------------------------


def test_a_killed_process_loses_at_most_the_last_second(tmp_path: Path) -> None:
    desk = Desk(tmp_path)
    for i in range(50):
        desk.imu(i * 10, 10)
        desk.pass_s(0.2)
    desk.kill()
    again = Desk(tmp_path, desk.clock, run="b")
    kept = again.read()
    assert kept == [body(i) for i in range(len(kept))]
    assert len(kept) >= 450
    again.imu(1000, 1)
    again.pass_s(1)
    assert again.read() == [*kept, body(1000)]
    (restart,) = again.ring.drops(0, 2**62)
    assert (restart.stream, restart.why) == (EVERY, RESTART)
    assert restart.from_us <= restart.to_us
    again.ring.close()


def test_other_readers_open_closed_segments_and_what_a_killed_process_left(tmp_path: Path) -> None:
    desk = Desk(tmp_path)
    for i in range(60):
        desk.imu(i, 1)
        desk.emit("vesc", i, {"x": i})
        desk.pass_s(0.2)
    desk.kill()
    first, *_, last = sorted(tmp_path.glob("*.mcap"))
    with first.open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == sum(1 for _ in make_reader(file).iter_messages())
    with last.open("rb") as file:
        messages = NonSeekingReader(file).iter_messages(log_time_order=False)
        found = []
        with pytest.raises(EndOfFile):
            found.extend((channel.topic, message.data) for _, channel, message in messages)
    assert ("/imu", body(58)) in found


@pytest.mark.parametrize("damage", ["cut", "zeros", "flip"])
def test_a_torn_or_damaged_segment_costs_only_what_is_damaged(tmp_path: Path, damage: str) -> None:
    desk = Desk(tmp_path, compression="none")
    for i in range(20):
        desk.imu(i, 5, 640)
        desk.pass_s(0.4)
    desk.kill()
    (path,) = tmp_path.glob("*.mcap")
    data = bytearray(path.read_bytes())
    at = len(data) - 1000
    if damage == "cut":
        del data[at:]
    elif damage == "zeros":
        data[at:] = bytes(1000)
    else:
        data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    again = Desk(tmp_path, desk.clock)
    kept = again.read()
    known = {body(i, 640) for i in range(200)}
    assert len(kept) > 10
    assert set(kept) <= known
    again.ring.close()


def test_a_clock_that_is_set_back_does_not_disorder_the_ring(tmp_path: Path) -> None:
    desk = Desk(tmp_path)
    desk.imu(0, 3)
    desk.pass_s(1)
    desk.clock.set_wall(T0 - 3600 * S)
    desk.imu(3, 3)
    desk.pass_s(1)
    assert desk.ring.ring_us(desk.clock.now_us()) == desk.ring.now_us() == T0 + 2 * S
    desk.ring.close()
    desk.again("c")
    desk.imu(6, 3)
    desk.pass_s(1)
    assert desk.read() == [body(i) for i in range(9)]
    times = [message.ring_us for message in desk.ring.read(0, 2**62)]
    assert times == sorted(times)
    edge_us = desk.ring.ring_us(desk.clock.now_us() - 1 * S)
    assert [message.data for message in desk.ring.read(edge_us, edge_us)] == [
        body(6),
        body(7),
        body(8),
    ]
    desk.ring.close()


# --- bounds ------------------------------------------------------------------------------------------


def test_the_oldest_segments_give_way_to_the_bound_in_bytes(tmp_path: Path) -> None:
    desk = Desk(tmp_path, max_mb=16.0, compression="none")
    for i in range(40):
        desk.imu(i, 1, 1_000_000)
        desk.pass_s(0.4)
        assert sum(path.stat().st_size for path in tmp_path.glob("*.mcap")) <= 16e6
    desk.ring.flush(0)
    kept = desk.read()
    assert kept == [body(i, 1_000_000) for i in range(40 - len(kept), 40)]
    assert len(kept) > 4
    assert desk.ring.evicted_why == "max_mb"
    assert T0 < desk.ring.since_us() <= desk.ring.now_us()
    desk.ring.close()


def test_the_oldest_segments_give_way_to_age(tmp_path: Path) -> None:
    desk = Desk(tmp_path, max_age_s=30.0)
    for i in range(60):
        desk.imu(i, 1)
        desk.pass_s(1)
    assert 28 <= len(desk.read()) <= 45
    assert desk.ring.evicted_why == "max_age_s"
    desk.ring.close()


class Disk:
    """A disk's numbers, as `os.statvfs` has them."""

    f_frsize = 1

    def __init__(self, size: int, free: int) -> None:
        self.f_blocks, self.f_bavail = size, free


def test_the_ring_gives_way_first_when_the_disk_is_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = Disk(10**12, 10**12)
    monkeypatch.setattr(os, "statvfs", lambda _: disk)
    desk = Desk(tmp_path, keep_free_mb=100.0, max_age_s=3600.0)
    for i in range(30):
        desk.imu(i, 1)
        desk.pass_s(1)
    assert len(desk.read()) == 30
    disk.f_bavail = 99_000_000
    desk.pass_s(1)
    assert desk.read() == []
    assert "the disk is full" in (desk.ring.alarm or "")
    desk.imu(30, 5)
    desk.pass_s(1)
    assert desk.read() == []
    assert list(tmp_path.glob("*.mcap")) == []
    assert desk.ring.counts()["imu"].dropped == {DISK: 5}
    assert desk.ring.since_us() >= T0 + 29 * S, "what was before is gone"
    disk.f_bavail = 10**12
    desk.pass_s(1)
    desk.imu(35, 1)
    desk.pass_s(1)
    assert (desk.read(), desk.ring.alarm) == ([body(35)], None)
    assert desk.ring.evicted_why == "disk full"
    (drop,) = desk.ring.drops(0, 2**62)
    assert (drop.topic, drop.messages, drop.why) == ("/imu", 5, DISK)
    assert len(desk.passed) == 36
    desk.ring.close()


def test_a_share_of_the_disk_bounds_the_ring(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "statvfs", lambda _: Disk(100_000_000, 90_000_000))
    desk = Desk(tmp_path, max_disk_share=0.2, compression="none")
    for i in range(30):
        desk.imu(i, 1, 1_000_000)
        desk.pass_s(0.4)
    assert sum(path.stat().st_size for path in tmp_path.glob("*.mcap")) <= 20e6
    assert desk.ring.evicted_why == "max_disk_share"
    desk.ring.close()


def test_a_chunk_that_the_disk_refuses_is_written_once_the_oldest_have_given_way(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk = Desk(tmp_path, max_age_s=3600.0)
    for i in range(25):
        desk.imu(i, 1)
        desk.pass_s(1)
    desk.imu(25, 4)
    write = os.write
    failing = iter([True, True])

    def full(fd: int, data: Any) -> int:
        if next(failing, False):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(fd, data)

    monkeypatch.setattr(os, "write", full)
    desk.pass_s(1)
    assert desk.read()[-5:] == [body(i) for i in range(24, 29)]
    assert (desk.ring.alarm, desk.ring.evicted_why) == (None, "disk full")
    assert desk.ring.counts()["imu"].dropped == {}
    assert body(0) not in desk.read()
    desk.ring.close()


def test_a_disk_that_fails_is_an_alarm_and_costs_no_segment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk = Desk(tmp_path)
    for i in range(25):
        desk.imu(i, 1)
        desk.pass_s(1)

    def fails(*_: object) -> int:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", fails)
        desk.imu(25, 5)
        desk.pass_s(1)
        assert "cannot write" in (desk.ring.alarm or "")
    assert desk.read() == [body(i) for i in range(25)]
    desk.pass_s(1)
    desk.imu(30, 1)
    desk.pass_s(1)
    assert desk.read()[-1] == body(30)
    assert (desk.ring.alarm, desk.ring.counts()["imu"].dropped) == (None, {DISK: 5})
    assert [message.seq for message in desk.ring.read(0, 2**62)][-2:] == [24, 30], "the gap tells the loss"
    desk.ring.close()


def test_what_does_not_fit_into_memory_is_dropped_and_counted(tmp_path: Path) -> None:
    desk = Desk(tmp_path, memory_mb=1.0)
    desk.imu(0, 50, 100_000)
    counts = desk.ring.counts()["imu"]
    assert counts.taken == 50
    dropped = counts.dropped[MEMORY]
    assert 40 <= dropped < 50
    desk.pass_s(1)
    desk.imu(50, 1)
    desk.pass_s(1)
    assert len(desk.read()) == 51 - dropped
    assert desk.ring.counts()["imu"].written == 51 - dropped
    (drop,) = desk.ring.drops(0, 2**62)
    assert (drop.stream, drop.topic, drop.messages, drop.why) == ("imu", "/imu", dropped, MEMORY)
    assert desk.ring.drops(0, T0 - 1) == []
    desk.ring.close()
    desk.again()
    assert drop in desk.ring.drops(0, 2**62), "also of a run before"
    desk.ring.close()


def test_a_power_cut_leaves_every_closed_chunk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    safe: dict[int, int] = {}

    def sync(fd: int) -> None:
        status = os.fstat(fd)
        safe[status.st_ino] = status.st_size

    monkeypatch.setattr(os, "fdatasync", sync)
    desk = Desk(tmp_path)
    for i in range(60):
        desk.imu(i, 1)
        desk.pass_s(1)
        for path in tmp_path.glob("*.mcap"):
            assert safe.get(path.stat().st_ino, 0) == path.stat().st_size
    desk.ring.close()


def test_the_medium_may_be_synced_every_few_seconds_and_not_for_each_chunk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    syncs = []
    fdatasync = os.fdatasync
    monkeypatch.setattr(os, "fdatasync", lambda fd: (syncs.append(fd), fdatasync(fd)))
    desk = Desk(tmp_path, sync_s=5.0)
    for i in range(60):
        desk.imu(i, 1)
        desk.pass_s(1)
    assert 12 <= len(syncs) <= 12 + 7, "one in 5 s, and one for the end of each segment"
    before = len(syncs)
    desk.pass_s(30)
    assert len(syncs) <= before + 2, "none while nothing comes"
    desk.ring.close()


# --- life --------------------------------------------------------------------------------------------


def test_nothing_that_comes_makes_around_raise(desk: Desk) -> None:
    class Odd:
        def __len__(self) -> int:
            raise ValueError

    assert desk.emit("vesc", 1, Odd()) == 7.0
    assert desk.emit("vesc", -5, {"x": object()}) == 7.0
    assert desk.emit("vesc", 2**70, {"x": 2**70}) == 7.0
    desk.pass_s(1)
    assert len(desk.read()) == 2
    assert desk.ring.report()["take"] == 1


def test_an_unforeseen_error_costs_a_chunk_and_the_thread_goes_on(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk.imu(0, 5)
    with monkeypatch.context() as patch:
        patch.setattr(SegmentFile, "add", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            desk.ring._work_until_end()
    desk.imu(5, 5)
    desk.pass_s(1)
    assert desk.read() == [body(i) for i in range(5, 10)]
    counts = desk.ring.counts()["imu"]
    assert (counts.taken, counts.written) == (10, 5)


def test_one_process_has_the_folder(desk: Desk) -> None:
    with pytest.raises(AgentError, match="in use by another process"):
        Ring(RecorderConfig(), desk.clock, folder=desk.folder, run="b", reserve=0)


def test_without_the_package_the_error_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "mcap.writer", None)
    with pytest.raises(AgentError, match=r"pip install 'iort-agent\[recorder\]'"):
        Desk(tmp_path)


WRITES = """
import sys, threading, time
from pathlib import Path
from iort_agent.common.threads import SystemClock
from iort_agent.recorder.config import RecorderConfig
from iort_agent.recorder.ring import Ring
from iort_contract.ros.message import RosMessage, RosType
kind = RosType("/imu", "a_msgs/Imu", "1" * 32, "uint8[] data")
ring = Ring(RecorderConfig(keep_free_mb=0.0), SystemClock(), folder=Path(sys.argv[1]), run="a", reserve=0)
ring.start()
emit = ring.around(lambda *_, more=False: 0.0)
for i in range(10**9):
    emit("imu", i, RosMessage(i.to_bytes(8, "little"), kind))
    if i % 100 == 0:
        print(i, flush=True)
        time.sleep(0.02)
"""


def test_a_real_kill_leaves_a_ring_that_goes_on(tmp_path: Path) -> None:
    folder = tmp_path / "ring"
    with subprocess.Popen(
        [sys.executable, "-c", WRITES, str(folder)], stdout=subprocess.PIPE, text=True
    ) as writes:
        assert writes.stdout is not None
        next(line for line in writes.stdout if int(line) >= 10_000)
        writes.send_signal(signal.SIGKILL)
        heard = int((writes.stdout.read().splitlines() or ["10000"])[-1])
    desk = Desk(folder, run="b")
    kept = [int.from_bytes(data, "little") for data in desk.read()]
    assert kept == list(range(len(kept)))
    assert 0 < len(kept) <= heard + 101
    desk.ring.close()


def test_the_thread_writes_and_a_reader_may_wait_for_it(tmp_path: Path) -> None:
    from iort_agent.common.threads import SystemClock

    ring = Ring(RecorderConfig(**KEPT_FREE), SystemClock(), folder=tmp_path, run="a", reserve=0)
    ring.start()
    emit = ring.around(lambda *_, more=False: 0.0)
    threads = [
        threading.Thread(target=lambda: [emit("imu", i, RosMessage(body(i), IMU)) for i in range(500)])
        for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert ring.flush(GUARD_S)
    messages = list(ring.read(0, 2**62))
    assert sorted(message.seq for message in messages) == list(range(2000))
    assert sum(segment.closed for segment in ring.segments(0, 2**62)) == 0
    ring.close()
    assert ring.counts()["imu"].written == 2000
