"""The look into aiortc: this version has what it looks for, and without it the session goes on."""

from __future__ import annotations

import asyncio
import logging
from types import SimpleNamespace
from typing import Any

import pytest
from aiortc import RTCPeerConnection, RTCRtpSender
from aiortc.rtcsctptransport import RTCSctpTransport
from aiortc.rtp import RtcpPsfbPacket, RtcpReceiverInfo, RtcpRrPacket, RtcpRtpfbPacket, pack_remb_fci

from iort_agent.video import tap
from iort_agent.video.tap import Tap, gather, hurry


class Heard:
    """What a tap has told."""

    def __init__(self, sender: Any) -> None:
        self.reports = self.keys = 0
        self.tap = Tap(sender, on_report=self._report, on_key=self._key)

    def _report(self) -> None:
        self.reports += 1

    def _key(self) -> None:
        self.keys += 1


@pytest.fixture(autouse=True)
def told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tap, "_told", set())


async def sender() -> tuple[RTCPeerConnection, RTCRtpSender]:
    peer = RTCPeerConnection()
    return peer, peer.addTransceiver("video", direction="sendonly").sender


def report(ssrc: int, fraction_lost: int) -> RtcpRrPacket:
    info = RtcpReceiverInfo(
        ssrc=ssrc, fraction_lost=fraction_lost, packets_lost=0, highest_sequence=0, jitter=0, lsr=0, dlsr=0
    )
    return RtcpRrPacket(ssrc=1, reports=[info])


def test_it_hears_what_this_versions_sender_is_told() -> None:
    async def run() -> None:
        peer, one = await sender()
        heard = Heard(one)
        await one._handle_rtcp_packet(report(one._ssrc, 64))
        assert heard.tap.lost == 0.25
        await one._handle_rtcp_packet(report(one._ssrc + 1, 128))
        assert heard.tap.lost is None
        remb = pack_remb_fci(123_000, [one._ssrc])
        await one._handle_rtcp_packet(RtcpPsfbPacket(fmt=15, ssrc=1, media_ssrc=0, fci=remb))
        assert heard.tap.bitrate_bps == pytest.approx(123_000, rel=0.01)
        assert (heard.reports, heard.keys) == (3, 0)
        for fmt in (1, 4):
            await one._handle_rtcp_packet(RtcpPsfbPacket(fmt=fmt, ssrc=1, media_ssrc=one._ssrc, fci=b""))
        assert heard.keys == 2
        # A few lost packets are repeated; a gap of hundreds cannot be.
        for lost, keys in ((2, 2), (100, 3)):
            missing = RtcpRtpfbPacket(fmt=1, ssrc=1, media_ssrc=one._ssrc, lost=list(range(lost)))
            await one._handle_rtcp_packet(missing)
            assert heard.keys == keys
        await peer.close()

    asyncio.run(run())


@pytest.mark.parametrize("fci", [b"", b"REMB", b"REMB\xff\x00\x00\x00", b"x" * 40])
def test_a_report_that_cannot_be_read_changes_nothing(fci: bytes) -> None:
    async def run() -> None:
        peer, one = await sender()
        heard = Heard(one)
        heard.tap._note(RtcpPsfbPacket(fmt=15, ssrc=1, media_ssrc=0, fci=fci))
        assert heard.tap.bitrate_bps is None
        await peer.close()

    asyncio.run(run())


def test_a_picture_has_the_timestamp_that_was_sent() -> None:
    async def run() -> None:
        peer, one = await sender()
        heard = Heard(one)
        # The name is this version's: `test_video` compares the timestamps with those that a viewer gets.
        one._RTCRtpSender__rtp_timestamp = 5  # type: ignore[attr-defined]  # as above
        assert heard.tap.origin(2) == 3
        assert heard.tap.origin(6) == 2**32 - 1
        await peer.close()

    asyncio.run(run())


def test_another_version_costs_what_is_missing_and_is_told_once(caplog: pytest.LogCaptureFixture) -> None:
    heard = Heard(SimpleNamespace())
    assert heard.tap.origin(1) is None
    assert heard.tap.origin(2) is None
    hurry(SimpleNamespace(sctp=SimpleNamespace()))  # type: ignore[arg-type]  # a part of a peer
    errors = [record.getMessage() for record in caplog.records if record.levelno == logging.ERROR]
    assert len(errors) == 3
    assert all("pip install 'iort-agent[video]'" in error for error in errors)


def test_a_lost_message_blocks_the_next_for_a_second_at_most() -> None:
    async def run() -> None:
        peer, _ = await sender()
        hurry(peer)
        peer.createDataChannel("frames")
        assert isinstance(peer.sctp, RTCSctpTransport)
        peer.sctp._rto = 60.0
        hurry(peer)
        assert peer.sctp._rto == 1.0
        await peer.close()

    asyncio.run(run())


def test_a_machine_without_a_network_has_the_loopback_address(
    socket_enabled: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    import aioice.ice

    # The library's own look at the machine, of one without a network.
    monkeypatch.setattr(aioice.ice, "get_host_addresses", lambda **_: [])

    async def run() -> None:
        peer, one = await sender()
        await gather(peer)
        gatherer = one.transport.transport.iceGatherer
        assert [candidate.ip for candidate in gatherer.getLocalCandidates()] == ["127.0.0.1"]
        await peer.close()

    asyncio.run(run())
