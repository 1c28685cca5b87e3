"""`iort-agent check`, from the robot to its cloud: name, route, port, TLS, the broker, its rules, the clock.

The first step that fails says what to do, and ends the check: the later ones would fail, too.
"""

from __future__ import annotations

import errno
import hashlib
import http.client
import socket
import ssl
import time
import uuid
from concurrent.futures import TimeoutError as FutureTimeout
from contextlib import closing, suppress
from email.utils import parsedate_to_datetime
from ipaddress import ip_address
from typing import TYPE_CHECKING, Any, Generator, Iterator, NamedTuple
from urllib.parse import urlsplit

from iort_agent.common.state import Status
from iort_agent.config import Config
from iort_agent.errors import IdentityError
from iort_agent.files.upload import trusting
from iort_agent.identity import Certificate, check_pair
from iort_agent.sources import FAIL, OK, WARN, Finding
from iort_contract.limits import ContractError
from iort_contract.messages.files import File, FileRequest, decode_file_answer, encode_file_request
from iort_contract.messages.live import decode_pong, encode_ping
from iort_contract.topics import FILE, PING, PONG, RULE, build_topic

if TYPE_CHECKING:
    from iort_agent.mqtt.session import Session

TIMEOUT_S = 5.0
# A server that refuses our certificate says so within a round trip.
_ALERT_S = 1.0
# The client's errors for an answer that is not MQTT 5.
_FOREIGN = ("AWS_ERROR_MQTT5_DECODE_PROTOCOL_ERROR", "AWS_ERROR_MQTT5_PROTOCOL_ERROR")
SET_CLOCK = "set the clock: `timedatectl set-ntp true`, or `sudo date -s ...`"
# The port of HTTPS, on which AWS' broker wants ALPN.
_HTTPS_PORT = 443
# OpenSSL's codes for certificates (X509_V_ERR_...).
_NOT_YET_VALID, _EXPIRED, _WRONG_NAMES = 9, 10, (62, 64)
# A certificate that ends sooner should have been replaced by now.
_ENDS_SOON_S = 3 * 86_400
# This agent cannot run before 2026-01-01.
_EARLIEST_S = 1_767_225_600
_CLOCK_OFF_S = 5.0
# A function that was not used for long starts first.
_FILE_ANSWER_S = 15.0
_HANGS = "the cloud hangs, or something between holds the bytes back: `iort doctor` at the cloud"


class BlockedError(Exception):
    """No later step can succeed; `finding` says why."""

    def __init__(self, what: str, text: str, todo: str) -> None:
        super().__init__(text)
        self.finding = Finding(what, FAIL, text, todo)


def secured(config: Config, raw: socket.socket, address: str) -> ssl.SSLSocket:
    """Start TLS with our certificate. Raises `BlockedError`."""
    try:
        context = ssl.create_default_context(cafile=config.root_ca)
    except (OSError, ValueError) as error:
        todo = "copy root-ca.pem from the robot's bundle again"
        raise BlockedError("root_ca", f"{config.root_ca} cannot be used: {error}", todo) from error
    if _is_pair(config):
        context.load_cert_chain(config.certificate, config.private_key)
    if config.port == _HTTPS_PORT:
        context.set_alpn_protocols(["x-amzn-mqtt-ca"])
    try:
        return context.wrap_socket(raw, server_hostname=config.endpoint)
    except ssl.SSLCertVerificationError as error:
        raise BlockedError("server certificate", *_distrusted(config, address, error)) from error
    except (OSError, ValueError) as error:
        raise BlockedError("TLS", *no_tls(config, error)) from error


def _is_pair(config: Config) -> bool:
    """Whether certificate and key belong together. Where they do not, another check says so."""
    try:
        check_pair(config.certificate, config.private_key)
    except IdentityError:
        return False
    return True


