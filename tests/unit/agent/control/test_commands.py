"""Commands to ROS topics: who drives, how far, and what stops the robot; fakes for ROS and the network."""

from __future__ import annotations

import json
import threading
from typing import Any, Callable

import pytest

from iort_agent.common.state import ClockOffset
from iort_agent.common.threads import SystemClock
from iort_agent.control.commands import refuse_commands
from iort_agent.control.leases import STOP_AHEAD_MS
from iort_agent.errors import ConfigError, SourceError
from iort_agent.mqtt.dispatch import Dispatcher
from iort_contract.messages.commands import Command, encode_command
from testkit.agent import Loopback, ManualClock, link_of
from testkit.waiting import GUARD_S, until
from tests.unit.agent.control.downlink_rig import CONFIG, T0, Rig, doubles

pytestmark = pytest.mark.usefixtures("ros")
STOP = ("/commands/motor/speed", doubles(0.0))
POSE: dict[str, Any] = {
    "cmd": {
        "pose": {
            "topic": "/pose",
            "type": "geometry_msgs/PoseStamped",
            "partial": True,
            "motion": {"stop": {}},
        }
    },
    "drive": {
        "command": "pose",
        "speed": "pose.position.x",
        "steering": "pose.position.y",
        "max_speed_mps": 1.0,
        "max_steering_rad": 0.5,
    },
}
A, B, C = "aaaaaaaa", "bbbbbbbb", "cccccccc"


def drive(rig: Rig, session: str, x: float, y: float = 0.0, **changes: Any) -> None:
    by = {A: "anna", B: "bert"}.get(session, "cora")
    position = {"position": {"x": x, "y": y, "z": 7.0}}
    rig.send({"pose": position}, name="pose", session=session, started_us=T0 - 10, by=by, **changes)


def driven(rig: Rig) -> list[tuple[Any, ...]]:
    keys = ("by", "outcome", "driver_by", "lease_left_ms", "speed", "steering")
    return [tuple(sample[key] for key in keys) for sample in rig.drove]


def test_a_command_becomes_a_ros_message() -> None:
    rig = Rig()
    rig.send({"data": 2.5})
    rig.send({"data": "hello"}, name="say", lease_ms=None, answer=True)
    assert rig.graph.published == [
        ("/commands/motor/speed", doubles(2.5)), ("/say", b"\x05\0\0\0hello"),
    ]  # fmt: skip
    assert rig.downlink.report()["commands"]["speed"] == {"passed": 1, "stops": 0}
    assert rig.graph.kinds["/commands/motor/speed"] == "std_msgs/Float64"
    assert rig.answers == [("say", 1, None)], "the other did not ask for one"


def without_ros(rig: Rig) -> None:
    rig.graph.up = False


def unknown_offset(rig: Rig) -> None:
    rig.offset = None


def unknown_settings(rig: Rig) -> None:
    rig.settings_known = False


def once_before(rig: Rig) -> None:
    rig.send({"data": 1.0}, seq=7, started_us=T0)


