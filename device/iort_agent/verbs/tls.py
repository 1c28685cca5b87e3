"""The step from a connection to TLS: why the robot would distrust the server, or the server the robot."""

from __future__ import annotations

import socket
import ssl
import time
from contextlib import closing, suppress

from iort_agent.config import Config
from iort_agent.errors import IdentityError
from iort_agent.identity.certificate import Certificate, check_pair
from iort_agent.sources import FAIL, Finding

TIMEOUT_S = 5.0
SET_CLOCK = "set the clock: `timedatectl set-ntp true`, or `sudo date -s ...`"
_TLS_PORT_WITH_ALPN = 443
# OpenSSL's codes for certificates (X509_V_ERR_...).
_NOT_YET_VALID, _EXPIRED, _WRONG_NAMES = 9, 10, (62, 64)


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
    with suppress(IdentityError):
        check_pair(config.certificate, config.private_key)
        context.load_cert_chain(config.certificate, config.private_key)
    if config.port == _TLS_PORT_WITH_ALPN:
        context.set_alpn_protocols(["x-amzn-mqtt-ca"])
    try:
        return context.wrap_socket(raw, server_hostname=config.endpoint)
    except ssl.SSLCertVerificationError as error:
        raise BlockedError("server certificate", *_distrusted(config, address, error)) from error
    except (OSError, ValueError) as error:
        raise BlockedError("TLS", *no_tls(config, error)) from error


def _distrusted(config: Config, address: str, error: ssl.SSLCertVerificationError) -> tuple[str, str]:
    """What is wrong with the server's certificate, and what to do."""
    shown = _unverified(config, address)
    now = utc(time.time())
    if shown is not None and error.verify_code in (_EXPIRED, _NOT_YET_VALID):
        validity = shown.validity()
        said = "ended on" if error.verify_code == _EXPIRED else "is valid from"
        at = validity.not_after_s if error.verify_code == _EXPIRED else validity.not_before_s
        text = f"{said} {utc(at)}, and this machine's clock says {now}"
        return text, f"if {now} is wrong, {SET_CLOCK}; if it is right, restart the cloud, which renews it"
    if shown is not None and error.verify_code in _WRONG_NAMES:
        text = f"is for {', '.join(shown.names()) or 'no name'}, and not for {config.endpoint}"
        todo = (
            "set `endpoint` to one of these, or start the cloud with "
            f"`make up LISTEN=ADDRESS,{config.endpoint}`"
        )
        return text, todo
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
            found = Certificate(secure.getpeercert(binary_form=True) or b"")
        found.validity()
        return found
    return None


def no_tls(config: Config, error: Exception) -> tuple[str, str]:
    """Why a connection does not come to TLS, and what to do."""
    reason = str(getattr(error, "reason", None) or error)
    if (refused := refused_ours(config, reason)) is not None:
        return refused
    if isinstance(error, socket.timeout):
        text = f"{config.port} takes the connection, and then says nothing for {TIMEOUT_S:g} s"
        return text, "the cloud hangs, or something between holds the bytes back: `iort doctor` at the cloud"
    if "WRONG_VERSION" in reason or "HTTP_REQUEST" in reason or "RECORD_LAYER" in reason:
        return (
            f"{config.port} answers, but not with TLS",
            "`port` is another service's: a broker has 8883 usually",
        )
    text = f"the connection ends before TLS: {reason}"
    todo = (
        "is a proxy or a tunnel between, whose broker is down? `iort doctor` at the cloud; is `port` right?"
    )
    return text, todo


def refused_ours(config: Config, reason: str) -> tuple[str, str] | None:
    """What the server's TLS alert says of our certificate, and what to do; None without an alert."""
    if "ALERT" not in reason.upper():
        return None
    words = reason.rpartition("ALERT_")[2].replace("_", " ").lower()
    if "unknown ca" in words or "unknown_ca" in reason:
        todo = "the bundle is another cloud's, or of one that was not kept: `iort robots add` makes a new one"
        return f"the cloud does not know who signed {config.certificate} ({words})", todo
    if "expired" in words:
        return (
            "the cloud says that our certificate is expired",
            "`iort-agent renew`; is the cloud's clock right?",
        )
    todo = "see certificate and private key above; `iort robots show` tells what the cloud knows of them"
    return f"the cloud refuses our certificate: {words}", todo


def utc(at_s: float) -> str:
    """A time since the epoch, for a person."""
    return time.strftime("%Y-%m-%d %H:%M:%SZ", time.gmtime(at_s))
