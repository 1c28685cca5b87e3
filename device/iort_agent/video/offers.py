"""What of a viewer's offer may reach WebRTC: a bounded session description, and servers of the deployment."""

from __future__ import annotations

import ipaddress
import re
from typing import Sequence

from iort_contract.checks import shown
from iort_contract.limits import ContractError
from iort_contract.messages.video import IceServer

# A browser's offer has some 200 lines, and some ten candidates for each of its networks.
MAX_LINES, MAX_LINE_CHARACTERS, MAX_CANDIDATES = 600, 1024, 48
_MEDIA = ("video", "application")
# A viewer must not send the robot to a host of its choice. TURN servers of Kinesis Video Streams are in
# this domain.
_KINESIS = re.compile(
    r"(stun|turns?):([a-z0-9-]{1,63}\.){1,4}?kinesisvideo\.[a-z0-9-]{1,32}\.amazonaws\.com(\.cn)?"
    r"(:[0-9]{1,5})?(\?transport=(udp|tcp))?",
)


def bounded(sdp: str) -> str:
    """The description with what is needed of it. Raises `ContractError` if it is too large, or if it is not
    one video and at most one data connection.

    A browser hides its addresses behind names that end with .local. To look for them would take seconds, and
    is not needed: the browser asks the robot's candidates, and so the robot learns its address. Therefore
    the list of candidates stays open, too. Other names, and groups of hosts, are left out as well.
    """
    lines = sdp.splitlines()
    if len(lines) > MAX_LINES:
        raise ContractError(f"offer must have at most {MAX_LINES} lines, got {len(lines)}")
    longest = max(map(len, lines), default=0)
    if longest > MAX_LINE_CHARACTERS:
        raise ContractError(f"a line of the offer must have at most {MAX_LINE_CHARACTERS} characters")
    media = [line[2:].partition(" ")[0] for line in lines if line.startswith("m=")]
    if media.count("video") != 1 or len(media) != len(set(media)) or not set(media) <= set(_MEDIA):
        raise ContractError(
            f"offer must have one video and at most one application, got {shown(', '.join(media[:8]))}"
        )
    candidates = [line for line in lines if line.startswith("a=candidate:")]
    if len(candidates) > MAX_CANDIDATES:
        raise ContractError(f"offer must have at most {MAX_CANDIDATES} candidates, got {len(candidates)}")
    left_out = {line for line in candidates if not _one_host((line.split()[4:5] or [""])[0])}
    kept = [line for line in lines if line not in left_out and line != "a=end-of-candidates"]
    return "\r\n".join(kept) + "\r\n"


def _one_host(address: str) -> bool:
    """Whether it is the address of one host, and no name: the robot looks nothing up for a viewer."""
    try:
        ip = ipaddress.ip_address(address)
    except ValueError:
        return False
    return ip.is_loopback or not (ip.is_multicast or ip.is_unspecified or ip.is_reserved)


def of_deployment(servers: Sequence[IceServer]) -> tuple[IceServer, ...]:
    """Those of a viewer's servers that the robot may use."""
    kept = []
    for server in servers:
        urls = tuple(url for url in server.urls if _KINESIS.fullmatch(url))
        kept += [IceServer(urls, server.username, server.credential)] if urls else []
    return tuple(kept)
