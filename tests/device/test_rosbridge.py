"""The rosbridge source against a server on loopback that restarts, falls silent and sends invalid
messages.
"""

from __future__ import annotations

import json
import logging
import math
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

pytest.importorskip("aiohttp")
pytest.importorskip("websocket")

from iort_agent.common.threads import Clock, SystemClock
from iort_agent.config import load_config
from iort_agent.errors import ConfigError, SourceError
from iort_agent.sources.rosbridge import RosbridgeConfig, RosbridgeSource, TopicConfig
from iort_agent.sources.rosbridge.connection import Times
from testkit.ports import free_port
from testkit.waiting import until
from tests.device.running import Running
from tests.rosbridge_standin import RosbridgeStandin
from tests.unit.agent.test_agent import config_file

CORE = "/sensors/core"
VESC = "vesc_msgs/VescStateStamped"


@pytest.fixture
def server() -> Iterator[RosbridgeStandin]:
    with RosbridgeStandin() as standin:
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


def state(n: float = 0, **stamp: int) -> dict[str, Any]:
    """Return a VescStateStamped as rosbridge of ROS 1 or ROS 2 sends it, given the parts of its stamp."""
    return {"header": {"stamp": stamp, "frame_id": "base_link"}, "state": {"speed": n, "fault_code": 0}}


def test_messages_become_samples(server: RosbridgeStandin, log: pytest.LogCaptureFixture) -> None:
    before = time.time_ns() // 1000
    with Running(config(server, type=VESC)) as running:
        asked = server.wait_for("subscribe")
        for n in range(100):
            server.publish(CORE, state(n + 0.5, secs=1, nsecs=2))
        running.wait_for(100)
    assert (asked["topic"], asked["type"], asked["throttle_rate"]) == (CORE, VESC, 0)
    assert [values for _, _, values in running.samples] == [
        {"speed": n + 0.5, "fault_code": 0} for n in range(100)
    ], "in order, and without the wrapper"
    assert {stream for stream, _, _ in running.samples} == {"vesc"}
    times = [t_us for _, t_us, _ in running.samples]
    assert running.said == [], "only the server knows their type"
    assert before < times[0] <= times[-1] < time.time_ns() // 1000
    assert [
        one.getMessage()[:70]
        for one in log.records
        if one.name.startswith("iort") and one.levelname == "WARNING"
    ] == [f"topic {CORE}: the server does not tell the structure of its mes"]


def test_a_message_becomes_supported_values(server: RosbridgeStandin) -> None:
    message = {
        "header": {"stamp": {"sec": 1, "nanosec": 2}},
        "pose": {"position": {"x": 1.5, "y": None}},
        "covariance": [0.1, 0.2],
        "ranges": [1.0] * 65,
        "name": "left",
        "blob": "A" * 5000,
        "ok": True,
        "lap": {"secs": 3, "nsecs": 4},
    }
    with Running(config(server, "/odd")) as running:
        server.wait_for("subscribe")
        server.publish("/odd", message)
        server.publish("/odd", {"a": float("nan"), "b": 1})
        running.wait_for(2)
    assert math.isnan(running.samples[0][2].pop("pose.position.y")), "the server converts NaN to null"
    assert running.samples[0][2] == {
        "pose.position.x": 1.5,
        "covariance.0": 0.1,
        "covariance.1": 0.2,
        "name": "left",
        "ok": True,
        "lap.sec": 3,
        "lap.nanosec": 4,
    }
    assert running.samples[1][2]["a"] != running.samples[1][2]["a"], "the contract counts it"
    assert running.source.report()["/odd"]["left_out"] == {"ranges": 1, "blob": 1}


def test_only_selected_fields_are_read(server: RosbridgeStandin, log: pytest.LogCaptureFixture) -> None:
    message = {"pose": {"x": 1, "y": 2}, "pose_age": 3, "ranges": list(range(100))}
    with Running(config(server, "/odd", fields=("pose", "ranges.77", "height"))) as running:
        server.wait_for("subscribe")
        server.publish("/odd", message)
        server.publish("/odd", message)
        running.wait_for(2)
    assert running.samples[0][2] == {"pose.x": 1, "pose.y": 2, "ranges.77": 77}
    assert log.text.count("has no field height") == 1


@pytest.mark.parametrize("parts", [("secs", "nsecs"), ("sec", "nanosec")])
def test_stamps_of_ros_1_and_ros_2_are_read(server: RosbridgeStandin, parts: tuple[str, str]) -> None:
    sec = int(time.time()) - 60
    with Running(config(server, time="header")) as running:
        server.wait_for("subscribe")
        server.publish(CORE, state(1, **dict(zip(parts, (sec, 123_456_789)))))
        running.wait_for(1)
    assert running.samples[0][1] == sec * 1_000_000 + 123_456


