"""Commands on their way to ROS, without ROS and without a network."""

from __future__ import annotations

from typing import Any

import pytest

from iort_agent.clock import SystemClock
from iort_agent.lanes.clock_offset import Offset
from tests.unit.agent.downlink_rig import T0, Rig, doubles


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
def test_what_is_not_the_type_is_refused_counted_and_told_once(
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
def test_what_is_no_command_is_refused(raw: bytes) -> None:
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
def test_motion_is_refused_when_it_is_not_for_now(changes: Any, reason: str) -> None:
    rig = Rig()
    rig.send({"data": 1.0}, **changes)
    assert rig.graph.published == []
    assert rig.refused() == {f"cmd/iort/car1/speed {reason}": 1}


def test_who_asks_is_told_what_became_of_his_command() -> None:
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


def test_a_deadline_is_judged_by_the_clouds_clock_and_what_may_be_too_old_is() -> None:
    rig = Rig()
    for hour in (-1, 1):
        # The car's clock is an hour off, and knows it to within a tenth of a second.
        rig.offset = Offset(hour * 3_600_000.0, 100.0)
        cloud_us = rig.clock.now_us() + hour * 3_600_000_000
        for age_us in (0, 400_000, 400_001):
            sent_us = cloud_us - age_us
            times = {"started_us": T0 - 7_200_000_000, "sent_us": sent_us, "valid_ms": 500}
            rig.send({"data": "hello"}, name="say", lease_ms=None, **times)
    assert len(rig.graph.published) == 4
    assert rig.refused() == {"cmd/iort/car1/say stale": 2}


def test_what_waited_in_a_frozen_car_drives_no_further_than_its_lease() -> None:
    rig = Rig()
    waiting = [T0 + i * 100_000 for i in range(20)]
    rig.clock.advance(2)
    for sent_us in waiting:
        rig.send({"data": 1.0}, started_us=T0, sent_us=sent_us, valid_ms=60_000)
    # Sent 0.2 and 0.1 s ago, with 0.3 s each: the last word holds for 0.2 s more.
    assert len(rig.graph.published) == 2
    assert rig.refused() == {"cmd/iort/car1/speed stale": 10, "cmd/iort/car1/speed lease_over": 8}
    assert rig.downlink.tick() == pytest.approx(0.2)


def test_a_car_that_does_not_know_the_clouds_time_does_not_move_but_speaks(
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


def test_a_car_that_does_not_move_is_not_stopped() -> None:
    rig = Rig()
    rig.uplink.cut()
    rig.dispatcher.run_pending()
    rig.downlink.close()
    assert rig.graph.published == []


def test_without_ros_a_command_is_refused() -> None:
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
