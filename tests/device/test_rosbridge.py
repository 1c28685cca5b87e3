"""The rosbridge source against a server on loopback that describes its types, restarts, falls silent and
sends invalid messages.
"""

from __future__ import annotations

import json
import logging
import math
import struct
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from tests.unit.contract.ros.ros_values import HEADER, RULE

pytest.importorskip("aiohttp")
pytest.importorskip("websocket")

from iort_agent.common.threads import Clock, SystemClock
from iort_agent.config import load_config
from iort_agent.errors import ConfigError, SourceError
from iort_agent.sources.rosbridge import RosbridgeConfig, RosbridgeSource, TopicConfig
from iort_agent.sources.rosbridge.connection import Times
from iort_contract.ros.message import message_type
from testkit.ports import free_port
from testkit.waiting import until
from tests.device.running import Running
from tests.rosbridge_standin import RosbridgeStandin
from tests.unit.agent.test_agent import config_file

CORE = "/sensors/core"
VESC = "vesc_msgs/VescStateStamped"
VESC_TEXT = (
    f"Header header\nVescState state\n{HEADER}"
    f"{RULE}\nMSG: vesc_msgs/VescState\nint32 FAULT_CODE_NONE=0  # fine\nfloat64 speed\nint32 fault_code\n"
)
SERVED: dict[str, Any] = {
    "advertised": {
        CORE: VESC, "/scan": "a_msgs/Scan", "/slow": "a_msgs/Numbered", "/stamped": "a_msgs/Numbered",
        "/map": "a_msgs/Numbered", "/fast": "a_msgs/Plain", "/plain": "a_msgs/Plain",
    },
    "definitions": {
        VESC: VESC_TEXT,
        "a_msgs/Scan": f"Header header\nfloat32[] ranges\nuint8[] raw\ntime[] when\n{HEADER}",
        "a_msgs/Numbered": f"Header header\nint64 n\n{HEADER}",
        "a_msgs/Plain": "float64 n",
    },
}  # fmt: skip


@pytest.fixture
def server() -> Iterator[RosbridgeStandin]:
    with RosbridgeStandin(**SERVED) as standin:
        yield standin


@pytest.fixture
def log(caplog: pytest.LogCaptureFixture) -> pytest.LogCaptureFixture:
    caplog.set_level(logging.INFO, "iort_agent")
    return caplog


SOON = Times(backoff_s=(0.05, 0.2), look_s=0.1, ask_again_s=60.0)


class FastConfig(NamedTuple):
    """A configuration whose source reconnects without long waits."""

    config: RosbridgeConfig
    times: Times = SOON

    def build(self, clock: Clock) -> RosbridgeSource:
        return RosbridgeSource(self.config, clock, self.times)


def config(server: RosbridgeStandin, *topics: str, times: Times = SOON, **settings: Any) -> FastConfig:
    topic = TopicConfig(**{"stream": "vesc", "time": "arrival", **settings})
    return FastConfig(
        RosbridgeConfig(url=server.url, topics=tuple((name, topic) for name in topics or (CORE,))), times
    )


def state(n: float = 0, *, sec: int = 1, seq: int = 0) -> dict[str, Any]:
    """Return a VescStateStamped as rosbridge sends it."""
    header = {"seq": seq, "stamp": {"secs": sec, "nsecs": 123_456_789}, "frame_id": "base_link"}
    return {"header": header, "state": {"speed": n, "fault_code": 0}}


@pytest.mark.parametrize("old", [False, True])
def test_messages_are_recorded_as_their_publisher_sent_them(*, old: bool) -> None:
    sec = int(time.time()) - 60
    with RosbridgeStandin(**SERVED, old=old) as server, Running(config(server, time="header")) as running:
        subscription = server.wait_for("subscribe")
        for seq in range(100):
            server.publish(CORE, state(seq + 0.5, sec=sec, seq=seq))
        running.wait_for(100)
    assert (subscription["topic"], subscription["throttle_rate"]) == (CORE, 0)
    assert [values for _, _, values in running.samples] == [
        {"speed": seq + 0.5, "fault_code": 0} for seq in range(100)
    ], "in order"
    assert {(stream, t_us) for stream, t_us, _ in running.samples} == {("vesc", sec * 1_000_000 + 123_456)}
    assert len(running.samples[0][2].raw) == 4 + 8 + 4 + 9 + 8 + 4
    kind = message_type(running.said[0])
    assert (kind.topic, kind.kind) == (CORE, VESC)
    if not old:
        # genmsg of ROS computes it in this way.
        assert (kind.md5sum, kind.definition) == ("da885266203a97b33d0ad1d0fa9d1d9e", VESC_TEXT)
    assert running.source.report()[CORE] == {"messages": 100}


