"""Who looks: viewers' requests over the broker, their leases, and the answers.

```
  look ── arrive ──► bounded inbox ── the loop of the thread `video` ──► sessions, watchers
   (the connection's thread)            │
                                        ▼
                                     answers
```

A viewer has a session by WebRTC, or pictures over the broker; pictures until its session has connected, and
again if it asks for them. What it has ends with its lease, which counts from the arrival of its last message.
A flood of requests costs bounded work: what is too much is dropped before it is read."""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Awaitable, Callable, Mapping, NamedTuple, Protocol, Sequence

from iort_agent.common.logs import ThrottledLog
from iort_agent.errors import VideoError
from iort_agent.mqtt.rate_limiter import URGENT
from iort_agent.mqtt.uplink import Link, MqttMessage
from iort_agent.video.offers import bounded, of_deployment
from iort_agent.video.rate import Rate
from iort_contract.limits import ContractError
from iort_contract.messages.video import (
    ANSWER,
    ASK,
    END,
    ENDED,
    KEEP,
    MAX_LOOK_BYTES,
    MAX_VIDEO_VIEWERS,
    OFFER,
    PICTURES,
    REFUSED,
    TERMS,
    IceServer,
    Look,
    Show,
    VideoTerms,
    answer_topic,
    decode_look,
    encode_show,
)

_log = logging.getLogger(__name__)

# Whoever has not connected then will not. Gathering candidates asks servers, which may be out of reach.
CONNECT_S, GATHER_S = 15.0, 4.0
SWEEP_S = 0.5
# Watchers cost the robot one message for all, and a few bytes each.
MAX_WATCHERS = 128
# Requests and answers in a second; an offer is long, and all others are short.
SHORT_BYTES, SHORT_PER_S, OFFERS_PER_S, ANSWERS_PER_S = 2048, 50.0, 4.0, 20.0
# Requests that wait for the thread, and offers that are remembered so that nobody repeats them.
_INBOX, _REMEMBERED = 64, 512


class Session(Protocol):
    """A viewer's WebRTC session; `iort_agent.video.sessions.Session` is the real one."""

    connected: bool
    rate: Rate

    def answer(self, sdp: str) -> Awaitable[str]: ...
    def show(self, picture: Any) -> None: ...
    def missed(self) -> None: ...
    def close(self) -> Awaitable[None]: ...


# Makes a session for ICE servers; it calls with the reason if the session ends by itself.
Make = Callable[[Sequence[IceServer], Callable[[str], object]], Session]


class Demand(NamedTuple):
    """How many viewers have a session, and how many watch pictures over the broker."""

    viewers: int = 0
    watchers: int = 0


@dataclass
class _Viewer:
    until: float
    request: str
    session: Session | None = None
    connect_by: float = 0.0
    pictures: bool = False
    answering: asyncio.Task[None] | None = None


@dataclass
class _Bucket:
    """So many a second, and as many at once."""

    per_s: float
    at: float = 0.0
    left: float = field(init=False)

    def __post_init__(self) -> None:
        self.left = self.per_s

    def take(self, now: float) -> bool:
        self.left, self.at = min(self.per_s, self.left + (now - self.at) * self.per_s), now
        if self.left < 1:
            return False
        self.left -= 1
        return True


