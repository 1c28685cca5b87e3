"""Messages between robots, and questions to the cloud, with fakes for ROS and the network."""

from __future__ import annotations

import hashlib
import json
import struct
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import pytest

from iort_agent.common.schema import Place, load
from iort_agent.common.state import ClockOffset
from iort_agent.common.threads import SystemClock
from iort_agent.control import Bridge
from iort_agent.control.commands import Operator
from iort_agent.control.config import DownlinkConfig
from iort_agent.control.downlink import Downlink
from iort_agent.control.questions import Questions
from iort_agent.errors import UploadError
from iort_agent.files.upload import Uploader
from iort_agent.mqtt.dispatch import Dispatcher
from iort_agent.mqtt.uplink import MqttMessage
from iort_agent.ros.json_message import encode
from iort_contract.messages.commands import FleetMessage, decode_fleet, encode_fleet
from iort_contract.messages.files import file_key
from iort_contract.messages.questions import (
    MAX_INLINE_BYTES,
    OVER_QUOTA,
    Answer,
    Ask,
    Content,
    Refusal,
    decode_ask,
    encode_answer,
)
from iort_contract.ros.definition import parse
from testkit.agent import Loopback, ManualClock, link_of
from tests.unit.agent.control.downlink_rig import POSE, POSE_MESSAGE, T0, FakeGraph, Rig, doubles

pytestmark = pytest.mark.usefixtures("ros")
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


def test_a_pose_of_the_other_ros_passes(ros: int, monkeypatch: pytest.MonkeyPatch) -> None:
    theirs = Rig(share=SHARE)
    theirs.graph.hear("/pose", "geometry_msgs/PoseStamped", pose_bytes())
    ((topic, payload),) = [(m.topic, m.payload) for m in theirs.uplink.published]
    monkeypatch.setattr(FakeGraph, "ros", 3 - ros)
    ours = Rig("car2")
    ours.uplink.deliver(topic, payload)
    ours.dispatcher.run_pending()
    assert ours.graph.published == [("/fleet/car1/pose", pose_bytes())]


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


def test_a_name_that_ros2_does_not_allow_is_rejected(ros: int) -> None:
    rig = Rig()
    fleet(rig, "7", 0)
    assert rig.refused() == ({} if ros == 1 else {"fleet pose no_name_in_ros2": 1})
    rig = Rig(fleet={"pose": {"topic": "/fleet/car{robot}/pose", "type": "geometry_msgs/PoseStamped"}})
    fleet(rig, "7", 0)
    assert [topic for topic, _ in rig.graph.published] == ["/fleet/car7/pose"]


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


NAME, SOON_S = "calibration", 30.0
SERVICE, TOPIC, ANSWERS = f"/iort/ask/{NAME}", f"/iort/ask/{NAME}", f"/iort/answer/{NAME}"
HASH = "a591a6d40bf420404a011733cfb7b190d62c65bf0bcda32b57b277d9ad9f146e"


def string(text: str) -> bytes:
    return struct.pack("<I", len(text.encode())) + text.encode()


class Bucket:
    """Uploads and downloads in memory."""

    def __init__(self) -> None:
        self.stored: dict[str, bytes] = {}
        self.full = False

    def upload(self, local: Any, _stop: threading.Event) -> str:
        if self.full:
            raise UploadError("refused: no more today", again_s=None)
        key = file_key("car1", local.file)
        with local.open() as file:
            self.stored[key] = file.read()
        return key

    def download(self, place: str, size: int) -> bytes:
        return self.stored[place][:size]


class AskingRig:
    """A robot whose cloud answers by ``cloud``; None for no answer."""

    def __init__(self, graph: FakeGraph, asks: dict[str, Any], *, connected: bool = True) -> None:
        clock, self.dispatcher = SystemClock(), Dispatcher()
        self.uplink = Loopback(clock, self.dispatcher, connected=connected)
        self.graph, self.bucket = graph, Bucket()
        self.asked: list[tuple[str, Ask]] = []
        self.cloud: Callable[[Ask], Answer | None] = lambda ask: Answer(ask.id, {"asked": ask.body})
        self.uplink.verdict = self._on_publish
        link = link_of(self.uplink, clock)

        def offset() -> ClockOffset:
            return ClockOffset(1.5, 0.1)

        self.downlink = Downlink(
            load(DownlinkConfig, {"ask": asks}, Place(Path("car.yaml"))),
            (),
            Bridge(link, graph, offset),
            boot="0badcafe",
            operator=Operator(lambda *_: None, lambda _: None, lambda: True),
            questions=Questions(
                link, cast("Uploader", self.bucket), download=self.bucket.download, offset=offset
            ),
        )
        self.uplink.start()
        self.downlink.start()

    def _on_publish(self, message: Any) -> None:
        ask = decode_ask(message.payload)
        self.asked.append((message.topic, ask))
        answer = self.cloud(ask)
        if answer is not None:
            self.uplink.deliver(message.topic.replace("ask/", "answer/", 1), encode_answer(answer))

    def call(self, service: str = SERVICE) -> tuple[bool, str]:
        return self.graph.services[service]()

    def close(self) -> None:
        self.downlink.close()
        self.uplink.stop(1)