def test_arrays_bytes_and_nan_are_kept(server: RosbridgeStandin) -> None:
    with Running(config(server, "/scan")) as running:
        server.wait_for("subscribe")
        header = {"seq": 1, "stamp": {"secs": 1, "nsecs": 2}, "frame_id": "laser"}
        server.publish("/scan", {"header": header, "ranges": [1.5, None], "raw": "AQI=", "when": []})
        running.wait_for(1)
    head = struct.pack("<IIII", 1, 1, 2, 5) + b"laser"
    assert running.samples[0][2].raw == head + struct.pack("<IffI2sI", 2, 1.5, math.nan, 2, b"\1\2", 0)
    assert running.source.report()["/scan"] == {"messages": 1, "not_a_number": 1}


def test_only_selected_fields_are_read(server: RosbridgeStandin) -> None:
    with Running(config(server, fields=("speed",))) as running:
        server.wait_for("subscribe")
        server.publish(CORE, state(2))
        running.wait_for(1)
    assert running.samples[0][2] == {"speed": 2}


def test_messages_wait_for_rosapi(server: RosbridgeStandin) -> None:
    """The newest 2,000; those before are counted as not recorded."""
    server.silent_rosapi = True
    with Running(config(server)) as running:
        server.wait_for("subscribe")
        for n in range(2_003):
            server.publish(CORE, state(n, seq=n))
        until(lambda: running.source.report()[CORE]["messages"] == 2_003)
        assert running.source.report()[CORE]["type_unknown"] == 2_003
        server.silent_rosapi = False
        server.cut()
        server.wait_for("subscribe", 2)
        server.publish(CORE, state(2_003, seq=2_003))
        running.wait_for(2_000)
        until(lambda: running.source.report()[CORE]["type_unknown"] == 4)
    assert [values["speed"] for _, _, values in running.samples] == list(range(4, 2_004)), "in order"


def test_a_known_type_stays_while_rosapi_is_gone(server: RosbridgeStandin) -> None:
    with Running(config(server)) as running:
        server.wait_for("subscribe")
        server.publish(CORE, state(1))
        running.wait_for(1)
        server.definitions = None
        server.cut()
        server.wait_for("subscribe", 2)
        server.publish(CORE, state(2))
        running.wait_for(2)
    assert running.samples[1][2]["speed"] == 2


def test_types_are_requested_again_after_a_reconnect(server: RosbridgeStandin) -> None:
    with Running(config(server)) as running:
        server.wait_for("subscribe")
        server.publish(CORE, state(1))
        running.wait_for(1)
        server.__exit__()
        assert server.definitions is not None
        server.definitions[VESC] = VESC_TEXT + "float32 added\n"
        server.__enter__()
        server.wait_for("subscribe", 2)
        message = state(2)
        message["state"]["added"] = 0.25
        server.publish(CORE, message)
        running.wait_for(2)
    assert running.samples[1][2] == {"speed": 2, "fault_code": 0, "added": 0.25}
    assert running.source.report()[CORE].keys() == {"messages", "interruptions", "dark_s"}


def test_the_source_reconnects_and_resubscribes_each_time(
    server: RosbridgeStandin, log: pytest.LogCaptureFixture
) -> None:
    with Running(config(server)) as running:
        for n in range(1, 4):
            server.wait_for("subscribe", n)
            server.publish(CORE, state(n))
            running.wait_for(n)
            server.cut()
        server.wait_for("subscribe", 4)
    assert [values["speed"] for _, _, values in running.samples] == [1, 2, 3], "no sample is repeated"
    assert "connection lost" in log.text


def test_the_source_may_start_before_the_server(log: pytest.LogCaptureFixture) -> None:
    server = RosbridgeStandin(free_port(), **SERVED)
    with Running(config(server)) as running:
        until(lambda: "nobody listens there: is rosbridge_server running?" in log.text)
        with server:
            server.wait_for("subscribe")
            server.publish(CORE, state())
            running.wait_for(1)
    assert log.text.count("nobody listens there") == 1


def test_pings_keep_a_quiet_connection_open(server: RosbridgeStandin) -> None:
    with Running(config(server, times=SOON._replace(ping_s=0.5, dead_s=60.0))) as running:
        until(lambda: server.pings >= 4)
    assert running.source.connection.connects == 1


def test_the_source_disconnects_from_a_server_without_answers(
    server: RosbridgeStandin, log: pytest.LogCaptureFixture
) -> None:
    server.deaf = True
    with Running(config(server, times=SOON._replace(ping_s=0.5, dead_s=2.0))) as running:
        until(lambda: running.source.connection.connects == 2)
    assert "no answer for 2 s" in log.text