def _distrusted(config: Config, address: str, error: ssl.SSLCertVerificationError) -> tuple[str, str]:
    """What is wrong with the server's certificate, and what to do."""
    shown = _unverified(config, address)
    now = utc(time.time())
    if shown is not None and error.verify_code in (_EXPIRED, _NOT_YET_VALID):
        validity = shown.validity()
        verb = "ended on" if error.verify_code == _EXPIRED else "is valid from"
        at = validity.not_after_s if error.verify_code == _EXPIRED else validity.not_before_s
        text = f"{verb} {utc(at)}, and this machine's clock says {now}"
        return text, f"if {now} is wrong, {SET_CLOCK}; if it is right, restart the cloud, which renews it"
    if shown is not None and error.verify_code in _WRONG_NAMES:
        start = f"`make up LISTEN=ADDRESS,{config.endpoint}`"
        text = f"is for {', '.join(shown.names()) or 'no name'}, and not for {config.endpoint}"
        return text, f"set `endpoint` to one of these, or start the cloud with {start}"
    signer = f"is signed by {shown.issuer()}, " if shown is not None else ""
    if config.root_ca is None:
        trusted = "which this machine does not trust"
        todo = "a laboratory's cloud has an authority of its own: `root_ca` is the bundle's root-ca.pem"
    else:
        trusted = f"which is not in {config.root_ca}"
        todo = (
            "`root_ca` is another cloud's: copy root-ca.pem from a bundle of this one (`iort robots add`). "
            "For AWS leave `root_ca` out"
        )
    return f"{signer}{trusted} ({error.verify_message})", todo


def _unverified(config: Config, address: str) -> Certificate | None:
    """The certificate that the server shows to anybody; None if it shows none now."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    with suppress(OSError, IdentityError):
        raw = socket.create_connection((address, config.port), TIMEOUT_S)
        with closing(raw), closing(context.wrap_socket(raw, server_hostname=config.endpoint)) as secure:
            certificate = Certificate(secure.getpeercert(binary_form=True) or b"")
        certificate.validity()
        return certificate
    return None


def no_tls(config: Config, error: Exception) -> tuple[str, str]:
    """Why a connection does not come to TLS, and what to do."""
    reason = str(getattr(error, "reason", None) or error)
    if (refused := refused_ours(config, reason)) is not None:
        return refused
    if isinstance(error, socket.timeout):
        return f"{config.port} takes the connection, and then says nothing for {TIMEOUT_S:g} s", _HANGS
    if any(sign in reason for sign in ("WRONG_VERSION", "HTTP_REQUEST", "RECORD_LAYER")):
        todo = "`port` is another service's: a broker has 8883 usually"
        return f"{config.port} answers, but not with TLS", todo
    todo = "is a proxy or a tunnel between, whose broker is down? `iort doctor` there; is `port` right?"
    return f"the connection ends before TLS: {reason}", todo


def refused_ours(config: Config, reason: str) -> tuple[str, str] | None:
    """What the server's TLS alert says of our certificate, and what to do; None without an alert."""
    if "ALERT" not in reason.upper():
        return None
    words = reason.rpartition("ALERT_")[2].replace("_", " ").lower()
    if "unknown ca" in words or "unknown_ca" in reason:
        todo = "the bundle is another cloud's, or of one that was not kept: `iort robots add` makes a new one"
        return f"the cloud does not know who signed {config.certificate} ({words})", todo
    if "expired" in words:
        todo = "`iort-agent renew`; is the cloud's clock right?"
        return "the cloud says that our certificate is expired", todo
    todo = "see certificate and private key above; `iort robots show` tells what the cloud knows of them"
    return f"the cloud refuses our certificate: {words}", todo


def utc(at_s: float) -> str:
    """A time since the epoch, for a person."""
    return time.strftime("%Y-%m-%d %H:%M:%SZ", time.gmtime(at_s))


class _Offset(NamedTuple):
    """The cloud's clock minus the robot's, and how that is known."""

    seconds: float
    by: str


