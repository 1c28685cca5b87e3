"""Latched messages: what was in force at a window's begin is in its file, however long ago it came."""

from __future__ import annotations

import errno
import json
import os
import threading
from pathlib import Path
from typing import Any, Mapping, NamedTuple

import pytest
import yaml
from mcap.reader import make_reader

from iort_agent.recorder.account import Losses
from iort_agent.recorder.cut import PART, Cut, cut
from iort_agent.recorder.latched import FOLDER
from iort_agent.recorder.plan import Edge, Incident, Plan
from iort_agent.recorder.triggers import Triggers
from iort_agent.sources.intake import Intake, TopicConfig
from iort_contract.catalog.streams import TYPES_STREAM
from iort_contract.ros.message import RosMessage, RosType
from testkit.agent import ManualClock
from tests.unit.agent.recorder.test_ring import DEFINITION, IMU, T0, Desk, Disk, S, body

MAP = RosType("/map", "a_msgs/Map", "2" * 32, DEFINITION)
STATIC = RosType("/tf_static", "a_msgs/msg/Tf", "RIHS01_2", DEFINITION)


def latch(desk: Desk, n: int, publisher: str = "/a", kind: RosType = MAP, size: int = 8) -> bytes:
    """A latched message comes, and a second passes."""
    data = body(n, size)
    desk.emit(kind.topic.strip("/"), desk.clock.now_us(), RosMessage(data, kind, latched_by=publisher))
    desk.pass_s(1)
    return data


class File(NamedTuple):
    made: Cut
    # Topic -> log time, publish time and bytes, in the file's order.
    messages: dict[str, list[tuple[int, int, bytes]]]
    about: Mapping[str, str]
    account: Mapping[str, Any]
    channels: Mapping[str, Mapping[str, str]]


def cut_of(desk: Desk, from_us: int, to_us: int, *topics: str) -> File:
    """Cut a window, and read the file as others do."""
    incident = Incident("a" * 16, from_us, to_us, from_us, to_us, [Edge("hit", to_us)], list(topics))
    path = desk.folder.with_suffix(".mcap")
    desk.ring.flush(0)
    desk.ring.work()
    made = cut(
        desk.ring,
        incident,
        path,
        compression="lz4",
        limit=None,
        losses=Losses((), 0),
        pause=lambda: None,
        has_room=lambda: None,
    )
    messages: dict[str, list[tuple[int, int, bytes]]] = {}
    with path.with_name(path.name + PART).open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        for _, channel, message in reader.iter_messages():
            times = message.log_time // 1000, message.publish_time // 1000
            messages.setdefault(channel.topic, []).append((*times, message.data))
        summary = reader.get_summary()
        assert summary is not None
        channels = {channel.topic: channel.metadata for channel in summary.channels.values()}
        about = {record.name: record.metadata for record in reader.iter_metadata()}
    account = {topic: json.loads(text) for topic, text in about["iort.account"].items()}
    return File(made, messages, about["iort.incident"], account, channels)


def test_what_is_in_force_comes_first_though_the_ring_has_it_no_more(tmp_path: Path) -> None:
    desk = Desk(tmp_path / "ring", max_age_s=30.0)
    latch(desk, 1)
    newest = latch(desk, 2)
    other = latch(desk, 3, "/b")
    for i in range(60):
        desk.imu(100 + i, 1)
        desk.pass_s(1)
    assert newest not in desk.read(), "it is evicted"
    now_us = desk.ring.now_us()
    file = cut_of(desk, now_us - 5 * S, now_us)
    begin_us = now_us - 5 * S
    assert file.messages["/map"] == [(begin_us, T0 + S, newest), (begin_us, T0 + 2 * S, other)]
    assert file.account["/map"] == {"stream": "map", "messages": 0, "missing": 0, "latched": 2}
    assert json.loads(file.about["latched"]) == {"/map": [["/a", T0 + S], ["/b", T0 + 2 * S]]}
    assert file.made.messages == len(file.messages["/imu"]), "they are none of the window"
    assert file.made.missing == 0
    desk.ring.close()


