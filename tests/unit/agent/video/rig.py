"""A robot's video over a broker in memory, with a camera that draws its pictures' numbers, and viewers that
decode them by aiortc."""

from __future__ import annotations

import asyncio
import itertools
import threading
from collections.abc import Callable, Coroutine
from dataclasses import replace
from typing import Any, TypeVar

import av
from aiortc import RTCConfiguration, RTCPeerConnection, RTCSessionDescription
from aiortc.mediastreams import MediaStreamError

from iort_agent.common.threads import Clock, SystemClock
from iort_agent.mqtt.dispatch import Dispatcher
from iort_agent.mqtt.uplink import MqttMessage
from iort_agent.video import Frame, Pictures
from iort_agent.video.config import SimCamera, VideoConfig
from iort_agent.video.encoder import Encoder, make_encoder
from iort_agent.video.video import Video
from iort_contract.counter import COLUMNS, HEIGHTS, ROWS, counter_bits, read_counter
from iort_contract.limits import Value
from iort_contract.messages.video import (
    ANSWER,
    CHANNEL,
    KEEP,
    OFFER,
    Look,
    Mark,
    Show,
    answer_topic,
    decode_clock,
    decode_marks,
    decode_show,
    encode_ask_clock,
    encode_look,
    look_topic,
    picture_topic,
)
from testkit.agent import Loopback, link_of
from testkit.waiting import GUARD_S, until

T = TypeVar("T")
WIDTH, HEIGHT, RATE_HZ = 240, 192, 30.0
CONFIG = VideoConfig(SimCamera(), width=WIDTH, height=HEIGHT, rate_hz=RATE_HZ)
_names = itertools.count()