IMPATIENT = SOON._replace(patience_s=0.5)


def numbered(seq: int) -> dict[str, Any]:
    """Return a stamped message of ROS 1 whose publisher counts."""
    return {"header": {"seq": seq, "stamp": {"secs": seq, "nsecs": 5}, "frame_id": ""}, "n": seq}


def test_a_slow_topic_keeps_its_subscription(server: RosbridgeStandin) -> None:
    # Longer than a busy machine stands still: silence on all topics is another case.
    with Running(config(server, "/slow", "/fast", times=SOON._replace(patience_s=4.0))) as running:
        server.wait_for("subscribe", 2)
        server.publish("/slow", numbered(1))
        began = time.monotonic()
        while time.monotonic() - began < 5.0:
            server.publish("/fast", {"n": time.monotonic()})
            time.sleep(0.05)  # the pace of a publisher
        server.publish("/slow", numbered(2))
        until(lambda: running.source.report()["/slow"]["messages"] == 2)
        # The source knows the pace after an interruption.
        server.cut()
        server.wait_for("subscribe", 4)
        began = time.monotonic()
        while time.monotonic() - began < 1.0:
            server.publish("/fast", {"n": time.monotonic()})
            time.sleep(0.05)  # the pace of a publisher
    # A busy machine may be too slow a publisher of the other.
    assert [op for op in server.operations if op["op"] == "unsubscribe" and op["topic"] == "/slow"] == []
    assert "resubscribed" not in running.source.report()["/slow"]


@pytest.mark.parametrize(
    ("topic", "message", "another"),
    [("/map", numbered(1), numbered(2)), ("/plain", {"n": 1.0}, {"n": 2.0})],
    ids=["stamped", "unstamped"],
)
def test_a_latched_message_is_stored_once(
    server: RosbridgeStandin, topic: str, message: dict[str, Any], another: dict[str, Any]
) -> None:
    server.publish(topic, message, latch="/map_server")
    with Running(config(server, topic, times=IMPATIENT)) as running:
        running.wait_for(1)
        server.wait_for("unsubscribe", 2)
        server.cut()
        until(lambda: running.source.connection.connects == 2)
        until(lambda: running.source.report()[topic].get("latched_again", 0) >= 3)
        # A latched message does not prove that the server is deaf: the cut is the only interruption.
        assert running.source.report()[topic]["interruptions"] == 1
        server.publish(topic, another, latch="/map_server")
        running.wait_for(2)
    assert len(running.samples) == 2
    assert running.source.report()[topic]["messages"] == 2


def test_a_deaf_server_is_resubscribed_after_a_master_restart(server: RosbridgeStandin) -> None:
    with Running(config(server, times=IMPATIENT)) as running:
        server.wait_for("subscribe")
        server.publish(CORE, state(1, seq=1))
        running.wait_for(1)
        server.restart_master()
        for seq in range(2, 12):
            server.publish(CORE, state(seq, seq=seq))
        server.wait_for("unsubscribe")
        server.wait_for("subscribe", 2)
        server.publish(CORE, state(12, seq=12))
        running.wait_for(2)
    report = running.source.report()[CORE]
    assert (report["interruptions"], report["resubscribed"]) == (1, 1)
    assert report["dark_s"] >= 0.5


@pytest.mark.parametrize("how", ["closed", "cut"])
def test_an_interruption_is_counted_for_every_topic(server: RosbridgeStandin, how: str) -> None:
    with Running(config(server, "/stamped", "/plain")) as running:
        server.wait_for("subscribe", 2)
        server.publish("/stamped", numbered(41))
        server.publish("/plain", {"n": 41})
        running.wait_for(2)
        if how == "cut":
            server.cut()
        else:
            server.__exit__()
            # Messages published now are lost, since no server forwards them.
            server.__enter__()
        server.wait_for("subscribe", 4)
        server.publish("/stamped", numbered(62))
        server.publish("/plain", {"n": 62})
        running.wait_for(4)
    for report in (running.source.report()[name] for name in ("/stamped", "/plain")):
        assert report["interruptions"] == 1
        assert report["dark_s"] > 0


def test_a_long_interruption_is_reported_while_it_lasts(server: RosbridgeStandin) -> None:
    with Running(config(server)) as running:
        server.wait_for("subscribe")
        server.__exit__()
        until(lambda: running.source.report()[CORE].get("dark_s", 0) >= 0.3)
        server.__enter__()