@pytest.mark.parametrize("late_us", [0, 30_000])
def test_what_the_ring_begins_with_is_there_once(tmp_path: Path, late_us: int) -> None:
    """It is the first message, or was fetched a little after the first one; its own stamp is old."""
    desk = Desk(tmp_path / "ring")
    desk.pass_s(5)
    if late_us:
        desk.imu(0, 1)
    message = RosMessage(body(1), MAP, latched_by="/a", arrival_us=desk.clock.now_us() - late_us)
    desk.emit("map", T0 - 3600 * S, message)
    desk.pass_s(2)
    for i in range(15):
        desk.imu(i, 1)
        desk.pass_s(1)
    file = cut_of(desk, T0, desk.ring.now_us())
    assert [data for _, _, data in file.messages["/map"]] == [body(1)]
    assert file.account["/map"] == {"stream": "map", "messages": 1, "missing": 0}
    desk.ring.close()


def test_a_window_of_the_past_has_what_was_in_force_then(tmp_path: Path) -> None:
    desk = Desk(tmp_path / "ring")
    old = latch(desk, 1)
    begin_us = desk.ring.now_us()
    desk.imu(0, 1)
    desk.pass_s(5)
    new = latch(desk, 2)
    newest = latch(desk, 3)
    file = cut_of(desk, begin_us, desk.ring.now_us() - S)
    # The new one is of the window, and counted there.
    assert file.messages["/map"] == [
        (begin_us, T0, old),
        (begin_us + 5 * S, begin_us + 5 * S, new),
        (begin_us + 6 * S, begin_us + 6 * S, newest),
    ]
    assert file.account["/map"] == {"stream": "map", "messages": 2, "missing": 0, "latched": 1}
    desk.ring.close()


def test_what_was_evicted_of_the_window_itself_is_in_force_at_the_ring_s_begin(tmp_path: Path) -> None:
    desk = Desk(tmp_path / "ring", max_age_s=30.0)
    begin_us = desk.ring.now_us()
    desk.pass_s(2)
    data = latch(desk, 1)
    for i in range(60):
        desk.imu(i, 1)
        desk.pass_s(1)
    assert desk.ring.since_us() > begin_us + 10 * S
    file = cut_of(desk, begin_us, desk.ring.now_us())
    assert file.messages["/map"] == [(begin_us + 2 * S, begin_us + 2 * S, data)]
    desk.ring.close()


def test_ros_2_does_not_tell_the_publishers_so_the_newest_few_are_kept(tmp_path: Path) -> None:
    desk = Desk(tmp_path / "ring")
    for n in (1, 2, 3, 1):
        latch(desk, n, "", STATIC)
    begin_us = desk.ring.now_us()
    desk.imu(0, 1)
    desk.pass_s(1)
    file = cut_of(desk, begin_us, desk.ring.now_us())
    assert [data for _, _, data in file.messages["/tf_static"]] == [body(2), body(3), body(1)]
    for n in range(40):
        latch(desk, n, "", STATIC)
    big = latch(desk, 99, "", STATIC, 2_000_000)
    file = cut_of(desk, desk.ring.now_us(), desk.ring.now_us() + S)
    assert [data for _, _, data in file.messages["/tf_static"]] == [big], "the newest, however large"
    desk.ring.close()


def test_players_of_ros_2_offer_what_late_subscribers_ask_for(tmp_path: Path) -> None:
    desk = Desk(tmp_path / "ring")
    latch(desk, 1, "", STATIC)
    begin_us = desk.ring.now_us()
    # In the window there is one, too: the same topic is one channel.
    latch(desk, 2, "", STATIC)
    file = cut_of(desk, begin_us, desk.ring.now_us())
    assert len(file.messages["/tf_static"]) == 2
    assert len(file.channels) == 1
    # `ros2 bag` reads it as YAML; 1 is RMW_QOS_POLICY_DURABILITY_TRANSIENT_LOCAL.
    (offered,) = yaml.safe_load(file.channels["/tf_static"]["offered_qos_profiles"])
    assert offered["durability"] == 1
    desk.ring.close()


def test_only_the_topics_of_the_trigger_are_there(tmp_path: Path) -> None:
    desk = Desk(tmp_path / "ring")
    latch(desk, 1)
    latch(desk, 2, "", STATIC)
    begin_us = desk.ring.now_us()
    desk.imu(0, 1)
    desk.pass_s(1)
    assert set(cut_of(desk, begin_us, desk.ring.now_us(), "/imu", "/tf*").messages) == {"/imu", "/tf_static"}
    assert set(cut_of(desk, begin_us, desk.ring.now_us(), "/imu").messages) == {"/imu"}
    desk.ring.close()