@pytest.fixture
def rig() -> Iterator[Callable[..., AskingRig]]:
    made: list[AskingRig] = []

    def make(asks: Any = None, **given: Any) -> AskingRig:
        made.append(AskingRig(FakeGraph(), asks or {NAME: {"timeout_s": SOON_S}}, **given))
        return made[-1]

    yield make
    for one in made:
        one.close()


def test_a_service_asks_the_cloud_and_responds_with_the_answer(rig: Callable[..., AskingRig]) -> None:
    robot = rig({NAME: {"body": {"last": 1}}})
    success, message = robot.call()
    assert (success, json.loads(message)) == (True, {"asked": {"last": 1}})
    ((topic, ask),) = robot.asked
    assert topic == "ask/iort/car1/calibration"
    assert (ask.offset_us, 0 < ask.valid_ms <= SOON_S * 1000 / 2) == (1500, True)
    assert robot.downlink.report()["asked"] == {NAME: {"answered": 1}}


@pytest.mark.parametrize(
    ("settings", "reply", "message"),
    [
        ({}, Refusal(OVER_QUOTA, "60 an hour"), "over_quota: 60 an hour"),
        ({"asks": {NAME: {"timeout_s": 0.1}}}, None, "no_answer: no answer within 0.1 s"),
        ({"connected": False}, None, "not_connected: the robot is not connected to the cloud"),
        ({}, "not authorized", "no_answer: the question was not sent: not authorized"),
    ],
)
def test_a_call_without_an_answer_fails_with_the_reason(
    rig: Callable[..., AskingRig], settings: dict[str, Any], reply: Refusal | str | None, message: str
) -> None:
    robot = rig(**settings)
    robot.cloud = lambda ask: Answer(ask.id, reply) if isinstance(reply, Refusal) else None
    if isinstance(reply, str):
        robot.uplink.verdict = lambda _: reply
    assert robot.call() == (False, message)
    assert robot.downlink.report()["asked"] == {NAME: {message.split(":", maxsplit=1)[0]: 1}}


def test_a_waiting_call_fails_when_the_agent_ends(rig: Callable[..., AskingRig]) -> None:
    robot, asked = rig(), threading.Event()

    def silent(_: Ask) -> None:
        asked.set()

    robot.cloud = silent
    heard: list[tuple[bool, str]] = []
    caller = threading.Thread(target=lambda: heard.append(robot.call()))
    caller.start()
    assert asked.wait(SOON_S)
    robot.downlink.halt()
    caller.join(SOON_S)
    assert heard == [(False, "no_answer: the agent ends")]
    assert robot.call() == (False, "no_answer: the agent ends")


def test_only_the_answer_of_its_id_counts(rig: Callable[..., AskingRig]) -> None:
    robot = rig({"soon": {"timeout_s": 0.2}, NAME: {"timeout_s": SOON_S}})
    robot.cloud = lambda _: Answer("0badcafe", {"other": 1})
    assert robot.call("/iort/ask/soon")[0] is False
    robot.uplink.deliver("answer/iort/car1/calibration", b"no answer at all")
    robot.cloud = lambda ask: Answer(ask.id, {})
    assert robot.call() == (True, "{}")


def test_large_bodies_are_files_both_ways(rig: Callable[..., AskingRig], tmp_path: Path) -> None:
    body = {"text": "x" * MAX_INLINE_BYTES}
    (tmp_path / "track.json").write_text(json.dumps(body))
    robot = rig({NAME: {"body_file": str(tmp_path / "track.json")}})

    def echoed(ask: Ask) -> Answer:
        assert isinstance(ask.body, Content)
        content = robot.bucket.stored[ask.body.place]
        robot.bucket.stored["https://answer"] = content
        told = hashlib.sha256(content).hexdigest()
        return Answer(ask.id, Content("https://answer", told, len(content)))

    robot.cloud = echoed
    success, message = robot.call()
    assert (success, json.loads(message)) == (True, body)
    (key,) = (key for key in robot.bucket.stored if key.startswith("robots/car1/"))
    assert "/ask/" in key
    # Another content than the cloud told.
    robot.cloud = lambda ask: Answer(ask.id, Content("https://answer", HASH, 10))
    assert "another SHA-256" in robot.call()[1]
    robot.bucket.full = True
    assert robot.call() == (False, "no_answer: the question was not uploaded: refused: no more today")


def test_a_body_file_that_cannot_be_read_is_the_callers_failure(
    rig: Callable[..., AskingRig], tmp_path: Path
) -> None:
    file = tmp_path / "track.json"
    file.write_text("[]")
    robot = rig({NAME: {"body_file": str(file)}})
    assert "is not a JSON object" in robot.call()[1]
    file.unlink()
    assert robot.call()[1].startswith("invalid: ")


def test_a_topic_asks_with_its_own_body_and_answers_in_order(rig: Callable[..., AskingRig]) -> None:
    robot = rig()
    for text in ('{"n":1}', "no JSON", "", '{"n":2}'):
        robot.graph.hear(TOPIC, "std_msgs/String", string(text))
    robot.graph.await_published(4)
    said = [json.loads(data[4:]) for topic, data in robot.graph.published if topic == ANSWERS]
    assert [one.get("body", one.get("refused")) for one in said] == [
        {"asked": {"n": 1}},
        "invalid",
        {"asked": {}},
        {"asked": {"n": 2}},
    ]
    robot.graph.hear(TOPIC, "std_msgs/Float64", bytes(8))
    assert robot.downlink.report()["refused"] == {f"{TOPIC} malformed": 1}
