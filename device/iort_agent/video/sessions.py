"""Viewers' WebRTC sessions, by aiortc. All of it runs in the loop of the thread `video`; importing it loads
aiortc, so only somebody who looks costs that memory.

Each session is given every encoded picture, and has room for one. A session that misses a picture gets none
until the next key picture, because the others build on the missing one. So a slow viewer gets fewer pictures,
not later ones, and nothing is kept for it."""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from contextlib import suppress
from fractions import Fraction
from typing import Any, Callable, Iterable, NamedTuple

import av
from aiortc import (
    RTCConfiguration,
    RTCDataChannel,
    RTCIceServer,
    RTCPeerConnection,
    RTCRtpSender,
    RTCSessionDescription,
)
from aiortc.mediastreams import MediaStreamTrack

from iort_agent.common.threads import Clock
from iort_agent.errors import VideoError
from iort_agent.video import RTP_HZ, Encoded
from iort_agent.video.rate import Rate
from iort_agent.video.tap import Tap, end_checks, gather, hurry, overfull
from iort_contract.limits import ContractError
from iort_contract.messages.video import CHANNEL, MARKS_REPEATED, IceServer, Mark, answer_clock, encode_marks

_log = logging.getLogger(__name__)

CLOSE_S = 5.0
# A viewer reports once or twice a second. One that is not heard for longer is out of reach: it gets nothing.
QUIET_S = 6.0
# One that was not heard for longer than this has missed much: it waits for a key picture.
_BACK_S = 1.5
# What a viewer may send on the data channel in a second, and what is not counted as garbage.
MESSAGES_PER_S, MAX_GARBAGE = 20, 200
# What may wait on the data channel: some eight marks' messages.
_MOST_WAITING_BYTES = 600
_TIME_BASE = Fraction(1, RTP_HZ)
_UINT32 = 0xFFFFFFFF


class Shown(NamedTuple):
    """An encoded picture as each sender gets it."""

    encoded: Encoded
    packet: av.Packet[Any]


def packed(encoded: Encoded) -> Shown:
    """Wrap a picture, once for all viewers."""
    packet = av.Packet(encoded.data)
    packet.pts = encoded.frame.picture.pts
    packet.time_base = _TIME_BASE
    return Shown(encoded, packet)


class _Track(MediaStreamTrack):
    kind = "video"

    def __init__(self, following: Callable[[], Any], failed: Callable[[], object]) -> None:
        super().__init__()
        self._following, self._failed = following, failed

    async def recv(self) -> av.Packet[Any]:
        try:
            packet: av.Packet[Any] = await self._following()
        except Exception:
            # aiortc would end the sender in silence.
            _log.exception("video: a session failed")
            self._failed()
            raise
        return packet


