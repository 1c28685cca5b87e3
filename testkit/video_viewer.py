"""A viewer of a robot's video that is not the page: it asks over the broker, as the contract has it, and
decodes what aiortc receives.

`Viewer` is the signalling. As a process, it looks at a robot until its input ends, and prints a line of JSON
for each picture (`number` as the picture itself shows it, when it was decoded, and what its mark says), for
each answer, and each second for what `getStats()` says.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import queue
import secrets
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import aiortc
from aiortc.jitterbuffer import JitterBuffer, JitterFrame
from aiortc.mediastreams import MediaStreamError
from typing_extensions import Self

from iort_contract.cloud import VIEWER
from iort_contract.limits import ContractError
from iort_contract.messages.live import VIEW_LEASE_MS, VIEW_RENEW_S
from iort_contract.messages.video import (
    ANSWER,
    ASK,
    CHANNEL,
    END,
    KEEP,
    OFFER,
    Look,
    Mark,
    Show,
    answer_topic,
    decode_marks,
    decode_show,
    encode_look,
    look_topic,
)
from iort_station.cloud import Cloud
from iort_station.fleet.broker import Broker
from iort_station.fleet.roles import Role
from testkit.waiting import GUARD_S, InstrumentError, until

# How long a picture with a hole may hold up those after it.
_HOLE_S = 0.3
# aiortc has no seam for them.
_BUFFER, _QUEUE = "_RTCRtpReceiver__jitter_buffer", "_RTCRtpReceiver__decoder_queue"


class Viewer:
    """The signalling with one robot, from `__enter__` to `__exit__`. ``role`` is whose rights it has."""

    def __init__(
        self,
        cloud: Cloud,
        robot: str,
        *,
        role: str = VIEWER,
        viewer: str = "",
        on_show: Callable[[Show], None] = lambda _show: None,
    ) -> None:
        self.viewer = viewer or secrets.token_hex(8)
        self._topic, self._on_show = look_topic(robot, cloud.namespace), on_show
        answers = answer_topic(robot, self.viewer, cloud.namespace)
        self._broker = Broker(cloud, Role(cloud, role), filters=[answers], on_message=self._heard)
        self._shows: dict[str, queue.Queue[Show]] = {}
        self.heard: list[Show] = []

    def __enter__(self) -> Self:
        self._broker.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(Exception):  # a cut network has no goodbye
            self.send(END)
        self._broker.__exit__()

    def send(self, kind: str, sdp: str = "", *, request: str = "") -> str:
        """Ask without waiting; returns the request's name."""
        name = request or secrets.token_hex(8)
        self._shows.setdefault(name, queue.Queue())
        self._broker.publish(self._topic, encode_look(Look(self.viewer, name, kind, VIEW_LEASE_MS, sdp)))
        return name

    def publish(self, payload: bytes) -> None:
        """Say anything where viewers ask."""
        self._broker.publish(self._topic, payload)

    def answer(self, request: str, within_s: float = GUARD_S) -> Show:
        """The next answer to a request. Raises `InstrumentError` if none comes."""
        try:
            return self._shows[request].get(timeout=within_s)
        except queue.Empty:
            raise InstrumentError(f"the robot did not answer within {within_s:g} s") from None

    def ask(self, kind: str, sdp: str = "", within_s: float = GUARD_S) -> Show:
        """Ask, and wait for the answer. A message may be lost on its way, so `ASK` is sent again."""
        if kind != ASK:
            return self.answer(self.send(kind, sdp), within_s)

        def asked() -> Show | None:
            with suppress(InstrumentError):
                return self.answer(self.send(kind), 2.0)
            return None

        return until(asked, "the robot's terms", within_s)

    def _heard(self, _topic: str, payload: bytes) -> None:
        try:
            show = decode_show(payload)
        except ContractError as error:
            raise InstrumentError(f"the robot's answer breaks the contract: {error}") from error
        self.heard.append(show)
        self._shows.setdefault(show.request, queue.Queue()).put(show)
        self._on_show(show)


