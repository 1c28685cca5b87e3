"""Questions from ROS to the cloud, with fakes for ROS, the network and the cloud."""

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
from iort_agent.control.commands import Operator
from iort_agent.control.config import DownlinkConfig
from iort_agent.control.downlink import Downlink
from iort_agent.control.questions import Questions
from iort_agent.errors import ConfigError, UploadError
from iort_agent.files.upload import Uploader
from iort_agent.mqtt.dispatch import Dispatcher
from iort_contract.messages.requests.ask import (
    MAX_INLINE_BYTES,
    OVER_QUOTA,
    Answer,
    Ask,
    Content,
    Refusal,
    decode_ask,
    encode_answer,
)
from iort_contract.messages.requests.files import file_key
from testkit.agent import Loopback, link_of
from tests.unit.agent.control.downlink_rig import FakeGraph

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


class Rig:
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
            link=link,
            boot="0badcafe",
            graph=graph,
            offset=offset,
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
def rig() -> Iterator[Callable[..., Rig]]:
    made: list[Rig] = []

    def make(asks: Any = None, **given: Any) -> Rig:
        made.append(Rig(FakeGraph(), asks or {NAME: {"timeout_s": SOON_S}}, **given))
        return made[-1]

    yield make
    for one in made:
        one.close()


def test_a_service_asks_the_cloud_and_responds_with_the_answer(rig: Callable[..., Rig]) -> None:
    robot = rig({NAME: {"body": {"last": 1}}})
    success, message = robot.call()
    assert (success, json.loads(message)) == (True, {"asked": {"last": 1}})
    ((topic, ask),) = robot.asked
    assert topic == "ask/iort/car1/calibration"
    assert (ask.offset_us, 14_000 < ask.valid_ms <= 15_000) == (1500, True)
    assert robot.downlink.report()["asked"] == {NAME: {"answered": 1}}


def test_a_refusal_is_a_failure_with_its_reason(rig: Callable[..., Rig]) -> None:
    robot = rig()
    robot.cloud = lambda ask: Answer(ask.id, Refusal(OVER_QUOTA, "60 an hour"))
    assert robot.call() == (False, "over_quota: 60 an hour")
    assert robot.downlink.report()["asked"] == {NAME: {"over_quota": 1}}


def test_without_an_answer_the_call_fails_at_its_deadline(rig: Callable[..., Rig]) -> None:
    robot = rig({NAME: {"timeout_s": 0.1}})
    robot.cloud = lambda _: None
    assert robot.call() == (False, "no_answer: no answer within 0.1 s")


def test_without_a_connection_the_call_fails_at_once(rig: Callable[..., Rig]) -> None:
    robot = rig(connected=False)
    success, message = robot.call()
    assert (success, message.split(":")[0]) == (False, "not_connected")


def test_a_question_that_the_broker_refuses_fails_at_once(rig: Callable[..., Rig]) -> None:
    robot = rig()
    robot.uplink.verdict = lambda _: "not authorized"
    assert robot.call() == (False, "no_answer: the question was not sent: not authorized")


def test_a_waiting_call_fails_when_the_agent_ends(rig: Callable[..., Rig]) -> None:
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


def test_only_the_answer_of_its_id_counts(rig: Callable[..., Rig]) -> None:
    robot = rig({NAME: {"timeout_s": 0.2}})
    robot.cloud = lambda _: Answer("0badcafe", {"other": 1})
    assert robot.call()[0] is False
    robot.uplink.deliver("answer/iort/car1/calibration", b"no answer at all")
    robot.cloud = lambda ask: Answer(ask.id, {})
    assert robot.call() == (True, "{}")


def test_large_bodies_are_files_both_ways(rig: Callable[..., Rig], tmp_path: Path) -> None:
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
    rig: Callable[..., Rig], tmp_path: Path
) -> None:
    file = tmp_path / "track.json"
    file.write_text("[]")
    robot = rig({NAME: {"body_file": str(file)}})
    assert "is not a JSON object" in robot.call()[1]
    file.unlink()
    assert robot.call()[1].startswith("invalid: ")


def test_a_topic_asks_with_its_own_body_and_answers_in_order(rig: Callable[..., Rig]) -> None:
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


@pytest.mark.parametrize("asks", [{}, {"Calibration": {}}, {"a/b": {}}, {NAME: {"timeout_s": 61}}])
def test_a_wrong_configuration_is_refused(asks: Any) -> None:
    with pytest.raises(ConfigError, match="ask"):
        load(DownlinkConfig, {"ask": asks}, Place(Path("car.yaml")))