def check_connection(config: Config, running: Status | None = None) -> Iterator[Finding]:
    """Check each step to the broker. Without ``running``, this ends a running agent's connection."""
    offset: _Offset | None = None
    try:
        addresses = _addresses(config.endpoint, config.port)
        literal = addresses == [config.endpoint]
        yield Finding("name", OK, f"{config.endpoint} is {'an address' if literal else ', '.join(addresses)}")
        yield Finding("route", OK, _route(addresses))
        raw, address = _connected(config, addresses)
        yield Finding("port", OK, f"{address} listens on {config.port}")
        with closing(raw), closing(secured(config, raw, address)) as secure:
            yield _served(secure)
            if running is None:
                _trusted(config, secure)
            elif running.connection.connected:
                yield Finding("broker", OK, "the running agent is connected")
            else:
                why = running.connection.last_error
                yield Finding("broker", FAIL, f"the running agent is not connected: {why}")
        if running is None and _is_pair(config):
            offset = yield from _broker(config)
    except BlockedError as blocked:
        yield blocked.finding
    yield _clock(offset or _other_offset(config, running))


def _addresses(endpoint: str, port: int) -> list[str]:
    try:
        rows = socket.getaddrinfo(endpoint, port, type=socket.SOCK_STREAM)
    except OSError as error:
        if error.errno == socket.EAI_AGAIN:
            todo = (
                "is there a network? `ip route` must show a default route, `resolvectl status` a name server"
            )
            raise BlockedError("name", f"no name server answers for {endpoint}", todo) from error
        todo = (
            "is `endpoint` spelled right? The name of a laboratory's cloud must be in its DNS, or in this "
            "robot's /etc/hosts; its IP address as `endpoint` needs neither"
        )
        raise BlockedError("name", f"{endpoint} does not resolve: {error.strerror or error}", todo) from error
    return list(dict.fromkeys(str(row[4][0]) for row in rows))


def _route(addresses: list[str]) -> str:
    """From which address of ours to which of theirs. To connect a UDP socket sends nothing."""
    problem: OSError = OSError()
    for address in addresses:
        family = socket.AF_INET6 if ":" in address else socket.AF_INET
        with socket.socket(family, socket.SOCK_DGRAM) as probe:
            try:
                probe.connect((address, 9))
            except OSError as error:
                problem = error
                continue
            if ip_address(address).is_loopback:
                return f"{address} is this machine itself"
            return f"from {probe.getsockname()[0]} to {address}"
    todo = "is the Wi-Fi or the cable connected, in the cloud's network? `ip address`, `ip route` show it"
    raise BlockedError("route", f"none to {', '.join(addresses)}: {problem.strerror}", todo) from problem


def _connected(config: Config, addresses: list[str]) -> tuple[socket.socket, str]:
    port, problem = config.port, OSError()
    for address in addresses:
        try:
            return socket.create_connection((address, port), TIMEOUT_S), address
        except OSError as error:  # noqa: PERF203 - the next address may answer
            problem = error
    address = addresses[-1]
    if problem.errno == errno.ECONNRESET:
        # Accepted, and ended before we could say anything.
        raise BlockedError("TLS", *no_tls(config, problem)) from problem
    if problem.errno == errno.ECONNREFUSED:
        text = f"{address} answers, but nothing listens on {port}"
        todo = "is the cloud running there (`make up`, `iort doctor`), and is `port` right?"
        if ip_address(address).is_loopback:
            todo = (
                "no cloud runs on this machine. One on another machine lets cars in with "
                "`make up LISTEN=ADDRESS`; `endpoint` is then that address"
            )
    elif problem.errno in (errno.EHOSTUNREACH, errno.ENETUNREACH):
        text = f"no machine answers for {address}: {problem.strerror}"
        todo = "is the cloud's machine on, in the same network, and do clients of this Wi-Fi see each other?"
    else:
        text = f"no answer from {address}:{port} in {TIMEOUT_S:g} s: {problem.strerror or problem}"
        todo = (
            f"a firewall drops it, or the machine is off: `ping {address}` tells; open port {port} on the "
            "cloud's machine. AWS also listens on 443: `port: 443`"
        )
    raise BlockedError("port", text, todo) from problem


