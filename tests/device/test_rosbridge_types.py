"""The rosbridge source with a server that describes its message types, and with one that does not."""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Iterator

import pytest

pytest.importorskip("aiohttp")
pytest.importorskip("websocket")

from iort_contract.ros1.message import message_type
from testkit.waiting import until
from tests.device.running import Running
from tests.device.test_rosbridge import CORE, VESC, config, state
from tests.rosbridge_standin import RosbridgeStandin


@pytest.fixture
def server() -> Iterator[RosbridgeStandin]:
    with RosbridgeStandin() as standin:
        yield standin


RULE = "=" * 80
HEADER = f"{RULE}\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
VESC_TEXT = (
    f"Header header\nVescState state\n{HEADER}"
    f"{RULE}\nMSG: vesc_msgs/VescState\nint32 FAULT_CODE_NONE=0  # fine\nfloat64 speed\nint32 fault_code\n"
)
SCAN_TEXT = f"Header header\nfloat32[] ranges\nuint8[] raw\ntime[] when\n{HEADER}"
SERVED = {
    "advertised": {CORE: VESC, "/scan": "a_msgs/Scan"},
    "definitions": {VESC: VESC_TEXT, "a_msgs/Scan": SCAN_TEXT},
}


@pytest.mark.parametrize("old", [False, True])
def test_a_message_of_a_known_type_is_decoded_like_ros_1(*, old: bool) -> None:
    sec = int(time.time()) - 60
    with RosbridgeStandin(**SERVED, old=old) as server:
        with Running(config(server, time="header")) as running:
            server.wait_for("subscribe")
            for seq in range(3):
                message = state(seq + 0.5, secs=sec, nsecs=123_456_789)
                message["header"]["seq"] = seq
                server.publish(CORE, message)
            running.wait_for(3)
        assert len(running.source._hearings[CORE]._writer.write(message)) == 4 + 8 + 4 + 9 + 8 + 4
    assert [values for _, _, values in running.samples] == [
        {"speed": seq + 0.5, "fault_code": 0} for seq in range(3)
    ]
    assert {t_us for _, t_us, _ in running.samples} == {sec * 1_000_000 + 123_456}
    kind = message_type(running.said[0])
    assert (kind.topic, kind.kind) == (CORE, VESC)
    if not old:
        # genmsg of ROS computes it in this way.
        assert (kind.md5sum, kind.definition) == ("da885266203a97b33d0ad1d0fa9d1d9e", VESC_TEXT)
    assert running.source.report()[CORE] == {"messages": 3}


def test_the_message_keeps_structure_that_the_plain_sample_loses() -> None:
    with RosbridgeStandin(**SERVED) as server, Running(config(server, "/scan")) as running:
        server.wait_for("subscribe")
        header = {"seq": 1, "stamp": {"secs": 1, "nsecs": 2}, "frame_id": "laser"}
        raw = (
            struct.pack("<IIII", 1, 1, 2, 5)
            + b"laser"
            + struct.pack("<IffI2sI", 2, 1.5, math.nan, 2, b"\1\2", 0)
        )
        server.publish("/scan", {"header": header, "ranges": [1.5, None], "raw": "AQI=", "when": []})
        running.wait_for(1)
        hearing = running.source._hearings["/scan"]
        assert running.samples[0][2].keys() == {"ranges.0", "ranges.1"}
        assert running.samples[0][2]["ranges.1"] != running.samples[0][2]["ranges.1"]
        # The message has values that are not columns, too.
        assert running.samples[0][2].raw == raw
        assert hearing.report() == {"messages": 1, "not_a_number": 1}


def test_the_plain_sample_is_sent_and_counted_without_rosapi(server: RosbridgeStandin) -> None:
    with Running(config(server)) as running:
        server.wait_for("subscribe")
        server.publish(CORE, state(1))
        running.wait_for(1)
    assert running.source.report()[CORE] == {"messages": 1, "structure_not_kept": 1}


def test_a_silent_rosapi_loses_no_message() -> None:
    with RosbridgeStandin(**SERVED) as server:
        server.silent_rosapi = True
        with Running(config(server)) as running:
            server.wait_for("subscribe")
            for n in range(2_003):
                server.publish(CORE, state(n))
            running.wait_for(2_003)
    assert [values["speed"] for _, _, values in running.samples] == list(range(2_003)), "in order"
    assert running.source.report()[CORE]["structure_not_kept"] == 2_003


def test_held_messages_are_sent_when_the_agent_ends() -> None:
    with RosbridgeStandin(**SERVED) as server:
        server.silent_rosapi = True
        with Running(config(server)) as running:
            server.wait_for("subscribe")
            server.publish(CORE, state(5))
            until(lambda: running.source.report()[CORE]["messages"] == 1)
    assert [values["speed"] for _, _, values in running.samples] == [5]


def test_types_are_requested_again_after_a_reconnect() -> None:
    with RosbridgeStandin(**SERVED) as server, Running(config(server)) as running:
        server.wait_for("subscribe")
        server.publish(CORE, {**state(1, secs=1, nsecs=2)})
        running.wait_for(1)
        server.__exit__()
        assert server.definitions is not None
        server.definitions[VESC] = VESC_TEXT + "float32 added\n"
        server.__enter__()
        server.wait_for("subscribe", 2)
        message = state(2, secs=1, nsecs=2)
        message["state"]["added"] = 0.25
        server.publish(CORE, message)
        running.wait_for(2)
    assert running.samples[1][2] == {"speed": 2, "fault_code": 0, "added": 0.25}
    assert running.source.report()[CORE].keys() == {"messages", "interruptions", "dark_s"}