def test_it_outlives_the_process_and_comes_again_without_being_new(tmp_path: Path) -> None:
    desk = Desk(tmp_path / "ring")
    old = latch(desk, 1)
    desk.pass_s(2)
    desk.kill()
    again = Desk(tmp_path / "ring", desk.clock, run="b")
    repeat(again, 1)
    # This one was published while nobody listened, and heard by another run, without a recorder.
    repeat(again, 2, "/b")
    begin_us = again.ring.now_us()
    again.imu(0, 1)
    again.pass_s(1)
    file = cut_of(again, begin_us, again.ring.now_us())
    assert [(own_us, data) for _, own_us, data in file.messages["/map"]] == [(5, body(2)), (T0, old)]
    assert json.loads(file.about["latched"])["/map"] == [["/b", 0], ["/a", T0]]
    assert again.ring.counts()["map"].taken == 0, "it is no message of this run"
    assert [stream for stream, _, _ in again.passed] == ["imu"], "and nobody else takes it"
    again.ring.close()


def test_a_publisher_of_ros_2_that_has_another_name_in_the_next_run_is_the_same(tmp_path: Path) -> None:
    """Its messages are found before its node is."""
    desk = Desk(tmp_path / "ring")
    old = latch(desk, 1, "/a", STATIC)
    desk.pass_s(2)
    desk.kill()
    again = Desk(tmp_path / "ring", desk.clock, run="b")
    for _ in range(2):
        repeat(again, 1, "_NODE_NAMESPACE_UNKNOWN_/_NODE_NAME_UNKNOWN_", STATIC)
    begin_us = again.ring.now_us()
    again.imu(0, 1)
    again.pass_s(1)
    file = cut_of(again, begin_us, again.ring.now_us())
    assert [(own_us, data) for _, own_us, data in file.messages["/tf_static"]] == [(T0, old)]
    again.ring.close()


def repeat(desk: Desk, n: int, publisher: str = "/a", kind: RosType = MAP) -> None:
    """A message that came before comes again, by an intake that remembers it."""

    def emit(stream: str, t_us: int, values: Mapping[str, Any], *, more: bool = False) -> float:
        del t_us
        return desk.emit(stream, 5, values, more=more)

    intake = Intake(
        kind.topic,
        TopicConfig(time="arrival", stream=kind.topic.strip("/")),
        emit=emit,
        clock=desk.clock,
        whole=True,
    )
    header = {"type": kind.name, "md5sum": kind.md5sum, "message_definition": DEFINITION}
    header.update(latching="1", callerid=publisher)
    ros2 = "/msg/" in kind.name
    intake._latched.came_before("5" if ros2 else publisher, body(n))
    intake.take(header, body(n), source_ns=5 if ros2 else 0)
    desk.passed = [one for one in desk.passed if one[0] != TYPES_STREAM]


def test_without_a_recorder_what_came_before_is_left_out() -> None:
    heard: list[str] = []

    def emit(stream: str, t_us: int, values: Mapping[str, Any], *, more: bool = False) -> float:
        del t_us, values, more
        heard.append(stream)
        return 0.0

    intake = Intake(
        "/map", TopicConfig(time="arrival", stream="map"), emit=emit, clock=ManualClock(now_us=T0)
    )
    header = {"type": MAP.name, "md5sum": MAP.md5sum, "message_definition": DEFINITION, "latching": "1"}
    for connection in (dict(header), dict(header)):
        intake.take(connection, body(1))
    assert heard == [TYPES_STREAM, "map"]
    assert intake.report()["latched_again"] == 1


def test_a_repetition_is_no_sample_for_a_trigger(tmp_path: Path) -> None:
    desk = Desk(tmp_path / "ring")
    triggers = Triggers(Plan(tmp_path), desk.ring.now_us, lambda *_: None)
    triggers.desire({"low": {"when": "x >= 0", "stream": "map"}})
    ring_emit = desk.emit
    desk.emit = triggers.around(ring_emit)
    repeat(desk, 0)
    triggers.step()
    assert triggers.report()["cost_us"] == {}, "no sample"
    latch(desk, 0)
    triggers.step()
    assert {*triggers.report()["cost_us"]} == {"low"}
    desk.ring.close()


