"""`iort-agent check`: finds what would not work. It changes nothing, and does not disturb a running agent.

Each source checks itself: see `iort_agent.sources.SourceConfig.check`.
"""

from __future__ import annotations

import http.client
import os
import shutil
import socket
import ssl
import stat
import time
from contextlib import closing
from email.utils import parsedate_to_datetime
from pathlib import Path
from typing import Iterator

from iort_agent.common.state import Status
from iort_agent.config import Config
from iort_agent.errors import IdentityError, NotRunningError
from iort_agent.identity.certificate import Certificate, check_pair, read_certificate
from iort_agent.lanes.record import TODO, too_many
from iort_agent.sources import FAIL, OK, WARN, Finding
from iort_agent.status.server import ask

_TIMEOUT_S = 5.0
_EXPIRES_SOON_S = 30 * 86_400
# This agent cannot run before 2026-01-01.
_EARLIEST_S = 1_767_225_600
_CLOCK_OFF_S = 5.0
_LEAST_FREE_BYTES = 50_000_000
_TLS_PORT_WITH_ALPN = 443
# The reason codes of an MQTT 5 CONNACK that a robot may get.
_CONNACK = {0x00: "accepted", 0x85: "client id not valid", 0x87: "not authorized", 0x89: "server busy"}


def check(config: Config, status_socket: Path) -> Iterator[Finding]:
    """Check everything that the configuration names, one finding after another."""
    running = _running(status_socket)
    yield from _identity(config)
    yield from _clock(config, running)
    yield from broker_findings(config, running)
    for i, source in enumerate(config.sources):
        yield from source.check(f"source {i} ({source.describe()})")
    yield from _queue(config)
    yield _lanes(config)
    if running is None:
        yield Finding("agent", OK, "not running")
    else:
        yield Finding("agent", OK, f"running, process {running.pid}: see `iort-agent status`")


def render(finding: Finding) -> str:
    """A line for a person."""
    todo = f"\n      -> {finding.todo}" if finding.todo and finding.level != OK else ""
    return f"{finding.level:<5} {finding.what}: {finding.text}{todo}"


def broker_findings(config: Config, running: Status | None = None) -> Iterator[Finding]:
    """Whether the broker accepts the robot. Without ``running``, this ends a running agent's connection."""
    where = f"{config.endpoint}:{config.port}"
    try:
        found = socket.getaddrinfo(config.endpoint, config.port, type=socket.SOCK_STREAM)
    except OSError as error:
        todo = "is there a network, and is `endpoint` spelled right?"
        yield Finding("endpoint", FAIL, f"{config.endpoint} does not resolve: {error}", todo)
        return
    yield Finding("endpoint", OK, f"{config.endpoint} is {found[0][4][0]}")
    try:
        raw = socket.create_connection((config.endpoint, config.port), _TIMEOUT_S)
    except OSError as error:
        todo = "is the port open in the firewall? AWS also listens on 443: set `port: 443`"
        yield Finding("connection", FAIL, f"{where}: {error}", todo)
        return
    yield Finding("connection", OK, where)
    with closing(raw):
        try:
            context = ssl.create_default_context(cafile=config.root_ca)
            context.load_cert_chain(config.certificate, config.private_key)
            if config.port == _TLS_PORT_WITH_ALPN:
                context.set_alpn_protocols(["x-amzn-mqtt-ca"])
            secure = context.wrap_socket(raw, server_hostname=config.endpoint)
        except ssl.SSLCertVerificationError as error:
            todo = (
                "does `root_ca` belong to this broker? For AWS leave it out. If the certificate is not yet "
                "valid or expired, the clock is wrong"
            )
            yield Finding("TLS", FAIL, f"the broker's certificate: {error.verify_message}", todo)
            return
        except (OSError, ValueError) as error:
            yield Finding("TLS", FAIL, str(error), "see the certificate and the key above")
            return
        yield Finding("TLS", OK, f"{secure.version()}, the broker's certificate is good")
        if running is None:
            yield _connack(secure, config.robot)
        elif running.connection.connected:
            yield Finding("broker", OK, "the running agent is connected")
        else:
            why = running.connection.last_error
            yield Finding("broker", FAIL, f"the running agent is not connected: {why}")


def _running(status_socket: Path) -> Status | None:
    try:
        return ask(status_socket)
    except NotRunningError:
        return None


def _identity(config: Config) -> Iterator[Finding]:
    try:
        validity = _validity(read_certificate(config.certificate))
    except IdentityError as error:
        yield Finding("certificate", FAIL, str(error), "`iort robots add` or `iort-agent provision` gets one")
    else:
        yield validity
        try:
            check_pair(config.certificate, config.private_key)
        except IdentityError as error:
            yield Finding("private key", FAIL, str(error), "put the two files of one bundle side by side")
        else:
            yield Finding("private key", OK, "is the certificate's")
    mode = stat.S_IMODE(config.private_key.stat().st_mode)
    if mode & 0o077:
        todo = f"chmod 600 {config.private_key}"
        yield Finding("key's mode", WARN, f"{mode:03o}: others may read it", todo)
    else:
        yield Finding("key's mode", OK, f"{mode:03o}")


