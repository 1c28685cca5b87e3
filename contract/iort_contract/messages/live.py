"""The live lane, which carries the newest sample; pings, which measure delays;
and leases of viewers, for whom it sends more.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Mapping, NamedTuple

from iort_contract.checks import (
    COMPACT,
    MAX_SEQ,
    check_header,
    check_id,
    check_time,
    check_version,
    integer,
    json_object,
    offset_entry,
    shown,
    text,
    whole_number,
    wire_column,
    wire_sample,
)
from iort_contract.limits import (
    LIVE_MAX_RATE_HZ,
    LIVE_MIN_RATE_HZ,
    MAX_FIELDS,
    MAX_NEXT_MS,
    SCHEMA_VERSION,
    ContractError,
    Value,
)
from iort_contract.messages.envelope import codec, read, to_json
from iort_contract.tables import NONFINITE, RECEIVED_MS, ROBOT, T_US
from iort_contract.topics import VIEW, build_topic, check_robot, check_stream


@dataclass(frozen=True)
class LiveSample:
    """The newest sample of a stream, as the live lane carries it.

    ``seq`` numbers the stream's live messages of a run. ``t_us`` is the sample's time, ``sent_us`` the time
    it left the car. ``sample`` maps field to value, in an object of its own, so that no ROS field can be
    mistaken for one of ours; a rule filters on ``sample.fault_code``. ``offset_us`` converts the car's clock
    to the cloud's by addition, if the car knows it to within `CLOCK_MAX_UNCERTAINTY_MS`. Within ``next_ms``
    the stream's next message leaves the car, if it has samples; an older agent does not say.
    """

    boot: str
    seq: int
    t_us: int
    sent_us: int
    sample: Mapping[str, Value]
    nonfinite: int = 0
    offset_us: int | None = None
    next_ms: int | None = None


def encode_live(live: LiveSample) -> bytes:
    """The live message as JSON; NaN and infinities become null and are counted."""
    if len(live.sample) > MAX_FIELDS:
        raise ContractError(f"sample must have at most {MAX_FIELDS} fields, got {len(live.sample)}")
    sample, nulled = wire_sample(live.sample)
    nonfinite = live.nonfinite + nulled
    check_header(live.boot, live.seq, nonfinite)
    message = {
        "v": SCHEMA_VERSION,
        "boot": live.boot,
        "seq": live.seq,
        T_US: check_time(live.t_us, "sample time"),
        "sent_us": check_time(live.sent_us, "sent_us"),
        NONFINITE: nonfinite,
        **offset_entry(live.offset_us),
        **_next_entry(live.next_ms),
        "sample": sample,
    }
    return COMPACT.encode(message).encode()


def decode_live(message: bytes | str | Mapping[str, Any]) -> LiveSample:
    """Decode a live message; raises `ContractError` for everything that `encode_live` cannot write."""
    envelope = message if isinstance(message, Mapping) else json_object(message, "live message")
    check_version(envelope)
    live = read(LiveSample, {NONFINITE: None, **envelope})
    check_header(live.boot, live.seq, live.nonfinite)
    if len(live.sample) > MAX_FIELDS:
        raise ContractError(f"sample must have at most {MAX_FIELDS} fields, got {len(live.sample)}")
    if wire_sample(live.sample)[1]:
        odd = next(name for name, value in live.sample.items() if wire_column(name, (value,))[1])
        raise ContractError(f"field {odd}: numbers must be finite")
    check_time(live.t_us, "sample time")
    check_time(live.sent_us, "sent_us")
    offset_entry(live.offset_us)
    _next_entry(live.next_ms)
    return live


def silent_s(next_ms: int | None) -> float:
    """How long a stream may be silent after a message, as far as the message says: that long and `STALE_S`
    later it is stale, that long and `GONE_S` later its car is gone."""
    return 0.0 if next_ms is None else next_ms / 1000


def _next_entry(next_ms: Any) -> dict[str, int]:
    if next_ms is None:
        return {}
    return {"next_ms": whole_number("next_ms", next_ms, 1, MAX_NEXT_MS)}


def live_update(
    robot: str,
    stream: str,
    live: LiveSample,
    received_ms: int | None = None,
    lambda_us: int | None = None,
) -> dict[str, Any]:
    """Lambda 1's message to PubNub: the sample, the time of every hop so far and, if the car knows it, the
    clock offset that converts the car's times to the cloud's. A sample from the broker has no hop before."""
    hops = {"sent_us": live.sent_us}
    if received_ms is not None and lambda_us is not None:
        hops.update({RECEIVED_MS: received_ms, "lambda_us": lambda_us})
    return {
        "v": SCHEMA_VERSION,
        ROBOT: robot,
        "stream": stream,
        "boot": live.boot,
        "seq": live.seq,
        T_US: live.t_us,
        **_next_entry(live.next_ms),
        "hops": {**hops, **offset_entry(live.offset_us)},
        "sample": dict(live.sample),
    }


class LiveUpdate(NamedTuple):
    """A live sample as a subscriber receives it. From PubNub it has the cloud's times of receipt and of
    sending; from the broker it has none."""

    robot: str
    stream: str
    live: LiveSample
    received_ms: int | None
    lambda_us: int | None


def decode_live_update(message: Any) -> LiveUpdate:
    """Decode a `live_update`; raises `ContractError` for anything else."""
    if not isinstance(message, Mapping) or not isinstance(message.get("hops"), Mapping):
        raise ContractError(f"live update must be an object with hops, got {shown(message)}")
    hops = message["hops"]
    times = {name: hops[name] for name in ("sent_us", "offset_us") if name in hops}
    live = decode_live({**message, NONFINITE: 0, **times})
    by_lambda = RECEIVED_MS in hops or "lambda_us" in hops
    return LiveUpdate(
        robot=check_robot(text(message, ROBOT)),
        stream=check_stream(text(message, "stream")),
        live=live,
        received_ms=integer(hops, RECEIVED_MS) if by_lambda else None,
        lambda_us=check_time(integer(hops, "lambda_us"), "lambda_us") if by_lambda else None,
    )


def encode_ping(ping_id: int, sent_us: int, padding: str = "") -> bytes:
    """A ping; the pong repeats it and adds the cloud's ``received_ms``."""
    whole_number("ping id", ping_id, 0, MAX_SEQ)
    ping = {"v": SCHEMA_VERSION, "id": ping_id, "sent_us": check_time(sent_us, "sent_us")}
    return to_json({**ping, "padding": padding} if padding else ping)