def test_a_busy_topic_takes_a_bounded_part_of_the_ring(tmp_path: Path) -> None:
    desk = Desk(tmp_path / "ring", max_mb=16.0, compression="none")
    static = latch(desk, 1, "", STATIC)
    for n in range(100):
        latch(desk, n, size=300_000)
    files = [*(tmp_path / "ring" / FOLDER).iterdir()]
    assert len(files) <= 65
    assert sum(path.stat().st_size for path in files) <= 2_000_000
    assert sum(path.stat().st_size for path in (tmp_path / "ring").rglob("*.mcap")) <= 16e6
    # What is in force goes last, and what can never fit is told.
    newest = {data for _, message in desk.ring.latched(2**62).messages for data in [message.data]}
    assert newest == {static, body(99, 300_000)}
    latch(desk, 1000, size=1_500_000)
    assert desk.ring.report()["latched_dropped"] == 1
    desk.ring.close()


def test_a_full_disk_takes_their_files_last_and_they_come_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = Disk(10**12, 10**12)
    monkeypatch.setattr(os, "statvfs", lambda _: disk)
    desk = Desk(tmp_path / "ring", keep_free_mb=100.0)
    latch(desk, 1)
    new = latch(desk, 2)
    folder = tmp_path / "ring" / FOLDER
    assert len([*folder.iterdir()]) == 2
    disk.f_bavail = 99_000_000
    desk.pass_s(1)
    assert [message.data for _, message in desk.ring.latched(2**62).messages] == [new], "the past goes first"
    desk.pass_s(3)
    assert [*folder.iterdir()] == [], "the queue needs the room"
    static = latch(desk, 3, "", STATIC)
    disk.f_bavail = 10**12
    desk.pass_s(3)
    assert [message.data for _, message in desk.ring.latched(2**62).messages] == [new, static]
    desk.ring.close()


def full(*_: object) -> int:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_write_that_fails_is_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    desk = Desk(tmp_path / "ring")

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", full)
        data = latch(desk, 1)
        desk.pass_s(3)
        assert desk.ring.latched(2**62).messages == []
    desk.pass_s(3)
    assert [message.data for _, message in desk.ring.latched(2**62).messages] == [data]
    desk.ring.close()


def test_a_disk_that_is_full_has_no_files_that_nobody_knows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk = Desk(tmp_path / "ring")

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", full)
        for n in range(5):
            latch(desk, n)
        assert [*(tmp_path / "ring").rglob("*.mcap")] == []
    desk.ring.close()


def test_each_of_many_publishers_of_ros_1_keeps_its_own_though_all_come_at_once(tmp_path: Path) -> None:
    desk = Desk(tmp_path / "ring")
    sent = [body(n, 800_000 if n < 3 else 8) for n in range(40)]
    for n, data in enumerate(sent):
        desk.emit("map", desk.clock.now_us(), RosMessage(data, MAP, latched_by=f"/static{n}"))
    desk.pass_s(3)
    assert [message.data for _, message in desk.ring.latched(2**62).messages] == sent
    desk.ring.close()


@pytest.mark.parametrize("kind", [MAP, STATIC])
def test_one_that_is_too_large_ends_the_one_before(tmp_path: Path, kind: RosType) -> None:
    desk = Desk(tmp_path / "ring", max_mb=16.0, compression="none")
    old = latch(desk, 1, kind=kind)
    then_us = desk.ring.now_us()
    desk.pass_s(3)
    latch(desk, 2, size=1_500_000, kind=kind)
    desk.pass_s(3)
    desk.kill()
    again = Desk(tmp_path / "ring", desk.clock, run="b", max_mb=16.0)
    for ring in (desk.ring, again.ring):
        assert ring.latched(2**62).messages == [], "what is told is not what held before"
        assert [message.data for _, message in ring.latched(then_us).messages] == [old]
    again.ring.close()