class Prompt(JitterBuffer):
    """Gives a picture once its last packet has come, as browsers do, and begins again with a key picture
    after one that stays incomplete. aiortc's own waits for the first packet of the next picture, and for a
    lost packet until 512 have come after it.

    aiortc takes one picture for each packet, so pictures that have waited behind a hole would stay late for
    good: `behind` gives them."""

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        super().__init__(capacity=512, is_video=True)
        self._now = now
        self._hole_since: float | None = None

    def add(self, packet: Any) -> tuple[bool, JitterFrame | None]:
        plead, frame = super().add(packet)
        if self._hole_since is not None and self._now() - self._hole_since > _HOLE_S:
            self._hole_since = self._now()
            return True, frame
        return plead, frame

    def behind(self) -> Iterator[JitterFrame]:
        """The whole pictures that are next, after one that was given."""
        while self._origin is not None and (frame := self._first()) is not None:
            yield frame

    def _remove_frame(self, sequence_number: int) -> JitterFrame | None:  # noqa: ARG002 - as aiortc calls it
        first = self._first()
        if first is not None:
            return first
        if any(self._packets):
            self._hole_since = self._hole_since or self._now()
            if self._now() - self._hole_since > _HOLE_S:
                return self._skipped()
        return None

    def _first(self) -> JitterFrame | None:
        """Take the next picture, if it is whole."""
        first, number = self._next(0)
        if first is not None:
            self.remove(number)
            self._hole_since = None
        return first

    def _at(self, place: int) -> Any:
        assert self._origin is not None, "set by the first packet"
        return self._packets[(self._origin + place) % self.capacity]

    def _next(self, begin: int) -> tuple[JitterFrame | None, int]:
        """The whole picture from a place on, and the place after it."""
        packets: list[Any] = []
        for i in range(begin, self.capacity):
            packet = self._at(i)
            if packet is None or (packets and packet.timestamp != packets[0].timestamp):
                return None, i
            packets.append(packet)
            if packet.marker:
                data = b"".join(one._data for one in packets)  # noqa: SLF001 - as aiortc's own does
                return JitterFrame(data, packets[0].timestamp), i + 1
        return None, self.capacity

    def _skipped(self) -> JitterFrame | None:
        """The first whole key picture after the hole: VP8's first bit tells it, or H.264's first unit."""
        before: Any = None
        for i in range(self.capacity):
            packet = self._at(i)
            begins = packet is not None and (before is None or before.timestamp != packet.timestamp)
            before = packet
            if not begins:
                continue
            frame, after = self._next(i)
            if frame is not None and _is_key(frame.data):
                self.remove(after)
                self._hole_since = None
                return frame
        return None


class Decoded(queue.Queue[Any]):
    """What the decoder of a receiver gets: with each picture those that wait `behind` it."""

    def __init__(self, buffer: Prompt) -> None:
        super().__init__()
        self._buffer = buffer

    def put(self, item: Any, block: bool = True, timeout: float | None = None) -> None:  # noqa: FBT001, FBT002 - as its base has it
        super().put(item, block, timeout)
        if item is not None:
            # Their RTP timestamps stay as they came: nobody here reads them.
            for frame in self._buffer.behind():
                super().put((item[0], frame), block, timeout)


def _is_key(data: bytes) -> bool:
    if data[:4] == b"\0\0\0\1":
        return data[4] & 0x1F in {5, 7}
    return bool(data) and not data[0] & 1