@pytest.mark.parametrize(
    ("message", "words", "reason"),
    [
        (state(1, secs=12, nsecs=0), "s off the clock; using the time of arrival", "unbelieved_stamps"),
        ({"data": 1}, "they have no time; using the time of arrival", "no_stamp"),
        ({"header": {"stamp": 7}, "data": 1}, "using the time of arrival", "no_stamp"),
    ],
)
def test_an_implausible_stamp_is_replaced(
    server: RosbridgeStandin, log: pytest.LogCaptureFixture, message: Any, words: str, reason: str
) -> None:
    before = time.time_ns() // 1000
    with Running(config(server, time="header")) as running:
        server.wait_for("subscribe")
        for _ in range(3):
            server.publish(CORE, message)
        running.wait_for(3)
    assert before < running.samples[0][1] < time.time_ns() // 1000
    assert log.text.count(words) == 1
    assert running.source.report()[CORE] == {"messages": 3, reason: 3, "structure_not_kept": 3}


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
    server = RosbridgeStandin(free_port())
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


def numbered(seq: int, **members: Any) -> dict[str, Any]:
    """Return a stamped message of ROS 1 whose publisher counts."""
    return {"header": {"seq": seq, "stamp": {"secs": seq, "nsecs": 5}, "frame_id": ""}, "n": seq, **members}


def test_a_slow_topic_keeps_its_subscription(server: RosbridgeStandin) -> None:
    with Running(config(server, "/slow", "/fast", times=IMPATIENT)) as running:
        server.wait_for("subscribe", 2)
        server.publish("/slow", numbered(1))
        began = time.monotonic()
        while time.monotonic() - began < 2.0:
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
    assert [op["op"] for op in server.operations if op["op"] == "unsubscribe"] == []
    assert "resubscribed" not in running.source.report()["/slow"]


@pytest.mark.parametrize("stamped", [True, False])
def test_a_latched_message_is_stored_once(server: RosbridgeStandin, *, stamped: bool) -> None:
    message = numbered(1) if stamped else {"data": "a map"}
    server.publish("/map", message, latch="/map_server")
    with Running(config(server, "/map", times=IMPATIENT)) as running:
        running.wait_for(1)
        server.wait_for("unsubscribe", 2)
        server.cut()
        until(lambda: running.source.connection.connects == 2)
        until(lambda: running.source.report()["/map"].get("latched_again", 0) >= 3)
        # A latched message does not prove that the server is deaf: the cut is the only interruption.
        assert running.source.report()["/map"]["interruptions"] == 1
        server.publish("/map", {**message, "changed": 1}, latch="/map_server")
        running.wait_for(2)
    assert len(running.samples) == 2
    assert running.source.report()["/map"]["messages"] == 2


def test_a_deaf_server_is_resubscribed_after_a_master_restart(server: RosbridgeStandin) -> None:
    with Running(config(server, times=IMPATIENT)) as running:
        server.wait_for("subscribe")
        server.publish(CORE, numbered(1))
        running.wait_for(1)
        server.restart_master()
        for seq in range(2, 12):
            server.publish(CORE, numbered(seq))
        server.wait_for("unsubscribe")
        server.wait_for("subscribe", 2)
        server.publish(CORE, numbered(12))
        running.wait_for(2)
    report = running.source.report()[CORE]
    assert (report["missed"], report["interruptions"], report["resubscribed"]) == (10, 1, 1)
    assert report["dark_s"] >= 0.5


@pytest.mark.parametrize("how", ["closed", "cut"])
def test_messages_lost_in_an_interruption_are_counted(server: RosbridgeStandin, how: str) -> None:
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
    stamped, plain = (running.source.report()[name] for name in ("/stamped", "/plain"))
    assert stamped["missed"] == 20
    assert "missed" not in plain
    for report in (stamped, plain):
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
    with RosbridgeStandin(advertised={}) as server, Running(config(server, times=times)) as running:
        server.wait_for("subscribe", 2)
        server.publish(CORE, state(1))
        assert server.advertised is not None
        server.advertised[CORE] = VESC
        server.wait_for("subscribe", len(server.operations) + 2)
        server.publish(CORE, state(2))
        running.wait_for(1)
        asked = len([op for op in server.operations if op["op"] == "subscribe"])
    assert [values["speed"] for _, _, values in running.samples] == [2]
    assert asked >= 4
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
        '{"op": "publish", "topic": "/sensors/core", "msg": {"a": ' + "[" * 400 + "1" + "]" * 400 + "}}",
        '{"op": "publish", "topic": "/sensors/core", "msg": {"a": {"/b c": 1}}}',
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
