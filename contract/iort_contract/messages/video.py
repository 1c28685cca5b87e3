"""Video for driving by sight: what a viewer asks a robot for, what the robot answers, and which picture a
driver saw.

A viewer asks on the topic of `look_topic`, and hears the answers on `answer_topic`, whose last level nobody
else knows. Pictures come by WebRTC. There the viewer opens a data channel with the label `CHANNEL`: the
robot sends the `Mark` of each picture, and answers pings with its clock, so that the age of a picture needs
no other clock. Without WebRTC a viewer asks for small pictures over the broker (`picture_topic`), as JPEG
behind their mark.

All of these are on the lane `VIEW`, which no rule reads: no function runs for a picture, and the page of
everybody hears none."""

from __future__ import annotations

import struct
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple, Sequence

from iort_contract.checks import check_id, check_time, json_object, shown, whole_number
from iort_contract.limits import MAX_MESSAGE_BYTES, ContractError
from iort_contract.messages.envelope import codec, read
from iort_contract.messages.live import VIEW_LEASE_MS
from iort_contract.topics import VIEW, build_topic

# A picture older than this ends driving, unless car.yaml has another limit.
PICTURE_MAX_AGE_MS = 500
# Viewers by WebRTC; each costs the robot's uplink the whole bitrate. One more is refused.
MAX_VIDEO_VIEWERS = 8
# An offer of a browser has some 3 kB; with many network interfaces and relays some more.
MAX_SDP_BYTES = 32 * 1024
MAX_LOOK_BYTES = 40 * 1024
MAX_ICE_SERVERS = 8
MAX_URL_CHARACTERS, MAX_SECRET_CHARACTERS = 512, 1024
# The label of the data channel, and how many of the newest marks a message on it repeats: messages may be
# lost.
CHANNEL, MARKS_REPEATED = "frames", 4
# How often a viewer asks for the robot's clock, and how long it believes the best answer: clocks drift.
ECHO_EVERY_MS, ECHO_KEPT_MS = 1_000, 30_000

# The topics' last levels; a viewer's own name follows `TO`.
VIDEO, PICTURE, TO = "video", "picture", "to-"

# What a viewer asks: what the robot can show, a WebRTC session by an offer, pictures over the broker, to
# keep what it
# has, to end it.
ASK, OFFER, PICTURES, KEEP, END = "ask", "offer", "pictures", "keep", "end"
LOOKS = (ASK, OFFER, PICTURES, KEEP, END)
# What a robot answers: what it can show, its half of a session, why not, and that a session has ended.
TERMS, ANSWER, REFUSED, ENDED = "terms", "answer", "refused", "ended"
SHOWS = (TERMS, ANSWER, REFUSED, ENDED)


@dataclass(frozen=True)
class IceServer:
    """A STUN or TURN server. ``username`` and ``credential`` are a TURN server's."""

    urls: tuple[str, ...]
    username: str = ""
    credential: str = ""


@dataclass(frozen=True)
class Look:
    """What a viewer asks. ``viewer`` names it, at random; ``request`` names this request, and the answer
    repeats it. What the viewer has is kept for ``lease_ms`` from the message's arrival. ``sdp`` is an
    offer's session description, with all its candidates. ``ice_servers`` are the deployment's, which the
    robot may use too."""

    viewer: str
    request: str
    kind: str
    lease_ms: int = VIEW_LEASE_MS
    sdp: str = ""
    ice_servers: tuple[IceServer, ...] = ()


@dataclass(frozen=True)
class VideoTerms:
    """What a robot can show, in its shadow and to a viewer. A picture older than ``max_age_ms`` ends
    driving."""

    width: int
    height: int
    rate_hz: float
    max_age_ms: int = PICTURE_MAX_AGE_MS


@dataclass(frozen=True)
class Show:
    """A robot's answer to ``request``. ``why`` is for a human: why it shows nothing, or why a session ended.
    ``terms`` and ``ice_servers`` are in an answer of the kind `TERMS`, ``sdp`` in one of the kind `ANSWER`.
    """

    request: str
    kind: str
    why: str = ""
    sdp: str = ""
    terms: VideoTerms | None = None
    ice_servers: tuple[IceServer, ...] = ()


