"""Viewers that mean no good, at the real broker with its rights enforced: what they ask costs a robot a
bounded amount, and those who look go on looking. Who may not ask at all is tested in tests/local/identity.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from typing import Any

import aiortc
import pytest

from iort_agent.errors import BusyError
from iort_agent.status import SOCKET, fetch
from iort_contract.messages.video import (
    ANSWER,
    ASK,
    CHANNEL,
    KEEP,
    MAX_LOOK_BYTES,
    MAX_VIDEO_VIEWERS,
    OFFER,
    PICTURES,
    REFUSED,
    TERMS,
    Show,
    answer_topic,
    encode_look,
    look_topic,
)
from iort_contract.messages.video import Look as Asked
from iort_station.fleet.robots import Bundle
from local.cloud import EmbeddedCloud
from testkit.car import AgentProcess
from testkit.mqtt import Robot
from testkit.video_viewer import Viewer
from testkit.waiting import InstrumentError, until
from tests.local.conftest import bundle, embedded  # noqa: F401 - fixtures

TWENTY, ONCE = 20, "0c0ffee0"
SETTINGS = {
    "sources": [{"type": "sim", "rate_hz": 20}],
    "video": {"source": {"type": "sim"}, "width": 320, "height": 240, "rate_hz": 5},
}


@pytest.fixture
def car(bundle: Callable[..., Bundle]) -> Iterator[Bundle]:  # noqa: F811 - the fixture
    made = bundle(**SETTINGS)
    with AgentProcess(made, drain_s=0):
        yield made


@pytest.fixture
def viewer(embedded: EmbeddedCloud, car: Bundle) -> Iterator[Viewer]:  # noqa: F811 - the fixture
    with Viewer(embedded.cloud, car.robot) as made:
        assert made.ask(ASK).kind == TERMS
        yield made


def told(car: Bundle) -> dict[str, Any]:
    def asked() -> dict[str, Any] | None:
        with suppress(BusyError):
            return fetch(car.folder / SOCKET)
        return None

    report: dict[str, Any] = until(asked, "the agent's status")["video"]
    return report


def an_offer() -> str:
    async def make() -> str:
        peer = aiortc.RTCPeerConnection(aiortc.RTCConfiguration(iceServers=[]))
        peer.addTransceiver("video", direction="recvonly")
        peer.createDataChannel(CHANNEL)
        await peer.setLocalDescription(await peer.createOffer())
        sdp = peer.localDescription.sdp
        await peer.close()
        return sdp

    return asyncio.run(make())


def test_another_robot_can_neither_ask_nor_answer(
    embedded: EmbeddedCloud,  # noqa: F811 - the fixture
    bundle: Callable[..., Bundle],  # noqa: F811 - the fixture
    viewer: Viewer,
    car: Bundle,
) -> None:
    namespace = embedded.cloud.namespace
    stranger = bundle("stranger")
    look = encode_look(Asked("0badcafe", "00000001", OFFER, sdp=an_offer()))
    for topic in (look_topic(car.robot, namespace), answer_topic(car.robot, viewer.viewer, namespace)):
        with Robot(stranger.folder) as other:
            assert other.online().attempt(topic, look) != "SUCCESS"
    assert viewer.ask(ASK).kind == TERMS
    # What it has asked; on a busy machine a question is sent again, and answered twice.
    assert {show.kind for show in viewer.heard} == {TERMS}
    assert told(car)["viewers"] == 0


def test_an_offer_that_is_said_again_is_answered_once(viewer: Viewer, car: Bundle) -> None:
    sdp = an_offer()
    first = viewer.send(OFFER, sdp, request=ONCE)
    assert viewer.answer(first).kind == ANSWER
    viewer.send(OFFER, sdp, request=ONCE)
    # Requests are answered in their order.
    assert viewer.ask(ASK).kind == TERMS
    assert [show.kind for show in viewer.heard if show.request == ONCE] == [ANSWER]
    # On a busy machine it may have ended, since nobody connects.
    assert told(car)["viewers"] <= 1


def test_too_much_is_dropped_unread_and_others_go_on(
    embedded: EmbeddedCloud,  # noqa: F811 - the fixture
    viewer: Viewer,
    car: Bundle,
) -> None:
    assert viewer.ask(PICTURES).kind == TERMS

    def seen() -> int:
        # A busy machine may take longer than a lease.
        viewer.send(KEEP)
        return int(told(car)["over the broker"])

    until(lambda: seen() > 2)
    # The most that the broker passes; a megabyte it refuses.
    for size in (MAX_LOOK_BYTES + 1, 120_000):
        viewer.publish(b'{"v": 1, "sdp": "' + b"x" * size + b'"}')
    until(lambda: seen() and told(car)["malformed"] >= 2)
    with Viewer(embedded.cloud, car.robot) as other, suppress(Exception):
        # The broker ends the connection of who sends it.
        other.publish(b"x" * 1_000_000)
    pictures = seen()
    assert viewer.ask(ASK).kind == TERMS
    until(lambda: seen() > pictures)
    broken = an_offer().replace("m=video", "m=audio")
    assert viewer.ask(OFFER, broken).kind == REFUSED


def test_twenty_viewers_are_served_or_refused_and_one_encoder_serves_all(
    embedded: EmbeddedCloud,  # noqa: F811 - the fixture
    car: Bundle,
) -> None:
    sdp, most = an_offer(), 0

    def look(each: Viewer) -> Show:
        def offered() -> Show | None:
            # What is too much at once is dropped, and asked again.
            with suppress(InstrumentError):
                return each.ask(OFFER, sdp, within_s=5.0)
            return None

        return until(offered, "the robot's answer")

    with ExitStack() as stack, ThreadPoolExecutor(TWENTY) as pool:
        viewers = [stack.enter_context(Viewer(embedded.cloud, car.robot)) for _ in range(TWENTY)]
        asked = [pool.submit(look, one) for one in viewers]

        def answered() -> bool:
            nonlocal most
            most = max(most, told(car)["viewers"])
            return all(one.done() for one in asked)

        until(answered, "twenty answers")
        shows = [one.result() for one in asked]
    refused = [one for one in shows if one.kind == REFUSED]
    assert {one.kind for one in shows} == {ANSWER, REFUSED}
    assert all(str(MAX_VIDEO_VIEWERS) in one.why for one in refused)
    assert 0 < most <= MAX_VIDEO_VIEWERS
