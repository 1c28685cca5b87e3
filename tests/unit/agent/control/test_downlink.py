"""Commands to ROS topics, with fakes for ROS and the network."""

from __future__ import annotations

import threading
from typing import Any

import pytest

from iort_agent.common.state import ClockOffset
from iort_agent.common.threads import SystemClock
from iort_agent.control.commands import refuse_commands
from iort_agent.control.leases import STOP_AHEAD_MS
from iort_agent.mqtt.dispatch import Dispatcher
from iort_contract.messages.control.commands import Command, encode_command
from testkit.agent import Loopback, ManualClock, link_of
from tests.unit.agent.control.downlink_rig import CONFIG, LEASE_MS, T0, FakeGuard, Rig, doubles


def test_a_command_becomes_a_ros_message() -> None:
    rig = Rig()
    rig.send({"data": 2.5})
    rig.send({"data": "hello"}, name="say", lease_ms=None)
    assert rig.graph.published == [
        ("/commands/motor/speed", doubles(2.5)), ("/say", b"\x05\0\0\0hello"),
    ]  # fmt: skip
    assert rig.downlink.report()["commands"]["speed"] == {"passed": 1, "stops": 0}
    assert rig.graph.kinds["/commands/motor/speed"] == "std_msgs/Float64"


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        ({}, "data: is missing"),
        ({"data": 1.0, "speed": 2}, "speed: std_msgs/Float64 has no such field"),
        ({"data": "1"}, "data: must be a number, got '1'"),
        ({"data": True}, "data: must be a number, got True"),
        ({"data": None}, "data: must be a number, got None"),
    ],
)
def test_a_message_of_another_type_is_rejected_counted_and_logged_once(
    message: Any, reason: str, caplog: pytest.LogCaptureFixture
) -> None:
    rig = Rig()
    for _ in range(3):
        rig.send(message)
    assert rig.graph.published == []
    assert rig.refused() == {"cmd/iort/car1/speed malformed": 3}
    assert caplog.text.count(reason) == len(caplog.records) == 1
    rig.clock.advance(60)
    rig.send(message)
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


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"sent_us": T0 - 2_000_000, "started_us": T0 - 3_000_000}, "stale"),
        ({"sent_us": T0 + 2_000_000}, "from_the_future"),
        ({"lease_ms": None}, "without_lease"),
    ],
)
def test_motion_that_is_late_or_early_is_rejected(changes: Any, reason: str) -> None:
    rig = Rig()
    rig.send({"data": 1.0}, **changes)
    assert rig.graph.published == []
    assert rig.refused() == {f"cmd/iort/car1/speed {reason}": 1}


def test_the_outcome_of_a_command_is_answered() -> None:
    rig = Rig()
    rig.send({"data": 1.0})
    rig.send({"data": 1.0}, answer=True)
    rig.send({"data": 1.0}, answer=True, seq=1)
    rig.send({"data": "fast"}, answer=True)
    rig.send({"data": 1.0}, answer=True, sent_us=T0 - 600_000, started_us=T0 - 600_000)
    assert rig.answers == [
        ("speed", 1, None),
        ("speed", 1, "repeated or out of order, sent 0.000 s ago, to within 0.000 s"),
        ("speed", 3, "data: must be a number, got 'fast'"),
        ("speed", 4, "stale, sent 0.600 s ago, to within 0.000 s"),
    ]


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
    assert [topic for topic, _ in graph.published][-3:] == ["released", "free", "/commands/motor/speed"]


def test_a_command_that_waited_in_a_frozen_car_keeps_only_the_rest_of_its_lease() -> None:
    rig = Rig()
    waiting = [T0 + i * 100_000 for i in range(20)]
    rig.clock.advance(2)
    for sent_us in waiting:
        rig.send({"data": 1.0}, started_us=T0, sent_us=sent_us, valid_ms=60_000)
    # Sent 0.2 and 0.1 s ago, with 0.3 s each: the last one holds for another 0.2 s.
    assert len(rig.graph.published) == 2
    assert rig.refused() == {"cmd/iort/car1/speed stale": 10, "cmd/iort/car1/speed lease_over": 8}
    assert rig.downlink.tick() == pytest.approx(0.2)


def test_without_a_known_offset_only_commands_without_motion_pass(
    caplog: pytest.LogCaptureFixture,
) -> None:
    rig = Rig()
    rig.offset = None
    rig.send({"data": 1.0})
    rig.send({"data": "hello"}, name="say", lease_ms=None)
    assert [topic for topic, _ in rig.graph.published] == ["/say"]
    assert rig.refused() == {"cmd/iort/car1/speed clock_offset_unknown": 1}
    assert "clock offset unknown, sent 0.000 s ago, by its own clock" in caplog.text


def test_a_repeated_delivery_passes_once() -> None:
    rig = Rig()
    rig.send({"data": 1.0}, seq=7, started_us=T0)
    rig.send({"data": 1.0}, seq=7, started_us=T0)
    assert len(rig.graph.published) == 1
    assert rig.refused() == {"cmd/iort/car1/speed repeated_or_out_of_order": 1}


STOP = ("/commands/motor/speed", doubles(0.0))


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


class DyingError(Exception):
    """The agent's end."""


class DyingGuard(FakeGuard):
    """The agent dies while it tells."""

    def tell(self, _topic: str, _until: float | None, *, held: bool) -> bool:
        raise DyingError