class Pong(NamedTuple):
    """The answer to a ping; ``received_ms`` is None on the broker path, which runs no code in the cloud."""

    id: int
    sent_us: int
    received_ms: int | None = None


def decode_pong(message: bytes | str) -> Pong:
    """Decode a pong, or a ping that came straight back; raises `ContractError` otherwise."""
    pong = read(Pong, json_object(message, "pong"))
    if pong.received_ms is not None:
        check_time(pong.received_ms * 1000, RECEIVED_MS)
    return pong


# The longest lease: what a viewer costs that ends without a word.
VIEW_LEASE_MS = 15_000
# How often a viewer renews, so that two renewals may get lost.
VIEW_RENEW_S = 5.0
# Viewers of a robot with a lease of their own.
MAX_VIEWERS = 32
# The last level of the topic.
LEASE = "lease"


@dataclass(frozen=True)
class Lease:
    """One viewer's wish. ``viewer`` names it, at random. The robot sends each stream up to ``rate_hz`` times
    a second for ``lease_ms`` from the message's arrival; 0 ends the lease. With ``broker`` the viewer listens
    at the broker, so every message goes there; without, it listens at PubNub."""

    viewer: str
    rate_hz: float
    lease_ms: int
    broker: bool = False


def lease_topic(robot: str, namespace: str) -> str:
    """The topic of a robot's leases."""
    return build_topic(VIEW, robot, LEASE, namespace)


def _check(lease: Lease) -> None:
    check_id(lease.viewer, "viewer")
    if not LIVE_MIN_RATE_HZ <= lease.rate_hz <= LIVE_MAX_RATE_HZ:
        raise ContractError(
            f"rate_hz must be {LIVE_MIN_RATE_HZ:g} to {LIVE_MAX_RATE_HZ:g}, got {shown(lease.rate_hz)}"
        )
    whole_number("lease_ms", lease.lease_ms, 0, VIEW_LEASE_MS)


encode_lease, decode_lease = codec(Lease, "lease", _check)