class Session:
    """One viewer. ``codec`` is vp8 or h264. ``on_key`` is called when it needs a key picture, ``on_sent``
    with the milliseconds from a picture's capture until it was sent, ``on_end`` with the reason if it ends by
    itself, perhaps more than once."""

    def __init__(
        self,
        servers: Iterable[IceServer],
        *,
        codec: str,
        clock: Clock,
        rate: Rate,
        on_key: Callable[[], object],
        on_sent: Callable[[float], object],
        on_end: Callable[[str], object],
    ) -> None:
        self.rate = rate
        self._clock, self._on_key, self._on_sent, self._on_end = clock, on_key, on_sent, on_end
        self._peer = RTCPeerConnection(
            # Without a list aiortc asks a server of its own choice.
            RTCConfiguration(
                [
                    RTCIceServer(
                        urls=list(one.urls), username=one.username or None, credential=one.credential or None
                    )
                    for one in servers
                ]
            )
        )
        self._peer.on("connectionstatechange", self._on_state)
        self._peer.on("datachannel", self._on_channel)
        track = _Track(self._following, lambda: on_end("the robot failed"))
        self._transceiver = self._peer.addTransceiver(track, direction="sendonly")
        self._transceiver.setCodecPreferences(
            [
                one
                for one in RTCRtpSender.getCapabilities("video").codecs
                if one.mimeType.lower() in (f"video/{codec}", "video/rtx")
            ]
        )
        self._tap = Tap(self._transceiver.sender, on_report=self._on_report, on_key=on_key)
        self._channel: RTCDataChannel | None = None
        # The picture that waits to be taken, and the one that was taken last.
        self._waits: Shown | None = None
        self._taken: Shown | None = None
        self._came = asyncio.Event()
        self._needs_key, self._begun = True, False
        self._origin: int | None = None
        self._marks: deque[Mark] = deque(maxlen=MARKS_REPEATED)
        self._heard = clock.monotonic()
        # A wall clock that is set meanwhile must not make a picture look younger, or older.
        self._start_us = clock.now_us() - round(self._heard * 1e6)
        self._second, self._in_second = 0, 0
        self.connected = False
        self.sent = self.skipped = self.garbage = 0

    async def answer(self, sdp: str) -> str:
        """The answer to an offer that is `iort_agent.video.offers.bounded`. Raises `VideoError` with what is
        wrong with it."""
        try:
            await self._peer.setRemoteDescription(RTCSessionDescription(sdp, "offer"))
            await gather(self._peer)
            await self._peer.setLocalDescription(await self._peer.createAnswer())
        except Exception as error:
            # A parser's, an assertion's, or that of a server that does not answer.
            raise VideoError(f"the offer cannot be answered: {type(error).__name__}: {error}") from error
        if self._transceiver.currentDirection != "sendonly":
            raise VideoError("the offer does not receive a video")
        return str(self._peer.localDescription.sdp)

    def show(self, picture: Shown) -> None:
        """Send a picture, unless the viewer cannot take it now."""
        if overfull(self._peer):
            self._on_end("messages that never end")
            return
        if not self._begun:
            return
        quiet = self._clock.monotonic() - self._heard > QUIET_S
        if self._waits is not None or quiet:
            self._waits, self._needs_key = None, True
        if quiet or (self._needs_key and not picture.encoded.key):
            self.skipped += 1
            if not quiet:
                self._on_key()
            return
        self._waits, self._needs_key = picture, False
        self._came.set()

    def missed(self) -> None:
        """A picture was encoded and not shown: the next ones build on it."""
        self._needs_key = True

    async def close(self) -> None:
        """End the session, within `CLOSE_S`."""
        self._peer.remove_all_listeners()
        with suppress(asyncio.TimeoutError):
            await asyncio.wait_for(self._peer.close(), CLOSE_S)
        if not self.connected:
            await end_checks(self._peer)

    async def _following(self) -> av.Packet[Any]:
        """The next picture. aiortc asks for it once the one before is sent."""
        if not self._begun:
            self._begun = True
            self._on_key()
        elif self._taken is not None:
            self._note_sent(self._taken)
        while self._waits is None:
            self._came.clear()
            await self._came.wait()
        picture, self._waits = self._waits, None
        self._taken = picture
        if self._origin is not None:
            # Before the picture, so that the viewer knows its age when it is there.
            self._mark(picture)
        return picture.packet

    def _note_sent(self, picture: Shown) -> None:
        self.sent += 1
        self._on_sent((self._clock.monotonic() - picture.encoded.frame.monotonic) * 1000)
        origin = self._tap.origin(picture.packet.pts or 0)
        if origin != self._origin:
            # The first one: now it is known.
            self._origin = origin
            if origin is not None:
                self._mark(picture)

    def _mark(self, picture: Shown) -> None:
        frame = picture.encoded.frame
        rtp = ((self._origin or 0) + (picture.packet.pts or 0)) & _UINT32
        self._marks.append(Mark(frame.number, self._at_us(frame.monotonic), rtp))
        self._send(encode_marks(list(self._marks)))
        hurry(self._peer)

    def _at_us(self, monotonic: float) -> int:
        """A time in the session's clock, which is the robot's of its beginning."""
        return self._start_us + round(monotonic * 1e6)

    def _send(self, message: bytes) -> None:
        channel = self._channel
        if channel is None or channel.readyState != "open":
            return
        # What waits there would be late.
        if channel.bufferedAmount <= _MOST_WAITING_BYTES:
            channel.send(message)

    def _on_channel(self, channel: RTCDataChannel) -> None:
        if channel.label != CHANNEL or self._channel is not None:
            channel.close()
            self._note_garbage()
            return
        self._channel = channel
        channel.on("message", self._on_message)

    def _on_message(self, message: object) -> None:
        now = self._clock.monotonic()
        if int(now) != self._second:
            self._second, self._in_second = int(now), 0
        self._in_second += 1
        if self._in_second <= MESSAGES_PER_S and isinstance(message, bytes):
            with suppress(ContractError):
                self._send(answer_clock(message, self._at_us(now)))
                self._hear(now)
                return
        self._note_garbage()

    def _note_garbage(self) -> None:
        self.garbage += 1
        if self.garbage == MAX_GARBAGE:
            self._on_end("too many messages that are no questions for the clock")

    def _hear(self, now: float) -> None:
        silent_s, self._heard = now - self._heard, now
        if silent_s > _BACK_S:
            self._on_key()

    def _on_report(self) -> None:
        self._hear(self._clock.monotonic())
        if self._tap.lost is not None:
            self.rate.lost(self._tap.lost)
        if self._tap.bitrate_bps is not None:
            self.rate.told(self._tap.bitrate_bps)

    def _on_state(self) -> None:
        state = self._peer.connectionState
        if state == "connected":
            self.connected = True
            self._hear(self._clock.monotonic())
        elif state in ("failed", "closed"):
            self._on_end("the connection failed" if self.connected else "no connection came about")