class Signalling:
    """Made once. `arrive`, `wake` and `post` may be called from any thread, all else in the loop of `run`.

    ``why_not`` says why nothing can be shown now, or is empty; ``make`` makes sessions; ``own`` are the
    servers of car.yaml; ``on_demand`` is told who looks, after every change.
    """

    def __init__(
        self,
        link: Link,
        *,
        terms: VideoTerms,
        own: Sequence[IceServer],
        why_not: Callable[[], str],
        make: Make,
        on_demand: Callable[[Demand], object],
    ) -> None:
        self._link, self._clock = link, link.clock
        self._terms, self._own = terms, tuple(own)
        self._why_not, self._make, self._on_demand = why_not, make, on_demand
        self._throttled = ThrottledLog(_log, link.clock)
        now = link.clock.monotonic()
        self._short, self._long = _Bucket(SHORT_PER_S, now), _Bucket(OFFERS_PER_S, now)
        self._answers = _Bucket(ANSWERS_PER_S, now)
        self._inbox: deque[MqttMessage] = deque()
        self._viewers: dict[str, _Viewer] = {}
        self._offers: deque[tuple[str, str]] = deque(maxlen=_REMEMBERED)
        self._closing: set[asyncio.Future[Any]] = set()
        self._told = Demand()
        # What a posted call raised.
        self._failure: Exception | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._woken: asyncio.Event | None = None
        # Requests that were dropped, malformed, or refused.
        self.dropped = self.malformed = self.refused = 0

    @property
    def demand(self) -> Demand:
        """Who looks, as `on_demand` was told."""
        return self._told

    def sessions(self) -> list[Session]:
        """The sessions that there are."""
        return [viewer.session for viewer in self._viewers.values() if viewer.session is not None]

    def arrive(self, message: MqttMessage) -> None:
        """Take a viewer's request; returns at once."""
        size, now = len(message.payload), self._clock.monotonic()
        if size > MAX_LOOK_BYTES:
            self.malformed += 1
            self._throttled.warn("size", f"video: a request of {size} bytes is rejected unread")
            return
        bucket = self._short if size <= SHORT_BYTES else self._long
        if len(self._inbox) >= _INBOX or not bucket.take(now):
            self.dropped += 1
            self._throttled.warn("many", "video: requests are dropped: there are too many")
            return
        self._inbox.append(message)
        self.wake()

    def wake(self) -> None:
        """Let `run` look at what has changed."""
        woken = self._woken
        if woken is not None:
            self.post(woken.set)

    def post(self, call: Callable[[], object]) -> None:
        """Let the loop call a function, if it runs; what that raises, `run` raises."""
        loop = self._loop
        if loop is not None:
            # It may end in this moment.
            with suppress(RuntimeError):
                loop.call_soon_threadsafe(self._call, call)

    def _call(self, call: Callable[[], object]) -> None:
        try:
            call()
        except Exception as error:  # noqa: BLE001 - asyncio would log it, and go on
            self._failure = error
            if self._woken is not None:
                self._woken.set()

    async def run(self, stopped: Callable[[], bool]) -> None:
        """Answer until ``stopped``, which is looked at after `wake`. At its end every session is closed."""
        self._failure = None
        self._loop, self._woken = asyncio.get_event_loop(), asyncio.Event()
        self._loop.set_exception_handler(self._on_stray)
        try:
            while not stopped():
                if self._failure is not None:
                    raise self._failure
                while self._inbox:
                    self._take(self._inbox.popleft())
                self.sweep()
                try:
                    await asyncio.wait_for(self._woken.wait(), SWEEP_S if self._viewers else None)
                except asyncio.TimeoutError:
                    continue
                self._woken.clear()
        finally:
            self._loop = self._woken = None
            for viewer in list(self._viewers):
                self._end(viewer, "the agent's video ends")
            self._tell()
            if self._closing:
                await asyncio.wait(set(self._closing))

    def _on_stray(self, _: asyncio.AbstractEventLoop, context: Mapping[str, Any]) -> None:
        # Of WebRTC: a session that fails so is closed by its lease at the latest.
        self._throttled.warn("stray", f"video: {context['message']}: {context.get('exception')!r}")

    def end_all(self, why: str) -> None:
        """End what every viewer has."""
        for viewer in list(self._viewers):
            self._end(viewer, why)
        self._tell()

    def sweep(self) -> None:
        """End what is over; called twice a second."""
        now = self._clock.monotonic()
        for name, viewer in list(self._viewers.items()):
            session = viewer.session
            if now >= viewer.until:
                self._end(name, "the viewer did not renew it")
            elif session is not None and session.connected:
                viewer.pictures = False
            elif session is not None and now >= viewer.connect_by:
                self._end_session(name, f"no connection came about within {CONNECT_S:g} s")
        self._tell()

    def _take(self, message: MqttMessage) -> None:
        try:
            look = decode_look(message.payload)
        except ContractError as error:
            self.malformed += 1
            self._throttled.warn("malformed", f"video: a request is rejected: {error}")
            return
        try:
            self._follow(look, message.at + look.lease_ms / 1000)
        except Exception as error:  # noqa: BLE001 - one viewer's request must not end the others' sessions
            _log.exception("video: a request of a viewer failed")
            self._refuse(look, f"the robot failed: {type(error).__name__}")
        self._tell()

    def _follow(self, look: Look, until: float) -> None:
        viewer = self._viewers.get(look.viewer)
        if look.kind == END or until <= self._clock.monotonic():
            self._end(look.viewer, "")
        elif look.kind == KEEP:
            if viewer is None:
                self._answer(look.viewer, Show(look.request, ENDED, why="it was over already"))
            else:
                viewer.until, viewer.request = until, look.request
        else:
            why = self._why_not() or self._full(look, viewer)
            if why:
                self._refuse(look, why)
            elif look.kind == ASK:
                self._tell_terms(look)
            elif look.kind == PICTURES:
                self._end_session(look.viewer, "")
                self._viewers[look.viewer] = _Viewer(until, look.request, pictures=True)
                self._tell_terms(look)
            elif (look.viewer, look.request) in self._offers:
                self._throttled.warn("again", "video: an offer came twice; the second one is ignored")
            else:
                self._offers.append((look.viewer, look.request))
                self._on_offer(look, until)

    def _full(self, look: Look, viewer: _Viewer | None) -> str:
        """Why one more viewer is too many."""
        watchers = sum(one.pictures for one in self._viewers.values())
        if look.kind == PICTURES and watchers >= MAX_WATCHERS and (viewer is None or not viewer.pictures):
            return f"{MAX_WATCHERS} viewers watch already"
        others = sum(one.session is not None for one in self._viewers.values() if one is not viewer)
        if look.kind == OFFER and others >= MAX_VIDEO_VIEWERS:
            return f"{MAX_VIDEO_VIEWERS} viewers have a session already; watch pictures over the broker"
        return ""

    def _on_offer(self, look: Look, until: float) -> None:
        try:
            sdp = bounded(look.sdp)
        except ContractError as error:
            self._refuse(look, str(error))
            return
        self._end_session(look.viewer, "")
        viewer = self._viewers.setdefault(look.viewer, _Viewer(until, look.request))
        viewer.until, viewer.request = until, look.request
        viewer.connect_by = self._clock.monotonic() + CONNECT_S
        servers = (*self._own, *of_deployment(look.ice_servers))
        # At once, so that it counts.
        viewer.session = self._made(look, servers)
        viewer.answering = asyncio.ensure_future(self._begin(look, viewer, viewer.session, sdp, servers))

    def _made(self, look: Look, servers: Sequence[IceServer]) -> Session:
        sessions: list[Session] = []

        def ended(why: str) -> None:
            viewer = self._viewers.get(look.viewer)
            if viewer is not None and sessions and viewer.session is sessions[0]:
                self._end_session(look.viewer, why)
                self._tell()

        sessions.append(self._make(servers, ended))
        return sessions[0]

    async def _begin(
        self, look: Look, viewer: _Viewer, session: Session, sdp: str, servers: Sequence[IceServer]
    ) -> None:
        """Answer an offer; without the servers if they are out of reach."""
        why = ""
        for attempt in (servers, ()) if servers else ((),):
            if attempt is not servers and servers:
                self._close(session)
                session = viewer.session = self._made(look, ())
            try:
                answer = await asyncio.wait_for(session.answer(sdp), GATHER_S)
            except VideoError as error:
                why = str(error)
            except asyncio.TimeoutError:
                why = "the robot found no address in time"
            else:
                self._answer(look.viewer, Show(look.request, ANSWER, sdp=answer))
                return
        self._refuse(look, why)
        # It must not cancel itself.
        viewer.answering = None
        self._end_session(look.viewer, "")
        self._tell()

    def _end_session(self, name: str, why: str) -> None:
        viewer = self._viewers.get(name)
        if viewer is None or viewer.session is None:
            return
        session, viewer.session = viewer.session, None
        if viewer.answering is not None:
            viewer.answering.cancel()
            viewer.answering = None
        self._close(session)
        if why:
            self._answer(name, Show(viewer.request, ENDED, why=why))
        if not viewer.pictures:
            del self._viewers[name]

    def _end(self, name: str, why: str) -> None:
        viewer = self._viewers.get(name)
        if viewer is None:
            return
        self._end_session(name, "")
        self._viewers.pop(name, None)
        if why:
            self._answer(name, Show(viewer.request, ENDED, why=why))

    def _close(self, session: Session) -> None:
        closing = asyncio.ensure_future(session.close())
        self._closing.add(closing)
        closing.add_done_callback(partial(_closed, self._closing))

    def _tell(self) -> None:
        demand = Demand(
            sum(viewer.session is not None for viewer in self._viewers.values()),
            sum(viewer.pictures for viewer in self._viewers.values()),
        )
        if demand != self._told:
            self._told = demand
            self._on_demand(demand)

    def _tell_terms(self, look: Look) -> None:
        self._answer(look.viewer, Show(look.request, TERMS, terms=self._terms, ice_servers=self._own))

    def _refuse(self, look: Look, why: str) -> None:
        self.refused += 1
        self._throttled.warn("refused", f"video: a viewer is refused: {why}")
        self._answer(look.viewer, Show(look.request, REFUSED, why=why))

    def _answer(self, viewer: str, show: Show) -> None:
        topic = answer_topic(self._link.robot, viewer, self._link.namespace)
        payload = encode_show(show)
        now, limiter = self._clock.monotonic(), self._link.rate_limiter
        if self._answers.take(now) and limiter.may_go(URGENT, topic, len(payload)):
            self._link.publish(topic, payload, qos=0)
        else:
            self._throttled.warn("answers", "video: viewers are not answered: there are too many requests")


def _closed(closing: set[asyncio.Future[Any]], future: asyncio.Future[Any]) -> None:
    closing.discard(future)
    if not future.cancelled() and future.exception() is not None:
        _log.warning("video: a session did not close well: %r", future.exception())