class Mark(NamedTuple):
    """A picture's number, which counts up in a run of the agent; its capture time by the robot's clock; and,
    in a WebRTC session, its RTP timestamp."""

    number: int
    captured_us: int
    rtp: int = 0


def look_topic(robot: str, namespace: str) -> str:
    """The topic on which viewers ask a robot."""
    return build_topic(VIEW, robot, VIDEO, namespace)


def answer_topic(robot: str, viewer: str, namespace: str) -> str:
    """The topic on which a robot answers one viewer."""
    return build_topic(VIEW, robot, f"{TO}{viewer}", namespace)


def picture_topic(robot: str, namespace: str) -> str:
    """The topic of a robot's pictures over the broker."""
    return build_topic(VIEW, robot, PICTURE, namespace)


def _servers(content: Any) -> tuple[IceServer, ...]:
    if not isinstance(content, (list, tuple)) or len(content) > MAX_ICE_SERVERS:
        raise ContractError(f"ice_servers must be a list of at most {MAX_ICE_SERVERS}, got {shown(content)}")
    servers = tuple(one if isinstance(one, IceServer) else read(IceServer, one) for one in content)
    for server in servers:
        if not 1 <= len(server.urls) <= MAX_ICE_SERVERS:
            raise ContractError(f"urls must be 1 to {MAX_ICE_SERVERS}, got {len(server.urls)}")
        for url in server.urls:
            if len(url) > MAX_URL_CHARACTERS or not url.startswith(("stun:", "turn:", "turns:")):
                raise ContractError(f"url must begin with stun:, turn: or turns:, got {shown(url)}")
        if max(len(server.username), len(server.credential)) > MAX_SECRET_CHARACTERS:
            raise ContractError(
                f"username and credential must have at most {MAX_SECRET_CHARACTERS} characters"
            )
    return servers


def check_terms(terms: VideoTerms) -> VideoTerms:
    """Return the terms, if they are valid; raises `ContractError`."""
    whole_number("width", terms.width, 16, 4096)
    whole_number("height", terms.height, 16, 4096)
    whole_number("max_age_ms", terms.max_age_ms, 1, 60_000)
    if not 0.1 <= terms.rate_hz <= 120:
        raise ContractError(f"rate_hz must be 0.1 to 120, got {shown(terms.rate_hz)}")
    return terms


def encode_terms(terms: VideoTerms | None) -> dict[str, Any]:
    """The terms as an object of the shadow; empty for a robot without video."""
    return asdict(terms) if terms is not None else {}


def decode_terms(document: Any) -> VideoTerms | None:
    """The terms from the shadow; None if the robot has none, or others than `check_terms` allows."""
    try:
        return check_terms(read(VideoTerms, document)) if document else None
    except ContractError:
        return None


def _check_sdp(sdp: str, *, needed: bool) -> None:
    size = len(sdp.encode(errors="replace"))
    if size > MAX_SDP_BYTES:
        raise ContractError(f"sdp must be at most {MAX_SDP_BYTES} bytes, got {size}")
    if bool(sdp) != needed:
        raise ContractError("sdp must be there" if needed else "sdp must be empty")


def _check_look(look: Look) -> None:
    check_id(look.viewer, "viewer")
    check_id(look.request, "request")
    if look.kind not in LOOKS:
        raise ContractError(f"kind must be one of {', '.join(LOOKS)}, got {shown(look.kind)}")
    whole_number("lease_ms", look.lease_ms, 0, VIEW_LEASE_MS)
    _check_sdp(look.sdp, needed=look.kind == OFFER)


def _check_show(show: Show) -> None:
    check_id(show.request, "request")
    if show.kind not in SHOWS:
        raise ContractError(f"kind must be one of {', '.join(SHOWS)}, got {shown(show.kind)}")
    _check_sdp(show.sdp, needed=show.kind == ANSWER)
    if show.kind == TERMS and show.terms is None:
        raise ContractError("terms must be there")


def _terms(content: Any) -> VideoTerms | None:
    return None if content is None else check_terms(read(VideoTerms, content))


