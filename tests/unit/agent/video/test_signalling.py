"""Who may look, for how long, and what it costs the robot if somebody asks too much."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import Any, Callable, Coroutine

import pytest

from iort_agent.errors import VideoError
from iort_agent.mqtt.dispatch import Dispatcher
from iort_agent.mqtt.uplink import MqttMessage
from iort_agent.video import signalling as module
from iort_agent.video.offers import MAX_LINES
from iort_agent.video.rate import Rate
from iort_agent.video.signalling import (
    ANSWERS_PER_S,
    CONNECT_S,
    MAX_WATCHERS,
    OFFERS_PER_S,
    SHORT_PER_S,
    Demand,
    Signalling,
)
from iort_contract.messages.live import VIEW_LEASE_MS
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
    decode_show,
    encode_look,
    look_topic,
)
from testkit.agent import Loopback, ManualClock, link_of

SDP = "v=0\r\nm=video 9 UDP/TLS/RTP/SAVPF 96\r\n"
OWN = IceServer(("turn:turn.example.com",), "robot", "secret")
KINESIS = IceServer(("stun:stun.kinesisvideo.eu-west-1.amazonaws.com:443",))
FOREIGN = IceServer(("turn:evil.example.com",), "a", "b")


class FakeSession:
    """A session that answers at once, or not at all."""

    def __init__(self, servers: Sequence[IceServer], on_end: Callable[[str], object]) -> None:
        self.servers, self.end = tuple(servers), on_end
        self.connected, self.closed = False, 0
        self.rate = Rate(1, 1, 1)
        self.why = ""
        self.hangs = False

    async def answer(self, sdp: str) -> str:
        if self.hangs:
            await asyncio.Event().wait()
        if self.why:
            raise VideoError(self.why)
        return f"answer to {len(sdp)}"

    def show(self, picture: Any) -> None: ...
    def missed(self) -> None: ...

    async def close(self) -> None:
        self.closed += 1


class Rig:
    """Signalling whose clock stands still, and a broker in memory."""

    def __init__(self) -> None:
        self.clock, self.dispatcher = ManualClock(), Dispatcher()
        self.uplink = Loopback(self.clock, self.dispatcher)
        self.uplink.connect()
        self.sessions: list[FakeSession] = []
        self.demands: list[Demand] = []
        self.why, self.prepare = "", lambda session: None
        self.stopped, self._numbers = False, iter(range(10**6))
        self.signalling = Signalling(
            link_of(self.uplink, self.clock),
            terms=VideoTerms(640, 480, 15),
            own=[OWN],
            why_not=lambda: self.why,
            make=self._make,
            on_demand=self.demands.append,
        )

    def _make(self, servers: Sequence[IceServer], on_end: Callable[[str], object]) -> FakeSession:
        session = FakeSession(servers, on_end)
        self.prepare(session)
        self.sessions.append(session)
        return session

    def send(self, payload: bytes) -> None:
        self.signalling.arrive(MqttMessage(look_topic("car1", "iort"), payload, self.clock.monotonic()))

    async def look(self, viewer: int, kind: str, *, request: str = "", **rest: Any) -> list[Show]:
        """Send a request; what the robot says to it."""
        request = request or f"{next(self._numbers):08x}"
        before = len(self.uplink.published)
        if kind == OFFER:
            rest.setdefault("sdp", SDP)
        self.send(encode_look(Look(f"{viewer:08x}", request, kind, **rest)))
        await self.settle()
        shows = [decode_show(one.payload) for one in self.uplink.published[before:]]
        return [show for show in shows if show.request == request]

    def told(self) -> list[Show]:
        return [decode_show(one.payload) for one in self.uplink.published]

    async def settle(self) -> None:
        for _ in range(20):
            await asyncio.sleep(0)

    def pass_s(self, seconds: float) -> None:
        self.clock.advance(seconds)
        self.signalling.sweep()


Test = Callable[[Rig], Coroutine[Any, Any, None]]


def scenario(test: Test) -> Callable[[], None]:
    """A test within the loop of the signalling. At its end every session is closed, once."""

    def run() -> None:
        async def whole() -> None:
            rig = Rig()
            task = asyncio.ensure_future(rig.signalling.run(lambda: rig.stopped))
            await rig.settle()
            await test(rig)
            rig.stopped = True
            rig.signalling.wake()
            await asyncio.wait_for(task, 60)
            assert {session.closed for session in rig.sessions} <= {1}
            assert rig.signalling.demand == Demand()

        asyncio.run(whole())

    run.__name__, run.__doc__ = test.__name__, test.__doc__
    return run


@scenario
async def test_a_viewer_learns_what_there_is_and_has_a_session_until_it_ends_it(rig: Rig) -> None:
    (terms,) = await rig.look(1, ASK)
    assert (terms.kind, terms.terms, terms.ice_servers) == (TERMS, VideoTerms(640, 480, 15), (OWN,))
    assert rig.demands == []
    (answer,) = await rig.look(1, OFFER)
    assert (answer.kind, answer.sdp) == (ANSWER, f"answer to {len(SDP)}")
    assert rig.demands == [Demand(viewers=1)]
    await rig.look(1, END)
    assert rig.demands == [Demand(1), Demand()]
    assert rig.sessions[0].closed == 1


@scenario
async def test_a_session_ends_with_its_lease(rig: Rig) -> None:
    await rig.look(1, OFFER)
    rig.sessions[0].connected = True
    for _ in range(3):
        rig.pass_s(VIEW_LEASE_MS / 1000 - 1)
        assert await rig.look(1, KEEP) == []
    rig.pass_s(VIEW_LEASE_MS / 1000 - 0.1)
    assert rig.signalling.demand == Demand(1)
    rig.pass_s(0.1)
    assert rig.signalling.demand == Demand()
    assert (rig.told()[-1].kind, rig.told()[-1].why) == (ENDED, "the viewer did not renew it")
    (late,) = await rig.look(1, KEEP)
    assert (late.kind, late.why) == (ENDED, "it was over already")


@scenario
async def test_a_session_goes_on_without_the_broker_until_its_lease_ends(rig: Rig) -> None:
    await rig.look(1, OFFER)
    rig.sessions[0].connected = True
    rig.uplink.cut()
    rig.pass_s(VIEW_LEASE_MS / 1000 - 0.1)
    assert rig.signalling.sessions() == rig.sessions
    rig.pass_s(0.1)
    await rig.settle()
    assert rig.sessions[0].closed == 1


@scenario
async def test_a_viewer_that_never_connects_is_closed(rig: Rig) -> None:
    await rig.look(1, OFFER)
    rig.clock.advance(CONNECT_S - 1)
    await rig.look(1, KEEP)
    rig.pass_s(0.9)
    assert rig.signalling.demand == Demand(1)
    rig.pass_s(0.1)
    assert rig.told()[-1].why == "no connection came about within 15 s"
    assert rig.signalling.demand == Demand()


@scenario
async def test_a_session_that_fails_is_told_and_closed(rig: Rig) -> None:
    await rig.look(1, OFFER)
    rig.sessions[0].end("the connection failed")
    # aiortc may say so again.
    rig.sessions[0].end("the connection failed")
    assert (rig.told()[-1].kind, rig.told()[-1].why) == (ENDED, "the connection failed")
    assert rig.signalling.demand == Demand()


@scenario
async def test_a_new_offer_replaces_the_session(rig: Rig) -> None:
    await rig.look(1, OFFER)
    (answer,) = await rig.look(1, OFFER)
    assert answer.kind == ANSWER
    assert [session.closed for session in rig.sessions] == [1, 0]
    # The end of the first is none of the second.
    rig.sessions[0].end("the connection failed")
    assert rig.signalling.sessions() == rig.sessions[1:]


@scenario
async def test_an_offer_that_comes_again_changes_nothing(rig: Rig) -> None:
    await rig.look(1, OFFER, request="000000aa")
    assert await rig.look(1, OFFER, request="000000aa") == []
    assert [session.closed for session in rig.sessions] == [0]
    await rig.look(1, END)
    # Also when its session is over.
    assert await rig.look(1, OFFER, request="000000aa") == []
    assert len(rig.sessions) == 1


@scenario
async def test_an_offer_replaces_one_that_is_not_answered_yet(rig: Rig) -> None:
    rig.prepare = lambda session: setattr(session, "hangs", not rig.sessions)
    assert await rig.look(1, OFFER) == []
    (answer,) = await rig.look(1, OFFER)
    assert answer.kind == ANSWER
    assert [session.closed for session in rig.sessions] == [1, 0]


@scenario
async def test_servers_of_other_hosts_are_ignored(rig: Rig) -> None:
    await rig.look(1, OFFER, ice_servers=(FOREIGN, KINESIS))
    assert rig.sessions[0].servers == (OWN, KINESIS)


@scenario
async def test_an_answer_needs_no_server_that_is_out_of_reach(rig: Rig) -> None:
    rig.prepare = lambda session: setattr(session, "why", "no answer" if session.servers else "")
    (answer,) = await rig.look(1, OFFER)
    assert answer.kind == ANSWER
    assert [session.servers for session in rig.sessions] == [(OWN,), ()]
    assert [session.closed for session in rig.sessions] == [1, 0]
    assert rig.signalling.sessions() == rig.sessions[1:]


@scenario
async def test_an_offer_that_cannot_be_answered_is_refused_with_the_reason(rig: Rig) -> None:
    rig.prepare = lambda session: setattr(session, "why", "the offer cannot be answered: no codec")
    (refused,) = await rig.look(1, OFFER)
    assert (refused.kind, refused.why) == (REFUSED, "the offer cannot be answered: no codec")
    assert rig.signalling.demand == Demand()
    assert [session.closed for session in rig.sessions] == [1, 1]


@scenario
async def test_no_offer_beyond_a_browsers_reaches_webrtc(rig: Rig) -> None:
    for sdp in (SDP * 2, "v=0\r\n", SDP + "a=x\r\n" * MAX_LINES):
        (refused,) = await rig.look(1, OFFER, sdp=sdp)
        assert refused.kind == REFUSED
        assert refused.why.startswith("offer must have")
    assert rig.sessions == []


@scenario
async def test_one_viewer_more_than_there_may_be_has_pictures_over_the_broker(rig: Rig) -> None:
    for viewer in range(20):
        shows = await rig.look(viewer, OFFER)
        assert shows[0].kind == (ANSWER if viewer < MAX_VIDEO_VIEWERS else REFUSED)
        # Offers at the pace of people.
        rig.pass_s(0.5)
    assert shows[0].why == "8 viewers have a session already; watch pictures over the broker"
    (terms,) = await rig.look(19, PICTURES)
    assert terms.kind == TERMS
    assert rig.signalling.demand == Demand(MAX_VIDEO_VIEWERS, 1)
    # Each of the eight may offer again.
    (answer,) = await rig.look(7, OFFER)
    assert answer.kind == ANSWER
    await rig.look(0, END)
    (answer,) = await rig.look(19, OFFER)
    assert answer.kind == ANSWER


@scenario
async def test_pictures_go_on_until_the_session_has_connected(rig: Rig) -> None:
    await rig.look(1, PICTURES)
    await rig.look(1, OFFER)
    assert rig.signalling.demand == Demand(1, 1)
    rig.sessions[0].connected = True
    rig.pass_s(0.5)
    assert rig.signalling.demand == Demand(1, 0)
    # Back to pictures: the session is over.
    await rig.look(1, PICTURES)
    assert rig.signalling.demand == Demand(0, 1)
    assert rig.sessions[0].closed == 1


@scenario
async def test_pictures_stay_if_the_session_fails(rig: Rig) -> None:
    await rig.look(1, PICTURES)
    await rig.look(1, OFFER)
    rig.sessions[0].end("no connection came about")
    assert rig.signalling.demand == Demand(0, 1)


@scenario
async def test_watchers_are_bounded(rig: Rig) -> None:
    for viewer in range(MAX_WATCHERS):
        await rig.look(viewer, PICTURES, lease_ms=VIEW_LEASE_MS)
        rig.clock.advance(0.05)
    (refused,) = await rig.look(MAX_WATCHERS, PICTURES)
    assert refused.why == f"{MAX_WATCHERS} viewers watch already"
    (again,) = await rig.look(0, PICTURES)
    assert again.kind == TERMS


@scenario
async def test_a_robot_that_can_show_nothing_says_why(rig: Rig) -> None:
    rig.why = "the robot has not the package for video"
    for kind in (ASK, OFFER, PICTURES):
        (refused,) = await rig.look(1, kind)
        assert (refused.kind, refused.why) == (REFUSED, rig.why)
    assert rig.demands == []


@scenario
async def test_malformed_requests_are_counted_and_harm_nobody(rig: Rig) -> None:
    await rig.look(1, OFFER)
    for payload in (b"", b"{", b"[]", b"x" * MAX_LOOK_BYTES, b"[" * 40_000):
        rig.send(payload)
        rig.clock.advance(0.5)
    await rig.settle()
    assert rig.signalling.malformed == 5
    rig.send(b"x" * 1_000_000)
    assert rig.signalling.malformed == 6
    assert rig.signalling.sessions() == rig.sessions


@scenario
async def test_a_flood_costs_bounded_work_and_answers(rig: Rig) -> None:
    await rig.look(1, OFFER)
    published = len(rig.uplink.published)
    for i in range(1000):
        rig.send(encode_look(Look(f"{i + 2:08x}", "00000000", ASK)))
        await rig.settle()
        rig.clock.advance(0.001)
    # A second's worth at once, and one more for the second that passed.
    assert 1000 - 2 * SHORT_PER_S <= rig.signalling.dropped < 1000
    assert len(rig.uplink.published) - published <= 2 * ANSWERS_PER_S
    # An honest viewer's lease is renewed all the same a moment later.
    rig.clock.advance(1)
    assert await rig.look(1, KEEP) == []
    assert rig.signalling.sessions() == rig.sessions


@scenario
async def test_a_flood_of_offers_makes_few_sessions(rig: Rig) -> None:
    sdp = SDP + "a=x\r\n" * 500
    for i in range(100):
        await rig.look(1, OFFER, sdp=sdp, request=f"{i:08x}")
        rig.clock.advance(0.01)
    assert len(rig.sessions) <= 2 * OFFERS_PER_S


@scenario
async def test_requests_that_come_faster_than_the_thread_takes_them_are_dropped(rig: Rig) -> None:
    for i in range(1000):
        rig.send(encode_look(Look(f"{i:08x}", "00000000", KEEP)))
    assert rig.signalling.dropped >= 1000 - SHORT_PER_S
    await rig.settle()


@scenario
async def test_a_failure_with_one_viewer_is_told_and_leaves_the_others(rig: Rig) -> None:
    await rig.look(1, OFFER)

    def fail(_: FakeSession) -> None:
        raise RuntimeError("out of sockets")

    rig.prepare = fail
    (refused,) = await rig.look(2, OFFER)
    assert (refused.kind, refused.why) == (REFUSED, "the robot failed: RuntimeError")
    assert rig.signalling.sessions() == rig.sessions
    assert rig.signalling.demand == Demand(1)


def test_gathering_has_an_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "GATHER_S", 0.01)

    @scenario
    async def test(rig: Rig) -> None:
        rig.prepare = lambda session: setattr(session, "hangs", True)
        await rig.look(1, OFFER)
        while not rig.told():  # noqa: ASYNC110 - the limit is of real time
            await asyncio.sleep(0.01)
        assert (rig.told()[0].kind, rig.told()[0].why) == (REFUSED, "the robot found no address in time")

    test()