def _served(secure: ssl.SSLSocket) -> Finding:
    """The server's certificate, which is good."""
    shown: Any = secure.getpeercert() or {}
    names = ", ".join(name for _, name in shown.get("subjectAltName", ())) or "no name"
    end_s = ssl.cert_time_to_seconds(shown["notAfter"])
    issuer = {key: value for part in shown.get("issuer", ()) for key, value in part}
    signer = issuer.get("commonName") or issuer.get("organizationName", "an unnamed authority")
    text = f"{secure.version()}, for {names}, until {utc(end_s)[:10]}, signed by {signer}"
    if end_s - time.time() < _ENDS_SOON_S:
        todo = "the cloud should have renewed it by now: `iort doctor` there"
        return Finding("server certificate", WARN, f"{text}: ends soon", todo)
    return Finding("server certificate", OK, text)


def _trusted(config: Config, secure: ssl.SSLSocket) -> None:
    """Raise `BlockedError` if the server refuses our certificate: with TLS 1.3 its alert comes only now."""
    secure.settimeout(_ALERT_S)
    try:
        secure.recv(1)
    except socket.timeout:
        return
    except OSError as error:
        if (refused := refused_ours(config, str(getattr(error, "reason", None) or error))) is not None:
            raise BlockedError("broker", *refused) from error


def _broker(config: Config) -> Generator[Finding, None, _Offset | None]:
    """The broker's answer to the robot, then the cloud's. Returns the clock's offset, or None."""
    # It loads the network's library.
    from iort_agent.mqtt.session import RefusalError, Session  # noqa: PLC0415 - see above

    robot, certificate, key = config.robot, config.certificate.read_bytes(), config.private_key.read_bytes()
    session = Session(
        robot, certificate, key, endpoint=config.endpoint, port=config.port, root_ca=config.root_ca
    )
    try:
        if not session.open(TIMEOUT_S):
            raise BlockedError("broker", *_not_accepted(config, session))
        yield Finding("broker", OK, f"accepts {robot}")
        try:
            for lane in (RULE, FILE):
                session.subscribe(build_topic(PONG, robot, lane, config.namespace), TIMEOUT_S)
            offset = _ping(config, session)
            yield Finding("rules", OK, f"answer a ping, {offset.by}")
            yield _files(config, session)
        except (OSError, FutureTimeout, RefusalError, ContractError) as error:
            todo = (
                f"is `namespace: {config.namespace}` the deployment's, and is it deployed whole? "
                "`iort doctor` there"
            )
            why = str(error) or session.lost or "nothing in time"
            yield Finding("rules", WARN, f"the cloud's rules do not answer: {why}", todo)
            return None
        return offset
    finally:
        session.close(TIMEOUT_S)


def _ping(config: Config, session: Session) -> _Offset:
    """Compare the clocks by a rule's answer. Raises `OSError` without one."""
    ping, pong = (build_topic(lane, config.robot, RULE, config.namespace) for lane in (PING, PONG))
    sent_s, sent_us = time.monotonic(), time.time_ns() // 1000
    answer = session.round_trip(ping, encode_ping(0, sent_us), pong, TIMEOUT_S)
    trip_s = time.monotonic() - sent_s
    received_ms = None if answer is None else decode_pong(answer).received_ms
    if received_ms is None:
        raise OSError(f"nothing in {TIMEOUT_S:g} s")
    by = f"by a round trip of {trip_s * 1000:.0f} ms"
    return _Offset(received_ms / 1000 - sent_us / 1e6 - trip_s / 2, by)