encode_look, _decode_look = codec(Look, "look", _check_look, ice_servers=_servers)
encode_show, decode_show = codec(Show, "show", _check_show, ice_servers=_servers, terms=_terms)


def decode_look(payload: bytes) -> Look:
    """Decode a `Look`; raises `ContractError`, for a message beyond `MAX_LOOK_BYTES` before it is parsed."""
    if len(payload) > MAX_LOOK_BYTES:
        raise ContractError(f"look must be at most {MAX_LOOK_BYTES} bytes, got {len(payload)}")
    return _decode_look(json_object(payload, "look"))


# Binary messages begin with their kind. All numbers are big-endian; times are microseconds.
_MARKS, _PING, _ECHO, _JPEG = 1, 2, 3, 4
_MARK = struct.Struct(">IqI")
_ASKED = struct.Struct(">BI")
_ANSWERED = struct.Struct(">BIq")
_HEAD = struct.Struct(">BIqqq")
# An offset that the robot does not know.
_UNKNOWN = -(2**63)
MAX_JPEG_BYTES = MAX_MESSAGE_BYTES - _HEAD.size


def encode_marks(marks: Sequence[Mark]) -> bytes:
    """Marks as a message of the data channel, the newest last."""
    return bytes([_MARKS]) + b"".join(_MARK.pack(*mark) for mark in marks[-MARKS_REPEATED:])


def decode_marks(message: bytes) -> list[Mark]:
    """The marks in a message of the data channel; raises `ContractError` for another message."""
    if len(message) < 1 or message[0] != _MARKS or (len(message) - 1) % _MARK.size:
        raise ContractError(f"marks must begin with {_MARKS}, got {shown(message[:8])}")
    return [Mark(*values) for values in _MARK.iter_unpack(message[1:])]


def encode_ask_clock(number: int) -> bytes:
    """A viewer's question for the robot's clock, on the data channel."""
    return _ASKED.pack(_PING, number)


def answer_clock(message: bytes, now_us: int) -> bytes:
    """The answer to `encode_ask_clock`; raises `ContractError` for another message."""
    if len(message) != _ASKED.size or message[0] != _PING:
        raise ContractError(f"a question for the clock must begin with {_PING}, got {shown(message[:8])}")
    return _ANSWERED.pack(_ECHO, _ASKED.unpack(message)[1], now_us)


def decode_clock(message: bytes) -> tuple[int, int]:
    """The number of the question, and the robot's time; raises `ContractError` for another message."""
    if len(message) != _ANSWERED.size or message[0] != _ECHO:
        raise ContractError(f"an answer with the clock must begin with {_ECHO}, got {shown(message[:8])}")
    _, number, now_us = _ANSWERED.unpack(message)
    return number, now_us


class Picture(NamedTuple):
    """A picture over the broker. ``offset_us`` converts the robot's times to the cloud's, if it is known."""

    number: int
    captured_us: int
    sent_us: int
    offset_us: int | None
    jpeg: bytes


def encode_picture(picture: Picture) -> bytes:
    """A picture as a message; raises `ContractError` for one that is too large."""
    number, captured_us, sent_us, offset_us, jpeg = picture
    if not 1 <= len(jpeg) <= MAX_JPEG_BYTES:
        raise ContractError(f"a picture must have 1 to {MAX_JPEG_BYTES} bytes, got {len(jpeg)}")
    check_time(captured_us, "captured_us")
    offset = _UNKNOWN if offset_us is None else check_time(offset_us, "offset_us")
    return _HEAD.pack(_JPEG, number, captured_us, sent_us, offset) + jpeg


def decode_picture(message: bytes) -> Picture:
    """Decode a picture; raises `ContractError` for another message."""
    if len(message) <= _HEAD.size or message[0] != _JPEG:
        raise ContractError(f"a picture must begin with {_JPEG}, got {shown(message[:8])}")
    _, number, captured_us, sent_us, offset = _HEAD.unpack_from(message)
    return Picture(
        number, captured_us, sent_us, None if offset == _UNKNOWN else offset, message[_HEAD.size :]
    )