@pytest.mark.parametrize(
    ("given", "sent", "word", "reason"),
    [
        (None, {"message": {}}, "malformed", "data: is missing"),
        (None, {"message": {"speed": 2}}, "malformed", "speed: std_msgs/Float64 has no such field"),
        (None, {"message": {"data": "1"}}, "malformed", "data: must be a number, got '1'"),
        (None, {"message": {"data": True}}, "malformed", "data: must be a number, got True"),
        (None, {"message": {"data": None}}, "malformed", "data: must be a number, got None"),
        (None, {"sent_us": T0 - 600_000, "started_us": T0 - 600_000}, "stale", "stale, sent 0.600 s ago, to"),
        (None, {"sent_us": T0 + 2_000_000}, "from_the_future", "sent -2.000 s ago, to within 0.000 s"),
        (None, {"lease_ms": None}, "without_lease", "without lease"),
        (without_ros, {}, "no_ros", "no ros"),
        (unknown_offset, {}, "clock_offset_unknown", "sent 0.000 s ago, by its own clock"),
        (unknown_settings, {}, "settings_unknown", "settings unknown"),
        (once_before, {"seq": 7, "started_us": T0}, "repeated_or_out_of_order", "repeated or out of order"),
    ],
)
def test_what_may_not_pass_is_rejected_answered_counted_and_logged_once(
    given: Callable[[Rig], None] | None, sent: Any, word: str, reason: str, caplog: pytest.LogCaptureFixture
) -> None:
    rig, sent = Rig(), {"message": {"data": 1.0}, **sent}
    if given is not None:
        given(rig)
    before = list(rig.graph.published)
    for _ in range(3):
        rig.send(**sent, answer=True)
    assert rig.graph.published == before
    assert rig.refused() == {f"cmd/iort/car1/speed {word}": 3}
    assert [reason in (why or "") for _, _, why in rig.answers] == [True] * 3
    assert caplog.text.count(reason) == len(caplog.records) == 1
    if word == "malformed":
        rig.clock.advance(60)
        rig.send(**sent)
        assert "(and 2 more like it)" in caplog.text


@pytest.mark.parametrize(
    "raw",
    [b"", b"\xff", b"[]", b"{}", b'{"v": 1}', b'{"v":1,"session":"feedbeef","message":{"data":NaN}}'],
)
def test_a_malformed_command_is_rejected(raw: bytes) -> None:
    rig = Rig()
    rig.send(None, raw=raw)
    assert rig.graph.published == []
    assert rig.refused() == {"cmd/iort/car1/speed malformed": 1}


@pytest.mark.parametrize("given", [unknown_offset, unknown_settings])
def test_only_motion_waits_for_the_clock_and_the_operators_settings(given: Callable[[Rig], None]) -> None:
    rig = Rig()
    given(rig)
    rig.send({"data": 1.0})
    rig.send({"data": "hello"}, name="say", lease_ms=None)
    rig.offset, rig.settings_known = ClockOffset(0.0, 0.0), True
    rig.send({"data": 1.0})
    assert [topic for topic, _ in rig.graph.published] == ["/say", STOP[0]]


def test_a_deadline_counts_by_the_clouds_clock_and_its_uncertainty() -> None:
    rig = Rig()
    for hour in (-1, 1):
        # The car's clock is an hour wrong, and the offset is known to a tenth of a second.
        rig.offset = ClockOffset(hour * 3_600_000.0, 100.0)
        cloud_us = rig.clock.now_us() + hour * 3_600_000_000
        for age_us in (0, 400_000, 400_001):
            sent_us = cloud_us - age_us
            times = {"started_us": T0 - 7_200_000_000, "sent_us": sent_us, "valid_ms": 500}
            rig.send({"data": "hello"}, name="say", lease_ms=None, **times)
    assert len(rig.graph.published) == 4
    assert rig.refused() == {"cmd/iort/car1/say stale": 2}


def test_a_command_that_passes_while_its_topic_is_released_stays() -> None:
    rig = Rig()
    graph, sending = rig.graph, threading.Thread(target=lambda: rig.send({"data": 2.0}))

    def release(_topic: str) -> None:
        graph.published.append(("released", b""))
        sending.start()
        sending.join(0.05)  # It cannot pass meanwhile.
        graph.published.append(("free", b""))

    graph.release = release  # type: ignore[method-assign]  # to send in the middle of it
    rig.send({"data": 1.0})
    while "free" not in [topic for topic, _ in graph.published]:
        rig.clock.advance(0.25)
        rig.downlink.tick()
    sending.join()
    assert [topic for topic, _ in graph.published][-3:] == ["released", "free", STOP[0]]


