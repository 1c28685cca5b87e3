"""Why a connection to the broker failed, what the person at the robot should check, and when to try again.

The agent makes at most one attempt a second, with full jitter. How long it waits depends on the cause: AWS
counts and throttles the attempts of a refused robot, while one that drives back into its Wi-Fi must be there
within seconds. Each cause is logged once, and again only after another cause or a connection.
"""

from __future__ import annotations

import random
import time
from typing import Any, Callable, NamedTuple

from iort_agent.identity import Validity

# A connection that held for longer than this resets the backoff.
SETTLED_S = 10.0
# A broker that disconnects without an answer may be restarting. After so many in a row it is a refusal.
HANGUPS = 3
_TLS_FAILED = "AWS_IO_TLS_ERROR_NEGOTIATION_FAILURE"
_HUNG_UP = "AWS_ERROR_MQTT_UNEXPECTED_HANGUP"
_CLOSED = "AWS_IO_SOCKET_CLOSED"
# CONNACK codes that only a person can change.
_CLIENT_ID_NOT_VALID, _BAD_USER_NAME, _NOT_AUTHORIZED, _BANNED = 0x85, 0x86, 0x87, 0x8A
_REFUSALS = frozenset({_CLIENT_ID_NOT_VALID, _BAD_USER_NAME, _NOT_AUTHORIZED, _BANNED})
# Explanations of the client's error names.
_HINTS = {
    "AWS_IO_DNS_INVALID_NAME": "the endpoint's name does not resolve",
    "AWS_IO_DNS_QUERY_FAILED": "the endpoint's name does not resolve",
    "AWS_IO_DNS_NO_ADDRESS_FOR_HOST": "the endpoint's name does not resolve",
    "AWS_IO_SOCKET_CONNECTION_REFUSED": "nothing listens at the endpoint's port",
    "AWS_IO_SOCKET_TIMEOUT": "the endpoint does not answer",
    "AWS_IO_SOCKET_NO_ROUTE_TO_HOST": "there is no network",
    "AWS_IO_SOCKET_NETWORK_DOWN": "there is no network",
    "AWS_IO_TLS_NEGOTIATION_TIMEOUT": "the endpoint accepts connections but does not answer",
    _TLS_FAILED: "TLS failed",
    "AWS_ERROR_MQTT5_PING_RESPONSE_TIMEOUT": "the broker no longer answers",
    _HUNG_UP: "the broker or the network closed the connection",
    _CLOSED: "the broker or the network closed the connection",
}
_UNREACHED = frozenset(
    {
        "AWS_IO_DNS_INVALID_NAME",
        "AWS_IO_DNS_QUERY_FAILED",
        "AWS_IO_DNS_NO_ADDRESS_FOR_HOST",
        "AWS_IO_SOCKET_TIMEOUT",
        "AWS_IO_SOCKET_NO_ROUTE_TO_HOST",
        "AWS_IO_SOCKET_NETWORK_DOWN",
    }
)
_ADVICE = (
    "The queue keeps what is recorded meanwhile, as long as it has room. `iort-agent check` says more. "
    "The agent tries again within minutes, and at once when certificate, private_key or root_ca is replaced"
)


class Pace(NamedTuple):
    """The shortest and the longest wait between attempts. ``person``: a person must act, or may have to."""

    shortest_s: float
    longest_s: float
    person: bool = False


SHORTEST_S = 1.0
# No attempt reaches the broker, so none is a load for it.
UNREACHED = Pace(SHORTEST_S, 5.0)
UNSTEADY = Pace(SHORTEST_S, 30.0)
# TLS ends without a reason, again and again: a refusal, or a network that resets connections.
DOUBTFUL = Pace(5.0, 60.0, person=True)
REFUSED = Pace(60.0, 300.0, person=True)
# A fleet that gets its network back at once spreads its attempts over so long.
CAME_BACK_S = 2.0


class Cause(NamedTuple):
    """Why the connection failed. ``kind`` identifies the cause."""

    kind: str
    text: str
    pace: Pace = UNSTEADY


class Hangups(NamedTuple):
    """Disconnects without an answer: whether they came again and again, and whether they are a refusal."""

    often: bool
    refused: bool


class Backoff:
    """The wait before the next attempt: random between a floor and a ceiling that doubles."""

    def __init__(self, chance: random.Random | None = None) -> None:
        self._chance = chance or random.Random()  # noqa: S311 - jitter, not secrets
        self._attempts = 0
        self._pace = UNSTEADY
        # Waits in a row that a network has shortened, and whether this is one.
        self._shortened, self._came = 0, False

    def reset(self) -> None:
        """Start with short waits again."""
        self._attempts = self._shortened = 0
        self._came = False

    def next_s(self, pace: Pace = UNSTEADY) -> float:
        """Seconds to wait. The first wait has jitter, too; otherwise a fleet would reconnect all at once."""
        self._shortened, self._came = self._shortened + 1 if self._came else 0, False
        if pace != self._pace:
            self._pace, self._attempts = pace, 0
        self._attempts = min(self._attempts + 1, 16)
        ceiling = min(pace.longest_s, pace.shortest_s * 2.0**self._attempts)
        return pace.shortest_s + self._chance.random() * (ceiling - pace.shortest_s)

    def came_back_s(self, pace: Pace, since_s: float) -> float:
        """Seconds to wait once a network has come, ``since_s`` after the last attempt. One that comes again
        and again, as where containers start, and is of no help, is waited for twice as long each time."""
        self._came = True
        shortest_s = min(pace.longest_s, pace.shortest_s * 2.0 ** min(self._shortened, 16))
        return max(shortest_s - since_s, self._chance.random() * CAME_BACK_S)


class Causes:
    """Remembers the last logged cause, and counts disconnects without an answer."""

    def __init__(self) -> None:
        self._logged: str | None = None
        self._hangups = self._in_tls = 0

    def connected(self) -> None:
        """Forget everything: the next cause is news."""
        self._logged = None
        self._hangups = self._in_tls = 0

    def is_news(self, cause: Cause) -> bool:
        """Whether the cause differs from the last one."""
        news, self._logged = cause.kind != self._logged, cause.kind
        return news

    def hung_up(self, *, before_tls: bool) -> Hangups:
        """Count a disconnect without an answer.

        Only those during TLS, in a row, are a refusal: a proxy without a broker behind it resets connections,
        some of them while TLS begins, which the client reports as a failure of TLS.
        """
        self._hangups += 1
        self._in_tls = 0 if before_tls else self._in_tls + 1
        return Hangups(self._hangups >= HANGUPS, self._in_tls >= HANGUPS)


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
    disconnects again and again, or refuses (`iort_agent.mqtt.failures.Causes.hung_up`).
    """
    packet = data.connack_packet
    code = packet.reason_code if packet is not None else None
    name = error_name(data.exception)
    words = said(packet) if code is not None else explain(data.exception)
    suspicious = code in _REFUSALS or name in (_TLS_FAILED, _HUNG_UP, _CLOSED)
    if suspicious and (invalid := _invalid(validity(), now_us)) is not None:
        return Cause("validity", f"{invalid} ({words}). {_ADVICE}", REFUSED)
    if code in _REFUSALS:
        text = (
            f"{words}: the certificate is not active, not attached to a thing named {client_id}, "
            f"or its policy does not let it connect. {_ADVICE}"
        )
        return Cause("refused", text, REFUSED)
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
        return Cause(kind, f"{text}. {_ADVICE}", DOUBTFUL if hangups.refused else UNSTEADY)
    return Cause(words, words, UNREACHED if name in _UNREACHED else UNSTEADY)


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