def test_one_that_the_memory_has_no_room_for_ends_the_one_before(tmp_path: Path) -> None:
    desk = Desk(tmp_path / "ring", memory_mb=1.0)
    latch(desk, 1)
    other = latch(desk, 1, "/b")
    desk.imu(0, 40, 32_000)
    latch(desk, 2, size=32_000)
    desk.pass_s(3)
    assert desk.ring.counts()["map"].dropped == {"memory": 1}
    assert [message.data for _, message in desk.ring.latched(2**62).messages] == [other]
    newest = latch(desk, 3)
    desk.pass_s(3)
    assert [message.data for _, message in desk.ring.latched(2**62).messages] == [other, newest]
    desk.ring.close()


def test_a_folder_that_is_gone_is_told_once_and_takes_little_memory(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    desk = Desk(tmp_path / "ring", memory_mb=1000.0)
    folder = tmp_path / "ring" / FOLDER
    folder.rmdir()
    # A node that begins again and again has another name each time.
    sent = [latch(desk, n, f"/map_{n}", size=1_600_000) for n in range(15)]
    assert [record.getMessage() for record in caplog.records if record.levelname == "WARNING"] == [
        f"latched messages: {folder}: No such file or directory"
    ]
    assert desk.ring.report()["latched_dropped"] == 6
    folder.mkdir()
    desk.pass_s(3)
    assert [message.data for _, message in desk.ring.latched(2**62).messages] == sent[6:]
    desk.ring.close()


def test_the_ring_s_time_goes_on_behind_the_newest_though_the_clock_was_set_back(tmp_path: Path) -> None:
    desk = Desk(tmp_path / "ring", max_age_s=20.0)
    data = latch(desk, 1)
    desk.pass_s(60)
    desk.ring.close()
    for path in (tmp_path / "ring").glob("*.mcap"):
        path.unlink()
    again = Desk(tmp_path / "ring", ManualClock(now_us=T0 - 3600 * S), run="b")
    latch(again, 1)
    found = again.ring.latched(again.ring.now_us()).messages
    assert [message.data for _, message in found] == [data]
    again.ring.close()


def test_few_files_are_open_until_they_are_synced(tmp_path: Path) -> None:
    desk = Desk(tmp_path / "ring", sync_s=60.0)
    descriptors = Path("/proc/self/fd")
    before = len([*descriptors.iterdir()])
    for n in range(20):
        for topic in range(10):
            kind = RosType(f"/map{topic}", MAP.name, MAP.md5sum, DEFINITION)
            desk.emit(f"map{topic}", desk.clock.now_us(), RosMessage(body(n), kind, latched_by="/a"))
        desk.pass_s(1)
    assert len([*descriptors.iterdir()]) - before < 60
    desk.ring.close()


def test_what_a_power_cut_tore_costs_itself_alone(tmp_path: Path) -> None:
    desk = Desk(tmp_path / "ring")
    latch(desk, 1)
    other = latch(desk, 2, "", STATIC)
    desk.kill()
    first, _ = sorted((tmp_path / "ring" / FOLDER).iterdir())
    first.write_bytes(first.read_bytes()[:40])
    (first.parent / "mine.mcap").write_bytes(b"no mcap")
    again = Desk(tmp_path / "ring", desk.clock, run="b")
    assert [message.data for _, message in again.ring.latched(2**62).messages] == [other]
    again.ring.close()


def test_a_reader_may_look_while_files_are_deleted(tmp_path: Path) -> None:
    desk = Desk(tmp_path / "ring", max_age_s=10.0)
    latch(desk, 0)
    stop, errors = threading.Event(), []

    def look() -> None:
        while not stop.is_set():
            try:
                desk.ring.latched(2**62)
            except Exception as error:  # noqa: BLE001, PERF203 - whatever it is, the test tells it
                errors.append(error)
                return

    thread = threading.Thread(target=look)
    thread.start()
    for n in range(40):
        latch(desk, n)
    stop.set()
    thread.join()
    assert errors == []
    desk.ring.close()


def test_the_ring_of_imus_latches_nothing(tmp_path: Path) -> None:
    desk = Desk(tmp_path / "ring")
    desk.emit("imu", 1, RosMessage(body(1), IMU))
    desk.pass_s(2)
    assert [*(tmp_path / "ring" / FOLDER).iterdir()] == []
    desk.ring.close()