def test_a_lease_that_ends_stops_the_car(caplog: pytest.LogCaptureFixture) -> None:
    rig = Rig()
    rig.send({"data": 2.5})
    assert rig.downlink.tick() == pytest.approx(0.3)
    rig.clock.advance(0.29)
    rig.downlink.tick()
    assert len(rig.graph.published) == 1
    for _ in range(100):
        rig.clock.advance(0.05)
        rig.downlink.tick()
    assert rig.graph.published[1:] == [STOP] * 5
    assert caplog.text.count("nobody renews it, stopping") == 1
    rig.send({"data": 1.0})
    assert rig.graph.published[-1][1] == doubles(1.0)


def test_a_motion_whose_stop_fails_keeps_no_other_from_stopping() -> None:
    steer = {**CONFIG["cmd"]["speed"], "topic": "/commands/servo/position"}
    rig = Rig(cmd={**CONFIG["cmd"], "steer": steer})
    publish = rig.graph.publish

    def failing(topic: str, data: bytes) -> bool:
        if topic == STOP[0]:
            raise RuntimeError("no more sockets")
        return publish(topic, data)

    rig.graph.publish = failing  # type: ignore[method-assign]  # for ever
    rig.downlink.set_stopped(True)
    assert rig.graph.published == [(steer["topic"], STOP[1])]


def test_the_end_of_a_lease_that_began_during_stops_is_told() -> None:
    rig = Rig()
    for _ in range(2):
        rig.send({"data": 1.0}, lease_ms=STOP_AHEAD_MS + 10)
        rig.clock.advance(0.011)
        rig.downlink.tick()
    assert [sample["outcome"] for sample in rig.drove] == ["accepted", "stopped"] * 2


def test_two_names_of_one_topic_share_its_lease() -> None:
    slow = {**CONFIG["cmd"]["speed"], "max_age_s": 0.5}
    rig = Rig(cmd={**CONFIG["cmd"], "slow": slow})
    rig.send({"data": 2.5})
    rig.send({"data": 1.0}, name="slow", session="ffffffff")
    assert rig.refused() == {"cmd/iort/car1/slow driven_by_another": 1}
    rig.clock.advance(0.2)
    rig.send({"data": 1.0}, name="slow")
    rig.clock.advance(0.2)
    rig.downlink.tick()
    assert [data for _, data in rig.graph.published] == [doubles(2.5), doubles(1.0)], "the lease is renewed"
    rig.clock.advance(0.1)
    for _ in range(100):
        rig.downlink.tick()
        rig.clock.advance(0.05)
    assert rig.graph.published[2:] == [STOP] * 5, "one stop for both"


@pytest.mark.parametrize("moves", [True, False])
def test_a_lost_connection_stops_a_car_that_moves_at_once(moves: bool) -> None:
    rig = Rig()
    if moves:
        rig.send({"data": 2.5})
    rig.uplink.cut()
    rig.dispatcher.run_pending()
    assert rig.graph.published[1:] == [STOP] * moves
    rig.downlink.close()
    assert len(rig.graph.published) == 6 * moves


def test_halt_stops_the_car_and_takes_no_more_commands() -> None:
    rig = Rig()
    rig.send({"data": 2.5})
    rig.downlink.halt()
    assert rig.graph.published[1:] == [STOP]
    rig.send({"data": 2.5})
    assert rig.refused() == {"cmd/iort/car1/speed shutting_down": 1}
    rig.downlink.close()
    assert rig.graph.published[1:] == [STOP] * 5, "who hears badly hears one of five"
    assert rig.clock.monotonic() == pytest.approx(1001)
    assert rig.graph.closed


