"""Makes clients of AWS' MQTT library from the robot's certificate files, and mends two of its costs: threads
whose Python state is made anew for each call, and small messages that wait for the ones before.
"""

from __future__ import annotations

import ctypes
import errno
import functools
import logging
import os
import socket
import struct
import threading
from pathlib import Path
from typing import Any, Iterator, NamedTuple

from awscrt import io, mqtt5
from awsiot import mqtt5_client_builder

from iort_agent.errors import IdentityError
from iort_agent.identity import Certificate, Validity, check_pair, read_certificate, stamp

_log = logging.getLogger(__name__)

_ACK_TIMEOUT_S = 20
# The client's own reconnects come so late that ours are always first.
_NEVER_MS = 24 * 3600 * 1000
# linux/rtnetlink.h: notices of addresses and routes of IPv4 and IPv6 (RTMGRP_*), and those of new ones
# (RTM_NEWADDR, RTM_NEWROUTE). A message begins with its length and kind.
_GROUPS = 0x10 | 0x40 | 0x100 | 0x400
_NEW = (20, 24)
_NOTICE, _NOTICE_BYTES = struct.Struct("=IH10x"), 65_536
_thread = threading.local()
_DESCRIPTORS = Path("/proc/self/fd")
_TABLES = (Path("/proc/self/net/tcp"), Path("/proc/self/net/tcp6"))
# Columns of the tables: the peer's address and port in hexadecimal, and the socket's inode.
_PEER, _INODE = 2, 9


class Broker(NamedTuple):
    """Where to connect, and as whom. Without ``root_ca``, the system's trust store must contain the broker's
    authority, as it does AWS'."""

    endpoint: str
    port: int
    client_id: str
    certificate: Path
    private_key: Path
    root_ca: Path | None = None


class ClientFactory:
    """Makes clients for one broker, and notices when the files are replaced."""

    def __init__(self, broker: Broker, *, keep_alive_s: int, ping_timeout_s: float) -> None:
        self._files = broker[3:]
        self._build = functools.partial(
            mqtt5_client_builder.mtls_from_path,
            str(broker.certificate),
            str(broker.private_key),
            endpoint=broker.endpoint,
            port=broker.port,
            ca_filepath=None if broker.root_ca is None else str(broker.root_ca),
            client_id=broker.client_id,
            keep_alive_interval_sec=keep_alive_s,
            ping_timeout_ms=round(ping_timeout_s * 1000),
            ack_timeout_sec=_ACK_TIMEOUT_S,
            session_behavior=mqtt5.ClientSessionBehaviorType.CLEAN,
            offline_queue_behavior=mqtt5.ClientOperationQueueBehaviorType.FAIL_ALL_ON_DISCONNECT,
            retry_jitter_mode=mqtt5.ExponentialBackoffJitterMode.NONE,
            min_reconnect_delay_ms=_NEVER_MS,
            max_reconnect_delay_ms=_NEVER_MS,
        )
        self._bootstrap: Any = None
        self._stamp = stamp(*self._files)
        self._certificate: Certificate | None = None

    def make(self, **handlers: Any) -> Any:
        """Make a client from the files as they are now. Raises `IdentityError`, which says which of them does
        not fit, and whatever the library does for a wrong ``root_ca``."""
        if self._bootstrap is None:
            group = io.EventLoopGroup(1)
            self._bootstrap = io.ClientBootstrap(group, io.DefaultHostResolver(group))
        self._stamp = stamp(*self._files)
        # The library's own error names no file.
        check_pair(*self._files[:2])
        client = self._build(client_bootstrap=self._bootstrap, **handlers)
        try:
            self._certificate = read_certificate(self._files[0])
        except IdentityError as error:
            # The library accepts the file, so the agent connects without knowing its id and validity.
            _log.warning("%s", error)
            self._certificate = None
        return client

    def replaced(self) -> bool:
        """Whether a file has changed since the last client was made; False while one is missing."""
        now = stamp(*self._files)
        return now != self._stamp and None not in now

    def certificate_id(self) -> str | None:
        """The id of the last client's certificate; None if it is unknown."""
        return self._certificate.id if self._certificate is not None else None

    def validity(self) -> Validity | None:
        """The validity of the last client's certificate; None if it is unknown."""
        try:
            return self._certificate.validity() if self._certificate is not None else None
        except IdentityError:
            return None