def test_the_guard_stops_at_the_leases_end_and_the_agent_before_it() -> None:
    clock = ManualClock(now_us=T0)
    guard = FakeGuard(clock)
    rig = Rig(clock=clock, guard=guard)
    ahead_s = STOP_AHEAD_MS / 1000
    rig.send({"data": 2.5})
    rig.send({"data": 2.5}, lease_ms=STOP_AHEAD_MS + 1)
    clock.advance(0.001)
    # Not before the stop is written, which takes another thread's time.
    assert rig.downlink.tick() == pytest.approx(0.02)
    assert rig.graph.published[-1] == STOP
    assert len(guard.told) == 2
    clock.advance(0.02)
    rig.downlink.tick()
    # A driver lets go: the guard's stop must not overtake the motion before it.
    rig.send({"data": 1.0})
    rig.send({"data": 0.0}, ends=True)
    rig.downlink.tick()
    rig.downlink.set_stopped(True)
    at = clock.monotonic()
    began = at - 0.021
    assert guard.told == [
        (began, pytest.approx(began + LEASE_MS / 1000), False),
        (began, pytest.approx(began + 0.001 + ahead_s), False),
        (at, None, False),
        (at, pytest.approx(at + LEASE_MS / 1000), False),
        (at, pytest.approx(at + ahead_s), False),
        (at, None, True),
    ]


def test_the_guard_knows_of_an_emergency_stop_before_the_first_stop() -> None:
    rig = Rig(guard=DyingGuard(ManualClock(now_us=T0)))
    with pytest.raises(DyingError):
        rig.downlink.set_stopped(True)
    assert rig.graph.published == []


def test_the_guard_stops_what_an_agent_outside_the_graph_cannot() -> None:
    clock = ManualClock(now_us=T0)
    guard = FakeGuard(clock)
    rig = Rig(clock=clock, guard=guard)
    rig.send({"data": 2.5})
    # Another node has taken the agent's name.
    rig.graph.up = False
    clock.advance(0.3)
    rig.downlink.tick()
    assert guard.told == [(1000.0, pytest.approx(1000 + LEASE_MS / 1000), False)], (
        "the lease ends for it, too"
    )
    rig.downlink.set_stopped(True)
    assert guard.told[1:] == [(1000.3, None, True)]
    assert not guard.stops
    rig.graph.up = True
    clock.advance(0.1)
    rig.downlink.tick()
    assert guard.stops
    rig.graph.up = False
    rig.downlink.set_stopped(False)
    assert guard.told[-1][1:] == (None, False), "it must not hold what was released"


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


def test_a_lost_connection_stops_the_car_at_once() -> None:
    rig = Rig()
    rig.send({"data": 2.5})
    rig.uplink.cut()
    rig.dispatcher.run_pending()
    assert rig.graph.published[1:] == [STOP]


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


def test_without_motion_nothing_is_stopped() -> None:
    rig = Rig()
    rig.uplink.cut()
    rig.dispatcher.run_pending()
    rig.downlink.close()
    assert rig.graph.published == []


def test_without_ros_a_command_is_rejected() -> None:
    rig = Rig()
    rig.graph.up = False
    rig.send({"data": 2.5})
    assert rig.refused() == {"cmd/iort/car1/speed no_ros": 1}


def test_in_real_time_the_stop_comes_with_the_end_of_the_lease() -> None:
    rig = Rig(clock=SystemClock())
    stopped = rig.graph.stopped
    rig.downlink.start()
    rig.send({"data": 2.5}, lease_ms=100)
    assert stopped.wait(5)
    rig.downlink.close()
    assert not rig.downlink._thread.is_alive()


def test_a_ros_library_that_fails_once_does_not_keep_the_car_from_stopping() -> None:
    rig = Rig(clock=SystemClock())
    publish, failures = rig.graph.publish, [RuntimeError("no more sockets")]

    def failing(topic: str, data: bytes) -> bool:
        if data == doubles(0) and failures:
            raise failures.pop()
        return publish(topic, data)

    rig.graph.publish = failing  # type: ignore[method-assign]  # once
    rig.downlink.start()
    rig.send({"data": 2.5}, lease_ms=100)
    assert rig.graph.stopped.wait(5)
    assert not failures
    rig.downlink.close()


def test_an_unknown_command_is_rejected_at_once_with_the_known_names() -> None:
    rig = Rig()
    rig.send({"data": 1.0}, name="sped", answer=True)
    ((name, seq, reason),) = rig.answers
    assert (name, seq) == ("sped", 0)
    assert reason == "no such command (did you mean speed?); known: speed, say"
    assert rig.refused() == {"cmd no_such_command": 1}


def test_a_robot_without_commands_rejects_every_command_at_once() -> None:
    clock, dispatcher = ManualClock(), Dispatcher()
    uplink, answers = Loopback(clock, dispatcher), []
    refuse_commands(link_of(uplink, clock), lambda *answer: answers.append(answer))
    uplink.connect()
    command = Command("feedbeef", 1, 0, 2, 500, {}, answer=True)
    uplink.deliver("cmd/iort/car1/drive", encode_command(command))
    dispatcher.run_pending()
    assert answers == [("drive", command, "no such command; car.yaml has no downlink.cmd")]