@pytest.mark.parametrize("failures", [0, 1])
def test_in_real_time_the_stop_comes_with_the_end_of_the_lease_also_if_the_first_one_fails(
    failures: int,
) -> None:
    rig = Rig(clock=SystemClock())
    publish, errors = rig.graph.publish, [RuntimeError("no more sockets")] * failures

    def failing(topic: str, data: bytes) -> bool:
        if data[-8:] == doubles(0) and errors:
            raise errors.pop()
        return publish(topic, data)

    rig.graph.publish = failing  # type: ignore[method-assign]  # once
    rig.downlink.start()

    def passed() -> bool:
        # On a busy machine its lease may be over when it is heard.
        rig.send({"data": 2.5}, lease_ms=100)
        return bool(rig.graph.published)

    until(passed, "a command to pass")
    assert rig.graph.stopped.wait(GUARD_S)
    assert not errors
    rig.downlink.close()
    assert not rig.downlink._thread.is_alive()


def test_an_unknown_command_is_rejected_at_once_with_the_known_names() -> None:
    rig = Rig()
    rig.send({"data": 1.0}, name="sped", answer=True)
    rig.send({"data": 1.0}, name="sped", raw=b"{}")
    assert rig.answers == [("sped", 0, "no such command (did you mean speed?); known: speed, say")]
    assert rig.refused() == {"cmd no_such_command": 1, "cmd malformed": 1}


def test_a_robot_without_commands_rejects_every_command_at_once() -> None:
    clock, dispatcher = ManualClock(), Dispatcher()
    uplink, answers = Loopback(clock, dispatcher), []
    refuse_commands(link_of(uplink, clock), lambda *answer: answers.append(answer))
    uplink.connect()
    command = Command("feedbeef", 1, 0, 2, 500, {}, answer=True)
    uplink.deliver("cmd/iort/car1/drive", encode_command(command))
    dispatcher.run_pending()
    assert answers == [("drive", command, "no such command; car.yaml has no downlink.cmd")]


def test_every_command_is_limited_and_told_as_the_robot_got_it() -> None:
    rig = Rig(**POSE)
    drive(rig, A, 9.0, -9.0)
    drive(rig, A, 0.5, 0.25)
    assert [data[-56:-32] for _, data in rig.graph.published] == [
        doubles(1.0, -0.5, 7.0), doubles(0.5, 0.25, 7.0),
    ]  # fmt: skip
    assert driven(rig) == [
        ("anna", "accepted", "anna", 300, 1.0, -0.5),
        ("anna", "accepted", "anna", 300, 0.5, 0.25),
    ]
    assert rig.downlink.report()["commands"]["pose"] == {"passed": 2, "stops": 0, "limited": 1}


@pytest.mark.parametrize("x", ["true", '"9"', "null", "1e999", "[9.0]"])
def test_what_is_no_number_is_not_limited_but_refused(x: str) -> None:
    rig = Rig(**POSE)
    head = {"v": 1, "session": A, "started_us": T0, "seq": 0, "sent_us": T0, "valid_ms": 500, "lease_ms": 300}
    message = {"pose": {"position": {"x": "number"}}}
    raw = json.dumps({**head, "message": message}).replace('"number"', x).encode()
    rig.send({}, name="pose", raw=raw)
    assert rig.graph.published == []
    assert rig.refused() == {"cmd/iort/car1/pose malformed": 1}


def test_the_samples_tell_who_drives_who_was_refused_and_when_the_robot_stopped() -> None:
    rig = Rig(**POSE)
    drive(rig, A, 0.5)
    drive(rig, B, -0.5)
    drive(rig, B, -0.5)
    rig.clock.advance(0.3)
    rig.downlink.tick()
    assert driven(rig) == [
        ("anna", "accepted", "anna", 300, 0.5, 0.0),
        ("bert", "driven_by_another", "anna", 300, None, None),
        ("anna", "stopped", None, 0, 0.0, 0.0),
    ]