def _files(config: Config, session: Session) -> Finding:
    """Whether files could be sent: the cloud names the address, and nothing is sent there."""
    nothing = hashlib.sha256(b"").hexdigest()
    empty = File("check", "other", "application/octet-stream", 0, nothing, time.time_ns() // 1000)
    request = encode_file_request(FileRequest(uuid.uuid4().hex, empty, {1: nothing}))
    ask, answered = (build_topic(lane, config.robot, FILE, config.namespace) for lane in (PING, PONG))
    payload = session.round_trip(ask, request, answered, _FILE_ANSWER_S)
    if payload is None:
        todo = "`iort errors` and `iort alarms` at the cloud tell of the function Upload"
        return Finding("files", WARN, f"the cloud names no address in {_FILE_ANSWER_S:g} s", todo)
    answer = decode_file_answer(payload)
    if not answer.addresses:
        todo = "is the robot registered? `iort robots list`"
        return Finding("files", WARN, f"refused: {answer.refused}", todo)
    url = urlsplit(answer.addresses[0].url)
    host, port = url.hostname or "", url.port or _HTTPS_PORT
    try:
        with socket.create_connection((host, port), TIMEOUT_S) as raw:
            trusting(config.root_ca).wrap_socket(raw, server_hostname=host).close()
    except (OSError, ValueError) as error:
        todo = f"let port {port} of {host} through the firewall. Recordings do not need it"
        return Finding("files", WARN, f"cannot be sent to {host}:{port}: {error}", todo)
    return Finding("files", OK, f"could be sent to {host}:{port}")


def _not_accepted(config: Config, session: Session) -> tuple[str, str]:
    """Why the broker did not accept the robot, and what to do."""
    robot = config.robot
    if session.refusal:
        todo = (
            f"the certificate is not active, not attached to the thing {robot}, or its policy refuses: "
            "see `iort robots list`"
        )
        return f"refuses {robot}: {session.refusal}", todo
    if not session.error:
        return f"gives {robot} no answer in {TIMEOUT_S:g} s", _HANGS
    if session.error in _FOREIGN:
        todo = "is `port` right? The cloud's broker speaks MQTT 5, older ones do not"
        return "answers, but not in MQTT 5", todo
    todo = (
        "the certificate is unknown there, not active or revoked (`iort robots list`), or the broker is "
        "being restarted: try again"
    )
    return f"hangs up on {robot}: {session.failure}", todo


def _other_offset(config: Config, running: Status | None) -> _Offset | None:
    """The clock's offset by others than the broker."""
    if running is not None and running.clock is not None:
        return _Offset(running.clock.offset_ms / 1000, "by the running agent's pings")
    if not config.endpoint.endswith(".amazonaws.com"):
        return None
    # To the second; nothing without a valid answer.
    connection = http.client.HTTPSConnection(config.endpoint, _HTTPS_PORT, timeout=TIMEOUT_S)
    with suppress(OSError, http.client.HTTPException, TypeError, ValueError), closing(connection):
        connection.request("HEAD", "/")
        date = connection.getresponse().getheader("Date", "")
        cloud_s = parsedate_to_datetime(date).timestamp() + 0.5
        return _Offset(cloud_s - time.time(), "by AWS' answer over HTTPS")
    return None


def _clock(offset: _Offset | None) -> Finding:
    shown = utc(time.time())
    if offset is None:
        if time.time() < _EARLIEST_S:
            return Finding("clock", FAIL, f"says {shown}, which is long past", SET_CLOCK)
        return Finding("clock", OK, f"says {shown}, which is plausible; nothing to compare it with yet")
    if abs(offset.seconds) > _CLOCK_OFF_S:
        text = f"is {-offset.seconds:+.1f} s off, {offset.by}: samples are stamped wrong"
        return Finding("clock", WARN, text, SET_CLOCK)
    return Finding("clock", OK, f"is {-offset.seconds:+.3f} s off, {offset.by}")