class Network:
    """Tells when this machine gets an address or a route, as it does when it is in reach of its Wi-Fi again.

    The kernel sends its notices to a socket. Where there are none (not Linux, or forbidden), `came` is False.
    """

    def __init__(self, notices: socket.socket | None = None) -> None:
        self._notices = notices or _kernels_notices()

    def close(self) -> None:
        """Hear no notices any more."""
        if self._notices is not None:
            self._notices.close()

    def came(self) -> bool:
        """Whether one came since the last call."""
        came = False
        while self._notices is not None:
            try:
                data = self._notices.recv(_NOTICE_BYTES)
            except BlockingIOError:
                break
            except OSError as error:
                # There may have been more notices than the kernel keeps.
                return error.errno == errno.ENOBUFS
            came |= any(kind in _NEW for kind in _kinds(data))
        return came


def _kernels_notices() -> socket.socket | None:
    notices = None
    try:
        notices = socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE)
        notices.setblocking(False)
        notices.bind((0, _GROUPS))
    except (AttributeError, OSError) as error:
        _log.debug("the kernel tells of no network: %s", error)
        if notices is not None:
            notices.close()
        return None
    return notices


def _kinds(data: bytes) -> Iterator[int]:
    """The kinds of netlink's messages, which are aligned to 4 bytes."""
    at = 0
    while at + _NOTICE.size <= len(data):
        length, kind = _NOTICE.unpack_from(data, at)
        yield kind
        at += max(_NOTICE.size, (length + 3) & ~3)


def keep_state() -> None:
    """Keep Python's state of the calling thread, which C code has started, until the process ends.

    Python makes a state for each call from such a thread and deletes it afterwards. From Python 3.11 on, each
    time maps and unmaps memory, which costs every other processor core, too: 100 us for each live message at
    50 Hz, a third of the message's cost (measured).
    """
    if not hasattr(_thread, "state"):
        # Python deletes the state with the last release; this one is never released.
        _thread.state = ctypes.pythonapi.PyGILState_Ensure()


def send_at_once(port: int) -> int:
    """Set TCP_NODELAY on every socket of this process that is connected to the port; returns how many.

    AWS' client leaves it unset and has no option for it. A message behind another one then waits for the
    acknowledgement of the first, which the receiver may delay by 40 ms: on loopback, a ping behind a live
    sample took 23 ms instead of 1 (measured). The kernel's table of connections tells which of this process'
    descriptors is the socket. No other one is touched: even `socket.socket` would change it, because with a
    default timeout, which rospy sets, Python makes any descriptor that it is given non-blocking.

    Without /proc (not Linux) it does nothing: messages are slower, and none is lost.
    """
    links = {f"socket:[{inode}]" for table in _TABLES for inode in _connected(table, port)}
    try:
        return sum(_set(entry, links) for entry in _DESCRIPTORS.iterdir())
    except OSError:
        return 0


def _connected(table: Path, port: int) -> list[str]:
    try:
        rows = [line.split() for line in table.read_text(encoding="ascii").splitlines()[1:]]
    except OSError:
        return []
    return [row[_INODE] for row in rows if int(row[_PEER].rpartition(":")[2], 16) == port]


def _set(descriptor: Path, links: set[str]) -> bool:
    try:
        if os.readlink(descriptor) not in links:
            return False
        # A duplicate shares the socket, and closing it leaves the owner's descriptor open.
        with socket.socket(fileno=os.dup(int(descriptor.name))) as shared:
            shared.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            return True
    except OSError:
        # The descriptor was closed meanwhile.
        return False
