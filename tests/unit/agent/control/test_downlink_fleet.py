"""Messages between robots, with fakes for ROS and the network."""

from __future__ import annotations

from typing import Any

from iort_agent.common.state import ClockOffset
from iort_agent.mqtt.dispatch import Dispatcher
from iort_agent.mqtt.uplink import MqttMessage
from iort_agent.ros1.json_message import encode
from iort_contract.messages.control.commands import FleetMessage, decode_fleet, encode_fleet
from iort_contract.ros1.definition import parse
from testkit.agent import Loopback, ManualClock
from tests.unit.agent.control.downlink_rig import POSE, POSE_MESSAGE, T0, Rig, doubles

SHARE = {"/pose": {"name": "pose", "rate_hz": 5}}


def pose_bytes() -> bytes:
    return encode(parse("geometry_msgs/PoseStamped", POSE), POSE_MESSAGE, now_us=T0)


def test_two_robots_share_their_poses() -> None:
    clock, dispatcher = ManualClock(now_us=T0), Dispatcher()
    broker = Loopback(clock, dispatcher)
    # The fake broker keeps one handler for a filter, so both robots share it.
    first = Rig("car-1", share=SHARE, uplink=broker, clock=clock)
    handlers = dict(broker._subscriptions)
    second = Rig("car2", share=SHARE, uplink=broker, clock=clock)
    both = broker._subscriptions["fleet/iort/+/pose"], handlers["fleet/iort/+/pose"]

    def to_both(message: MqttMessage) -> None:
        for handle in both:
            handle(message)

    broker._subscriptions["fleet/iort/+/pose"] = to_both
    broker.connect()
    for rig in (first, second):
        rig.graph.hear("/pose", "geometry_msgs/PoseStamped", pose_bytes())
    dispatcher.run_pending()
    assert first.graph.published == [("/fleet/car2/pose", pose_bytes())]
    assert second.graph.published == [("/fleet/car_1/pose", pose_bytes())]
    assert second.graph.kinds["/fleet/car_1/pose"] == "geometry_msgs/PoseStamped"
    assert first.refused() == {}


def fleet(
    rig: Rig,
    robot: str,
    seq: int,
    *,
    boot: str = "0badcafe",
    age_us: int = 0,
    message: Any = None,
    offset_us: int | None = None,
) -> None:
    sent_us = rig.clock.now_us() - age_us
    payload = encode_fleet(FleetMessage(boot, seq, sent_us, message or POSE_MESSAGE, offset_us))
    rig.uplink.deliver(f"fleet/iort/{robot}/pose", payload)
    rig.dispatcher.run_pending()


def test_only_newer_messages_of_another_robot_pass() -> None:
    rig = Rig()
    for seq, boot, age_us in [(0, "0badcafe", 0), (2, "0badcafe", 0), (1, "0badcafe", 0), (0, "1badcafe", 0),
                              (1, "1badcafe", 3_000_000)]:  # fmt: skip
        fleet(rig, "car2", seq, boot=boot, age_us=age_us)
    assert len(rig.graph.published) == 3
    assert rig.refused() == {"fleet pose repeated_or_out_of_order": 1, "fleet pose stale": 1}
    assert rig.downlink.report()["fleet"] == {"pose": {"car2": 3}}


def test_two_wrong_clocks_are_compared_through_the_clouds() -> None:
    rig = Rig()
    rig.offset = ClockOffset(3_600_000.0, 1.0)
    # Their clock is an hour ahead of ours, and both know their offset.
    for seq, age_us in enumerate((0, 2_000_000, 2_000_001)):
        fleet(rig, "car2", seq, age_us=age_us - 3_600_000_000, offset_us=0)
    assert rig.downlink.report()["fleet"] == {"pose": {"car2": 2}}
    assert rig.refused() == {"fleet pose stale": 1}


def test_a_taken_ros_name_and_too_many_robots_are_rejected() -> None:
    rig = Rig()
    fleet(rig, "a-b", 0)
    fleet(rig, "a_b", 0)
    for i in range(64):
        fleet(rig, f"car{i}x", 0)
    assert rig.refused() == {"fleet pose name_taken_in_ros": 1, "fleet pose too_many_robots": 1}


def test_another_robots_malformed_message_is_rejected() -> None:
    rig = Rig()
    fleet(rig, "car2", 0, message={"pose": {"position": {}}})
    rig.uplink.deliver("fleet/iort/car2/pose", b"nonsense")
    rig.dispatcher.run_pending()
    assert rig.graph.published == []
    assert rig.refused() == {"fleet pose malformed": 2}


def shared(rig: Rig) -> list[FleetMessage]:
    rig.dispatcher.run_pending()
    return [decode_fleet(m.payload) for m in rig.uplink.published if m.topic == "fleet/iort/car1/pose"]


def test_the_newest_message_is_shared_at_the_rate() -> None:
    rig = Rig(share=SHARE)
    definition = parse("geometry_msgs/PoseStamped", POSE)
    for i in range(100):
        message = {"pose": {**POSE_MESSAGE["pose"], "position": {"x": float(i), "y": 0.0, "z": 0.0}}}
        rig.graph.hear(
            "/pose", "geometry_msgs/PoseStamped", encode(definition, message, now_us=rig.clock.now_us())
        )
        rig.clock.advance(0.01)
        rig.downlink.tick()
    found = shared(rig)
    assert 5 <= len(found) <= 6
    assert [m.seq for m in found] == list(range(len(found)))
    rig.clock.advance(0.2)
    rig.downlink.tick()
    assert shared(rig)[-1].message["pose"]["position"]["x"] == 99.0


def test_nothing_old_is_shared_after_an_outage() -> None:
    rig = Rig(share=SHARE)
    rig.uplink.cut()
    rig.graph.hear("/pose", "geometry_msgs/PoseStamped", pose_bytes())
    rig.uplink.connect()
    rig.clock.advance(10)
    rig.downlink.tick()
    assert shared(rig) == []


def test_a_message_with_nan_is_not_shared() -> None:
    rig = Rig(share={"/x": {"name": "pose"}})
    rig.graph.hear("/x", "std_msgs/Float64", doubles(float("nan")))
    rig.graph.hear("/x", "std_msgs/Float64", b"123")
    assert shared(rig) == []
    assert rig.refused() == {"share /x cannot_be_sent": 2}