class Watch:
    """Looks at a robot by WebRTC. ``tell`` gets what happens, as what becomes a line."""

    def __init__(
        self, viewer: Viewer, read: Callable[[Any], int | None], tell: Callable[[dict[str, Any]], None]
    ) -> None:
        self._viewer, self._read, self._tell = viewer, read, tell
        self._marks: dict[int, Mark] = {}
        self.peer = aiortc.RTCPeerConnection(aiortc.RTCConfiguration(iceServers=[]))

    async def run(self, ended: asyncio.Event) -> None:
        """Look until ``ended``."""
        loop = asyncio.get_running_loop()
        transceiver = self.peer.addTransceiver("video", direction="recvonly")
        receiver = transceiver.receiver
        buffer = Prompt()
        setattr(receiver, _BUFFER, buffer)
        setattr(receiver, _QUEUE, Decoded(buffer))
        channel = self.peer.createDataChannel(CHANNEL, ordered=False, maxRetransmits=0)
        channel.on("message", self._mark)
        self.peer.on("connectionstatechange", lambda: self._tell({"state": self.peer.connectionState}))
        await self.peer.setLocalDescription(await self.peer.createOffer())
        sdp = self.peer.localDescription.sdp
        show = await loop.run_in_executor(None, self._viewer.ask, OFFER, sdp)
        if show.kind != ANSWER:
            raise InstrumentError(f"the robot refuses the session: {show.why}")
        await self.peer.setRemoteDescription(aiortc.RTCSessionDescription(show.sdp, "answer"))
        tasks = [
            asyncio.create_task(one) for one in (self._pictures(receiver.track), self._stats(), self._keep())
        ]
        await asyncio.wait([asyncio.create_task(ended.wait()), *tasks], return_when=asyncio.FIRST_COMPLETED)
        failed = [one.exception() for one in tasks if one.done() and not one.cancelled() and one.exception()]
        for task in tasks:
            task.cancel()
        await self.peer.close()
        if failed and failed[0]:
            raise failed[0]

    def _mark(self, message: Any) -> None:
        with suppress(ContractError):  # an answer with the clock
            for mark in decode_marks(message):
                self._marks[mark.number] = mark
                self._marks.pop(mark.number - 1000, None)

    async def _pictures(self, track: Any) -> None:
        while True:
            try:
                picture = await track.recv()
            except MediaStreamError:
                self._tell({"state": "ended"})
                return
            shown_us = time.time_ns() // 1000
            number = self._read(picture)
            mark = self._marks.get(number) if number is not None else None
            self._tell(
                {
                    "shown_us": shown_us,
                    "number": number,
                    "captured_us": mark.captured_us if mark else None,
                    "width": picture.width,
                    "height": picture.height,
                }
            )

    async def _stats(self) -> None:
        while True:
            await asyncio.sleep(1.0)
            report = await self.peer.getStats()
            self._tell(
                {
                    "stats": {
                        key: {name: value for name, value in vars(one).items() if not callable(value)}
                        for key, one in report.items()
                    }
                }
            )

    async def _keep(self) -> None:
        while True:
            await asyncio.sleep(VIEW_RENEW_S)
            self._viewer.send(KEEP)


def _line(content: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(content, default=str) + "\n")
    sys.stdout.flush()


def main(read: Callable[[Any], int | None]) -> None:
    """Look at ``--robot`` of the cloud that ``--embedded`` describes, until the input ends."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--embedded", type=Path, required=True)
    parser.add_argument("--robot", required=True)
    options = parser.parse_args()
    cloud = Cloud.load(options.embedded)

    def told(show: Show) -> None:
        _line({"show": show.kind, "why": show.why})

    async def look(viewer: Viewer) -> None:
        loop, ended = asyncio.get_running_loop(), asyncio.Event()

        def until_end() -> None:
            sys.stdin.read()
            loop.call_soon_threadsafe(ended.set)

        threading.Thread(target=until_end, daemon=True).start()
        await Watch(viewer, read, _line).run(ended)

    with ExitStack() as stack:
        viewer = stack.enter_context(Viewer(cloud, options.robot, on_show=told))
        viewer.ask(ASK)
        asyncio.run(look(viewer))