def test_a_topic_that_is_advertised_later_is_found() -> None:
    times = SOON._replace(ask_again_s=0.2)
    standin = RosbridgeStandin(advertised={}, definitions=SERVED["definitions"])
    with standin as server, Running(config(server, times=times)) as running:
        server.wait_for("subscribe", 2)
        server.publish(CORE, state(1))
        assert server.advertised is not None
        server.advertised[CORE] = VESC
        server.wait_for("subscribe", len(server.operations) + 2)
        server.publish(CORE, state(2))
        running.wait_for(1)
        requests = len([op for op in server.operations if op["op"] == "subscribe"])
    assert [values["speed"] for _, _, values in running.samples] == [2]
    assert requests >= 4
    assert not [op for op in server.operations if op["op"] == "unsubscribe"], (
        "no topic is unsubscribed for it"
    )


def test_a_fragmented_message_is_reassembled(server: RosbridgeStandin, log: pytest.LogCaptureFixture) -> None:
    whole = json.dumps({"op": "publish", "topic": CORE, "msg": state(7)})
    parts = [whole[at : at + 20] for at in range(0, len(whole), 20)]
    with Running(config(server)) as running:
        server.wait_for("subscribe")
        server.send(json.dumps({"op": "fragment", "id": 0, "data": "lost", "num": 3, "total": 5}))
        for number, part in enumerate(parts):
            fragment = {"op": "fragment", "id": 0, "data": part, "num": number, "total": len(parts)}
            server.send(json.dumps(fragment))
        running.wait_for(1)
    assert running.samples[0][2]["speed"] == 7
    assert running.source.connection.counts()["malformed"] == 1


@pytest.mark.parametrize(
    "nonsense",
    [
        "no JSON", "[]", "7", "null", '{"op": "publish"}', '{"op": "publish", "topic": "/other", "msg": {}}',
        '{"op": "publish", "topic": ["/sensors/core"], "msg": {}}', "[" * 100_000,
        '{"op": "publish", "topic": "/sensors/core", "msg": [1]}',
        '{"op": "publish", "topic": "/sensors/core", "msg": {"header": {}}}',
        '{"op": "service_response", "id": 1}',
    ],
    ids=lambda text: text[:40],
)  # fmt: skip
def test_an_invalid_message_does_not_stop_the_source(server: RosbridgeStandin, nonsense: str) -> None:
    with Running(config(server)) as running:
        server.wait_for("subscribe")
        server.send(nonsense)
        server.publish(CORE, state(5))
        until(lambda: running.samples and running.samples[-1][2] == {"speed": 5, "fault_code": 0})
    assert running.source.connection.connects == 1


def test_the_servers_complaints_are_logged(server: RosbridgeStandin, log: pytest.LogCaptureFixture) -> None:
    with Running(config(server)):
        server.wait_for("subscribe")
        server.send('{"op": "status", "level": "error", "msg": "Unable to load vesc_msgs.msg"}')
        until(lambda: "the server says: Unable to load vesc_msgs.msg" in log.text)


def test_another_server_on_the_port_is_reported(log: pytest.LogCaptureFixture) -> None:
    with RosbridgeStandin() as server:
        url = f"{server.url}/elsewhere"
        topics = ((CORE, TopicConfig(stream="vesc", time="arrival")),)
        with Running(FastConfig(RosbridgeConfig(url=url, topics=topics))):
            until(lambda: "is no rosbridge server" in log.text)


def test_an_error_names_the_missing_websocket_package(
    server: RosbridgeStandin, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "websocket", None)
    with pytest.raises(SourceError, match=r"pip install 'iort-agent\[rosbridge\]'"):
        config(server).build(SystemClock()).run(lambda *_: None, threading.Event())


def test_the_configuration_is_validated(tmp_path: Path) -> None:
    core = "/sensors/core: {stream: vesc, time: header, type: vesc_msgs/VescStateStamped}"
    imu = "/imu: {stream: imu, time: arrival, fields: [a.x], throttle_ms: 100}"
    topics = f"{{{core}, {imu}}}"
    file = config_file(tmp_path, f"{{type: rosbridge, url: 'wss://robot.local:9090/', topics: {topics}}}")
    (source,) = load_config(file).sources
    assert list(source.streams()) == ["imu", "vesc"]
    assert source.describe() == "rosbridge wss://robot.local:9090/, topics /sensors/core, /imu"


@pytest.mark.parametrize("url", ["http://a:9090", "localhost:9090", "ws://", "ws://a:x", "ws://[", "7"])
def test_a_wrong_address_is_rejected(tmp_path: Path, url: str) -> None:
    topics = "{/a: {stream: a, time: arrival}}"
    file = config_file(tmp_path, f"{{type: rosbridge, url: '{url}', topics: {topics}}}")
    with pytest.raises(ConfigError, match=r"sources\[0\]\.url: .*such as ws://localhost:9090"):
        load_config(file)