def test_the_emergency_stop_stops_at_once_and_refuses_until_it_is_released() -> None:
    rig = Rig()
    rig.send({"data": 2.5}, session=A)
    rig.downlink.set_stopped(True)
    assert rig.graph.published[1:] == [STOP]
    for _ in range(50):
        rig.clock.advance(0.1)
        rig.downlink.tick()
    assert len(rig.graph.published) == pytest.approx(52, abs=2), "it holds its place on the topic"
    assert rig.downlink.alarms() == ["emergency stop: no motion until an operator releases it"]
    rig.send({"data": 2.5}, session=B, takeover=True)
    rig.send({"data": "hello"}, name="say", lease_ms=None)
    assert rig.graph.published[-1][0] == "/say"
    rig.clock.advance(0.1)
    rig.downlink.set_stopped(False)
    rig.send({"data": 2.5}, session=B, takeover=True)
    outcomes = [sample["outcome"] for sample in rig.drove]
    assert outcomes == ["accepted", "stopped", "emergency_stop", "begin_again"]
    assert rig.refused() == {f"cmd/iort/car1/speed {why}": 1 for why in outcomes[2:]}
    rig.send({"data": 1.5}, session=C)
    assert rig.graph.published[-1] == (STOP[0], doubles(1.5))
    assert rig.downlink.alarms() == []


def test_a_stopped_robot_ends_in_good_order() -> None:
    rig = Rig()
    rig.downlink.set_stopped(True)
    rig.downlink.close()
    assert rig.clock.monotonic() < 1002
    assert rig.graph.closed


def speed(**change: Any) -> dict[str, Any]:
    return {"cmd": {"speed": {**CONFIG["cmd"]["speed"], **change}}}


def stick(**change: Any) -> dict[str, Any]:
    return {**POSE, "drive": {**POSE["drive"], **change}}


@pytest.mark.parametrize(
    ("config", "error"),
    [
        (speed(motion={"stop": {"speed": 0}}), "stop: speed: std_msgs/Float64 has no such field"),
        (speed(motion={"stop": 0}), r"cmd\.speed\.motion\.stop: must be a mapping .* got 0"),
        (speed(motion={}), r"motion\.stop: required"),
        (speed(motion={"stop": {}, "lease_s": 60}), "lease_s: must be .* got 60"),
        (speed(topic="speed"), r"cmd\.speed\.topic: ROS topic must be .*, got 'speed'"),
        (speed(type="Float64"), "must be package/Type"),
        (speed(partial=1), "partial: must be true or false, got 1"),
        ({"cmd": {"a/b": CONFIG["cmd"]["say"]}}, "got 'a/b'"),
        ({"cmd": {"say": {"topic": "/say", "type": "a_msgs/A"}}}, "a_msgs/(msg/)?A is not installed"),
        ({"fleet": {"pose": {"topic": "/pose", "type": "a/B"}}}, "{robot} in it"),
        ({"fleet": {"pose": {"topic": "/{robot}/{robot}", "type": "a/B"}}}, "{robot} in it"),
        ({"share": {"pose": {"name": "pose"}}}, "ROS topic must be .*, got 'pose'"),
        ({"share": {"/a": {"name": "pose"}, "/b": {"name": "pose"}}}, "shared as pose already"),
        ({"ask": {}}, "ask"),
        ({"ask": {"Calibration": {}}}, "ask"),
        ({"ask": {"a/b": {}}}, "ask"),
        ({"ask": {"calibration": {"timeout_s": 61}}}, "ask"),
        (stick(steering="pose.position.w"), "drive: pose.position.w: geometry_msgs/Point has no such field"),
        (stick(max_speed_mps=0), "max_speed_mps: must be a number from 0.01"),
        (stick(speed="pose.0"), "must not be an array"),
        (stick(speed="pose.__proto__.x"), "nor begin with _"),
        (
            {**POSE, "cmd": {"pose": {**POSE["cmd"]["pose"], "partial": False}}},
            r"z: is missing; downlink\.cmd\.pose\.partial must be true",
        ),
    ],
)
def test_a_wrong_configuration(config: Any, error: str) -> None:
    with pytest.raises((ConfigError, SourceError), match=error):
        Rig(**config)
