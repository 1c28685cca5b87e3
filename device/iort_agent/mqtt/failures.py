"""Explains why a connection to the broker failed, and what the person at the robot should check."""

from __future__ import annotations

import time
from typing import Any, Callable

from awscrt import mqtt5

from iort_agent.identity.certificate import Validity
from iort_agent.mqtt.reconnect import Cause, Hangups

_TLS_FAILED = "AWS_IO_TLS_ERROR_NEGOTIATION_FAILURE"
_HUNG_UP = "AWS_ERROR_MQTT_UNEXPECTED_HANGUP"
_CLOSED = "AWS_IO_SOCKET_CLOSED"
# CONNACK codes that only a person can change.
_REFUSALS = frozenset(
    {
        mqtt5.ConnectReasonCode.NOT_AUTHORIZED,
        mqtt5.ConnectReasonCode.BAD_USERNAME_OR_PASSWORD,
        mqtt5.ConnectReasonCode.BANNED,
        mqtt5.ConnectReasonCode.CLIENT_IDENTIFIER_NOT_VALID,
    }
)

# Explanations of the client's error names.
_HINTS = {
    "AWS_IO_DNS_INVALID_NAME": "the endpoint's name does not resolve",
    "AWS_IO_DNS_QUERY_FAILED": "the endpoint's name does not resolve",
    "AWS_IO_SOCKET_CONNECTION_REFUSED": "nothing listens at the endpoint's port",
    "AWS_IO_SOCKET_TIMEOUT": "the endpoint does not answer",
    "AWS_IO_SOCKET_NO_ROUTE_TO_HOST": "there is no network",
    "AWS_IO_TLS_NEGOTIATION_TIMEOUT": "the endpoint accepts connections but does not answer",
    _TLS_FAILED: "TLS failed",
    "AWS_ERROR_MQTT5_PING_RESPONSE_TIMEOUT": "the broker no longer answers",
    _HUNG_UP: "the broker or the network closed the connection",
    _CLOSED: "the broker or the network closed the connection",
}
_ADVICE = (
    "The queue keeps what is recorded meanwhile, as long as it has room. `iort-agent check` says more. "
    "The agent tries again within minutes, and at once when certificate, private_key or root_ca is replaced"
)


def why_not_connected(
    data: Any,
    *,
    client_id: str,
    validity: Callable[[], Validity | None],
    now_us: int,
    hung_up: Callable[..., Hangups],
) -> Cause:
    """Explain why a connection failed.

    ``validity`` reads the validity of the robot's certificate (None: it cannot be read), and is called only
    if the certificate may be the cause. ``now_us`` is the robot's clock. ``hung_up`` tells whether the broker
    disconnects again and again, or refuses (`iort_agent.mqtt.reconnect.Causes.hung_up`).
    """
    packet = data.connack_packet
    code = packet.reason_code if packet is not None else None
    name = error_name(data.exception)
    words = said(packet) if code is not None else explain(data.exception)
    suspicious = code in _REFUSALS or name in (_TLS_FAILED, _HUNG_UP, _CLOSED)
    if suspicious and (invalid := _invalid(validity(), now_us)) is not None:
        return Cause("validity", f"{invalid} ({words}). {_ADVICE}", slow=True)
    if code in _REFUSALS:
        text = (
            f"{words}: the certificate is not active, not attached to a thing named {client_id}, "
            f"or its policy does not let it connect. {_ADVICE}"
        )
        return Cause("refused", text, slow=True)
    if suspicious:
        hangups = hung_up(before_tls=name == _CLOSED)
        if not hangups.often:
            # One cause, whether TLS had begun or not.
            return Cause("hangup", words)
        if hangups.refused and name == _TLS_FAILED:
            text = f"{words}: the broker's certificate does not fit root_ca, or the broker refuses ours"
        else:
            text = (
                f"{words}, again and again: it may be restarting, or the robot's certificate is unknown, "
                "inactive or revoked"
            )
        # Before TLS, the broker may just as well be down behind a proxy.
        kind = f"hangup {name if hangups.refused else _CLOSED}"
        return Cause(kind, f"{text}. {_ADVICE}", slow=hangups.refused)
    return Cause(words, words)


def _invalid(validity: Validity | None, now_us: int) -> str | None:
    """Why the certificate is not valid by the robot's clock; None if it is, or if its validity is unknown."""
    if validity is None:
        return None
    now_s = now_us // 1_000_000
    if now_s > validity.not_after_s:
        day = time.strftime("%Y-%m-%d", time.gmtime(validity.not_after_s))
        return f"the robot's certificate expired on {day}; get a new one with `iort-agent provision`"
    if now_s < validity.not_before_s:
        today = time.strftime("%Y-%m-%d", time.gmtime(now_s))
        return f"the robot's certificate is not valid yet: its clock says {today}; set the clock"
    return None


def said(packet: Any) -> str:
    """The reason that a CONNACK, DISCONNECT or PUBACK gives."""
    reason = f", {packet.reason_string}" if packet.reason_string else ""
    return f"the broker says {code_name(packet.reason_code)}{reason}"


def code_name(code: Any) -> str:
    """A reason code in words."""
    return str(getattr(code, "name", code)).replace("_", " ").lower()


def explain(error: Any) -> str:
    """The client's error, explained if it is a known one."""
    name = error_name(error)
    hint = _HINTS.get(name)
    return f"{hint} ({name})" if hint else f"{name}: {getattr(error, 'message', error)}"


def error_name(error: Any) -> str:
    """The client's name of an error."""
    return str(getattr(error, "name", type(error).__name__))