def drawn(number: int) -> av.VideoFrame:
    """A grey picture with its number."""
    picture = av.VideoFrame(WIDTH, HEIGHT, "yuv420p")
    luma = bytearray([90]) * (picture.planes[0].line_size * HEIGHT)
    step, size = picture.planes[0].line_size, (WIDTH // COLUMNS, HEIGHT // HEIGHTS)
    for i, bit in enumerate(counter_bits(number)):
        row, column = divmod(i, COLUMNS)
        top = HEIGHT - (ROWS - row) * size[1]
        for y in range(top, top + size[1]):
            at = y * step + column * size[0]
            luma[at : at + size[0]] = bytes([235 if bit else 16]) * size[0]
    picture.planes[0].update(bytes(luma))
    for plane in picture.planes[1:]:
        plane.update(bytes([128]) * plane.buffer_size)
    return picture


def instant(clock: Clock) -> tuple[int, float]:
    """A time by both clocks, in microseconds and in seconds: read again if anything came between."""
    while True:
        before_us, now = clock.now_us(), clock.monotonic()
        if clock.now_us() - before_us < 1000:
            return before_us, now


class Counter:
    """A camera whose pictures have their numbers. It waits for real, even if the clock stands still."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self.opened = self.closed = 0
        self.error: Exception | None = None
        # Raised by one read alone.
        self.once: Exception | None = None
        # Cleared: the camera hangs.
        self.sees = threading.Event()
        self.sees.set()

    def open(self) -> None:
        self.opened += 1
        if self.error is not None:
            raise self.error

    def read(self, number: int, stop: threading.Event) -> Frame | None:
        if stop.wait(1 / RATE_HZ):
            return None
        while not self.sees.wait(0.02):
            if stop.is_set():
                return None
        if self.error is not None:
            raise self.error
        once, self.once = self.once, None
        if once is not None:
            raise once
        return Frame(number, *instant(self._clock), drawn(number))

    def report(self) -> dict[str, Any]:
        return {}

    def close(self) -> None:
        self.closed += 1


class Looks:
    """What viewers of a robot send and hear."""

    def __init__(self, uplink: Loopback) -> None:
        self.uplink = uplink
        self.shows: dict[str, list[Show]] = {}
        self.over_broker: list[bytes] = []
        topic = picture_topic("car1", "iort")
        uplink.subscribe(topic, lambda message: self.over_broker.append(message.payload))

    def name(self) -> str:
        """A new viewer's name, whose answers are heard."""
        viewer = f"{next(_names):08x}"
        shows = self.shows[viewer] = []

        def hear(message: MqttMessage) -> None:
            shows.append(decode_show(message.payload))

        self.uplink.subscribe(answer_topic("car1", viewer, "iort"), hear)
        return viewer

    def look(self, viewer: str, kind: str, **rest: Any) -> str:
        """Send a viewer's request; its id."""
        request = f"{next(_names):08x}"
        self.send(encode_look(Look(viewer, request, kind, **rest)))
        return request

    def send(self, payload: bytes) -> None:
        """Send whatever it is as a request."""
        self.uplink.deliver(look_topic("car1", "iort"), payload)

    def answer(self, viewer: str, request: str) -> Show:
        """The robot's answer to a request."""
        return until(lambda: next((s for s in self.shows[viewer] if s.request == request), None), "an answer")

    def ask(self, viewer: str, kind: str, **rest: Any) -> Show:
        """Send a request and return its answer."""
        return self.answer(viewer, self.look(viewer, kind, **rest))


class Rig(Looks):
    """A robot with video; ``settings`` are those of car.yaml's section."""

    def __init__(
        self,
        *,
        clock: Clock | None = None,
        encoder: Callable[[VideoConfig], Encoder] = make_encoder,
        **settings: Any,
    ) -> None:
        self.clock = clock or SystemClock()
        super().__init__(Loopback(self.clock, Dispatcher()))
        self.link = link_of(self.uplink, self.clock)
        self.camera, self.pictures = Counter(self.clock), Pictures()
        self.samples: list[tuple[int, dict[str, Value]]] = []
        self.kept: list[int] = []
        self.video = Video(
            replace(CONFIG, **settings),
            self.link,
            self.pictures,
            camera=lambda: lambda: self.camera,
            encoder=encoder,
            record=lambda _, t_us, values: self.samples.append((t_us, dict(values))),
            keep=lambda frame: self.kept.append(frame.number),
        )

    def start(self) -> None:
        """Begin; `close` ends it."""
        self.uplink.start()
        self.video.start()

    def close(self) -> None:
        """End."""
        self.video.close()
        self.uplink.stop(1.0)


class Loop:
    """An asyncio loop in a thread, for viewers. At its end they vanish."""

    def __init__(self) -> None:
        self.peers: list[RTCPeerConnection] = []
        self.loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self.loop.run_forever, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End."""
        for peer in self.peers:
            self.do(peer.close())
        self.do(self._end())
        self.loop.call_soon_threadsafe(self.loop.stop)
        self._thread.join()
        self.loop.close()

    async def _end(self) -> None:
        """aiortc 1.9 leaves who waits for a picture waiting."""
        tasks = asyncio.all_tasks() - {asyncio.current_task()}
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    def do(self, work: Coroutine[Any, Any, T]) -> T:
        """Run a coroutine there, and return its result."""
        return asyncio.run_coroutine_threadsafe(work, self.loop).result(GUARD_S)


class Seen:
    """A decoded picture: the number that is drawn in it, and its RTP timestamp from the first on."""

    def __init__(self, number: int | None, rtp: int) -> None:
        self.number, self.rtp = number, rtp


class Viewer:
    """A viewer by aiortc. ``seen`` are its decoded pictures, ``marks`` what it was told of them."""

    def __init__(self, rig: Looks, loop: Loop, channel: str = CHANNEL) -> None:
        self._rig, self._loop, self.name = rig, loop, rig.name()
        self.seen: list[Seen] = []
        self.marks: dict[int, Mark] = {}
        self.clocks: list[tuple[int, int]] = []
        self.peer, self.channel, self.sdp = loop.do(self._offer(channel))

    async def _offer(self, label: str) -> tuple[Any, Any, str]:
        peer = RTCPeerConnection(RTCConfiguration([]))
        self._loop.peers.append(peer)
        peer.addTransceiver("video", direction="recvonly")
        channel = peer.createDataChannel(label, ordered=False, maxRetransmits=0)
        channel.on("message", self._on_message)
        peer.on("track", lambda track: asyncio.ensure_future(self._watch(track)))
        await peer.setLocalDescription(await peer.createOffer())
        return peer, channel, peer.localDescription.sdp

    def _on_message(self, message: bytes) -> None:
        if len(message) == 13:
            self.clocks.append(decode_clock(message))
            return
        for mark in decode_marks(message):
            self.marks[mark.rtp] = mark

    async def _watch(self, track: Any) -> None:
        while True:
            try:
                frame = await track.recv()
            except MediaStreamError:
                return
            plane = frame.planes[0]
            luma, step = bytes(plane), plane.line_size
            number = read_counter(lambda x, y: luma[y * step + x], frame.width, frame.height)  # noqa: B023 - called at once
            self.seen.append(Seen(number, frame.pts))

    def connect(self, **rest: Any) -> Viewer:
        """Offer, and take the answer."""
        show = self._rig.ask(self.name, OFFER, sdp=self.sdp, **rest)
        assert show.kind == ANSWER, show
        self._loop.do(self.peer.setRemoteDescription(RTCSessionDescription(show.sdp, "answer")))
        return self

    def keep(self) -> None:
        """Renew the lease."""
        self._rig.look(self.name, KEEP)

    def ask_clock(self, number: int) -> None:
        """Ask for the robot's clock."""
        self.send(encode_ask_clock(number))

    def send(self, message: bytes | str) -> None:
        """Send whatever it is on the data channel, which may open after the first picture."""
        until(lambda: self.channel.readyState != "connecting", "the channel")
        self._loop.loop.call_soon_threadsafe(self.channel.send, message)

    def sees(self, count: int = 1) -> list[Seen]:
        """Wait for so many more pictures; they."""
        before = len(self.seen)
        until(lambda: len(self.seen) >= before + count, f"{count} pictures")
        return self.seen[before:]

    def close(self) -> None:
        """Vanish, without a word to the robot."""
        self._loop.do(self.peer.close())