def _validity(certificate: Certificate) -> Finding:
    now_s, validity = time.time(), certificate.validity()
    day = time.strftime("%Y-%m-%d", time.gmtime(validity.not_after_s))
    if now_s > validity.not_after_s:
        return Finding("certificate", FAIL, f"expired on {day}", "get a new one: `iort-agent renew`")
    if now_s < validity.not_before_s:
        return Finding("certificate", FAIL, "not valid yet, by this machine's clock", "set the clock")
    if validity.not_after_s - now_s < _EXPIRES_SOON_S:
        return Finding("certificate", WARN, f"expires on {day}", "get a new one: `iort-agent renew`")
    return Finding("certificate", OK, f"{certificate.id[:16]}..., valid until {day}")


def _clock(config: Config, running: Status | None) -> Iterator[Finding]:
    now_s = time.time()
    shown = time.strftime("%Y-%m-%d %H:%M:%SZ", time.gmtime(now_s))
    todo = "set the clock: `timedatectl set-ntp true`, or `sudo date -s ...`"
    if now_s < _EARLIEST_S:
        yield Finding("clock", FAIL, f"says {shown}, which is long past", todo)
        return
    offset_s, by = None, ""
    if running is not None and running.clock is not None:
        offset_s, by = running.clock.offset_ms / 1000, "the running agent's pings"
    elif config.endpoint.endswith(".amazonaws.com"):
        offset_s, by = _http_offset_s(config.endpoint), "AWS' answer over HTTPS"
    if offset_s is None:
        yield Finding("clock", OK, f"says {shown}, which is plausible; a running agent knows it better")
    elif abs(offset_s) > _CLOCK_OFF_S:
        yield Finding("clock", WARN, f"is {-offset_s:+.1f} s off, by {by}: samples are stamped wrong", todo)
    else:
        yield Finding("clock", OK, f"is {-offset_s:+.3f} s off, by {by}")


def _http_offset_s(endpoint: str) -> float | None:
    """The cloud's clock minus ours, to the second; None without a valid answer."""
    connection = http.client.HTTPSConnection(endpoint, 443, timeout=_TIMEOUT_S)
    try:
        with closing(connection):
            connection.request("HEAD", "/")
            date = connection.getresponse().getheader("Date")
        return None if date is None else parsedate_to_datetime(date).timestamp() + 0.5 - time.time()
    except (OSError, http.client.HTTPException, TypeError, ValueError):
        return None


def _connack(secure: socket.socket, robot: str) -> Finding:
    """The broker's answer to the robot. Only while no agent runs, because this would end its connection."""
    todo = (
        f"the certificate is not active, not attached to the thing {robot}, or its policy refuses: "
        "see `iort robots list`"
    )
    name = robot.encode()
    # MQTT 5: protocol, clean start, keep-alive 30 s, no properties, client id.
    body = b"\x00\x04MQTT\x05\x02\x00\x1e\x00" + len(name).to_bytes(2, "big") + name
    try:
        with closing(secure):
            secure.sendall(bytes([0x10, len(body)]) + body)
            answer = secure.recv(4)
            if len(answer) == 4 and answer[0] == 0x20 and answer[3] == 0:
                secure.sendall(b"\xe0\x00")
                return Finding("broker", OK, f"accepts {robot}")
    except OSError as error:
        return Finding("broker", FAIL, f"gives {robot} no answer: {error}", todo)
    if len(answer) < 4:
        return Finding("broker", FAIL, f"hangs up on {robot}", todo)
    reason = _CONNACK.get(answer[3], f"reason {answer[3]:#x}")
    return Finding("broker", FAIL, f"refuses {robot}: {reason}", todo)


def _queue(config: Config) -> Iterator[Finding]:
    path: Path | None = config.queue.path
    if path is None:
        todo = "set queue.path to a file, for the batches to survive a restart"
        yield Finding("queue", WARN, "in memory: undelivered batches end with the agent", todo)
        return
    target = path if path.exists() else path.parent
    if not os.access(target, os.W_OK) or not os.access(path.parent, os.W_OK):
        yield Finding("queue", FAIL, f"{target} may not be written", f"chown it to {os.environ.get('USER')}")
        return
    free = shutil.disk_usage(path.parent).free
    used = path.stat().st_size if path.exists() else 0
    text = f"{path}, {used / 1e6:.1f} MB used of {config.queue.max_bytes / 1e6:.0f}, {free / 1e6:.0f} MB free"
    if free < _LEAST_FREE_BYTES:
        yield Finding("queue", FAIL, text, "free some of the disk: batches will be dropped")
    elif free < config.queue.max_bytes - used:
        yield Finding("queue", WARN, text, "the disk is full before the queue is: lower queue.max_bytes")
    else:
        yield Finding("queue", OK, text)


def _lanes(config: Config) -> Finding:
    problem = too_many(config.sources, config.record)
    if problem is not None:
        return Finding("record lane", WARN, problem, TODO)
    return Finding("record lane", OK, "the streams named are few enough for one connection")
