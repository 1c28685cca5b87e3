"""The only look into aiortc's private parts.

aiortc's sender encodes each viewer's pictures by itself. Here one encoder serves all, and the sender only
packs its pictures. But then nobody learns what the sender knows, and what has no public name:

- the viewer's reports (RTCP): the bitrate that it can take, its losses, and that it needs a key picture;
- the RTP timestamp of a picture, by which the viewer tells pictures apart;
- how long a lost message of the data channel blocks those behind it, which is up to a minute;
- the loopback address, which is the only one of a machine without a network;
- how much of a viewer's messages waits for the rest of them, which has no bound;
- the checks of a connection that came about while it was closed, which never end.

If another version of aiortc has other names, the log says so once, and the session goes on without what is
missing. Without timestamps a viewer does not know the pictures' ages, and falls back to pictures over the
broker.
"""

from __future__ import annotations

import asyncio
import logging
from typing import Any, Awaitable, Callable

from aiortc import RTCPeerConnection, RTCRtpSender
from aiortc.rtp import RtcpPsfbPacket, RtcpRrPacket, RtcpRtpfbPacket, RtcpSrPacket, unpack_remb_fci

_log = logging.getLogger(__name__)

# Feedback of RFC 4585 and RFC 5104: lost packets; picture loss, full intra request, and the application's
# (REMB).
_NACK, _PLI, _FIR, _APPLICATION = 1, 1, 4, 15
# The sender can repeat its last 128 packets. Who misses so many waits for some that never come.
_GAP = 64
_HANDLE, _STAMP = "_handle_rtcp_packet", "_RTCRtpSender__rtp_timestamp"
_TIMEOUT, _MOST_S = "_rto", 1.0
# A message of the allowed 64 KiB comes in some 60 chunks.
_STREAMS, _MOST_STREAMS, _MOST_CHUNKS = "_inbound_streams", 256, 1000
# aioice looks so often, and more, whether a connection has come about.
_BEGINS_S = 0.1
_UINT32 = 0xFFFFFFFF
_told: set[str] = set()


def _missing(name: str) -> None:
    if name not in _told:
        _told.add(name)
        _log.error(
            "video: this version of aiortc has no %s; viewers may get pictures over the broker only: "
            "install another one (pip install 'iort-agent[video]'), and report it",
            name,
        )


class Tap:
    """Listens at a sender, in its loop. ``on_report`` is called after each report of the viewer, ``on_key``
    when the viewer needs a key picture: it says so, or misses more than can be repeated.

    ``bitrate_bps`` is what the viewer says that it can take; None before it has said so. ``lost`` is the
    share of packets that its newest report misses; None if that has none.
    """

    def __init__(
        self, sender: RTCRtpSender, *, on_report: Callable[[], object], on_key: Callable[[], object]
    ) -> None:
        self._sender, self._on_report, self._on_key = sender, on_report, on_key
        self.bitrate_bps: int | None = None
        self.lost: float | None = None
        handle: Callable[[Any], Awaitable[None]] | None = getattr(sender, _HANDLE, None)
        if handle is None:
            _missing(_HANDLE)
            return

        async def listen(packet: Any) -> None:
            self._note(packet)
            await handle(packet)

        setattr(sender, _HANDLE, listen)

    def origin(self, pts: int) -> int | None:
        """The RTP timestamp of a picture whose ``pts`` is 0, of the ``pts`` that was sent last; None if it is
        unknown."""
        stamp = getattr(self._sender, _STAMP, None)
        if not isinstance(stamp, int):
            _missing(_STAMP)
            return None
        return (stamp - pts) & _UINT32

    def _note(self, packet: Any) -> None:
        self.lost = None
        if isinstance(packet, (RtcpRrPacket, RtcpSrPacket)):
            reports = [report for report in packet.reports if report.ssrc == self._sender._ssrc]  # noqa: SLF001 - see above
            self.lost = reports[0].fraction_lost / 256 if reports else None
        elif isinstance(packet, RtcpPsfbPacket) and packet.fmt == _APPLICATION:
            try:
                self.bitrate_bps = unpack_remb_fci(packet.fci)[0]
            except Exception:  # noqa: BLE001 - a viewer may send anything
                _log.debug("video: a viewer's report cannot be read")
        self._on_report()
        if isinstance(packet, RtcpPsfbPacket):
            needs_key = packet.fmt in (_PLI, _FIR)
        else:
            needs_key = (
                isinstance(packet, RtcpRtpfbPacket) and packet.fmt == _NACK and len(packet.lost) >= _GAP
            )
        if needs_key:
            self._on_key()


def hurry(peer: RTCPeerConnection) -> None:
    """Let a lost message of the data channel block the next ones for a second at most. Called often: each
    measured round trip sets the time anew."""
    sctp = peer.sctp
    if sctp is None:
        return
    timeout_s = getattr(sctp, _TIMEOUT, None)
    if timeout_s is None:
        _missing(_TIMEOUT)
    elif timeout_s > _MOST_S:
        setattr(sctp, _TIMEOUT, _MOST_S)


async def end_checks(peer: RTCPeerConnection) -> None:
    """After `close`: end the checks of a connection that had not come about before."""
    await asyncio.sleep(_BEGINS_S)
    for sender in peer.getSenders():
        connection: Any = getattr(sender.transport.transport, "_connection", None)
        checks = getattr(connection, "_query_consent_task", None)
        if checks is not None:
            checks.cancel()


def overfull(peer: RTCPeerConnection) -> bool:
    """Whether more of the viewer's messages waits for its rest than any viewer sends."""
    sctp = peer.sctp
    if sctp is None:
        return False
    streams = getattr(sctp, _STREAMS, None)
    if streams is None:
        _missing(_STREAMS)
        return False
    return len(streams) > _MOST_STREAMS or sum(len(s.reassembly) for s in streams.values()) > _MOST_CHUNKS


async def gather(peer: RTCPeerConnection) -> None:
    """Gather the candidates before the answer is made: if there are none, the loopback address."""
    transports = {sender.transport.transport for sender in peer.getSenders()}
    for transport in transports:
        gatherer = transport.iceGatherer
        await gatherer.gather()
        if not gatherer.getLocalCandidates():
            connection: Any = getattr(transport, "_connection", None)
            if not hasattr(connection, "_local_candidates"):
                _missing("_local_candidates")
                continue
            connection._local_candidates += await connection.get_component_candidates(  # noqa: SLF001 - see above
                component=1, addresses=["127.0.0.1"]
            )
