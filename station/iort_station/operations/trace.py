"""Where the time goes: a live update's way from the sample in the car to a subscriber, hop by hop.

Each hop begins and ends by a clock: the car's, AWS', PubNub's or ours. Where two clocks meet, the
difference that was measured is taken off, and what it may be wrong by is said.
"""

from __future__ import annotations

import http.client
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from statistics import quantiles
from typing import Any, NamedTuple

from iort_contract.catalog.streams import RTT_FIELDS
from iort_contract.messages.batch import Batch
from iort_contract.messages.live import decode_live_update
from iort_contract.topics import PING_PATHS
from iort_station.errors import StationError

# timestamp() in a rule is whole milliseconds, cut off: the middle is wrong by half of one at most.
_STAMP_US = 500
_TRIES = 8
_ANSWER_S = 5.0


class Clock(NamedTuple):
    """What to add to a clock to have another, in microseconds, and by how much that may be wrong."""

    offset_us: float
    uncertainty_us: float


class Times(NamedTuple):
    """When one update was where, in microseconds since the epoch, each by the clock of its place."""

    sample_us: int
    sent_us: int
    rule_us: int
    lambda_us: int
    pubnub_us: int
    here_us: int
    car_to_cloud_us: int | None


@dataclass(frozen=True)
class Hop:
    """One hop of many updates: milliseconds, and by how much the clocks may falsify them.

    ``uncertainty_ms`` is None where two clocks are compared as they are.
    """

    name: str
    p50_ms: float
    p95_ms: float
    uncertainty_ms: float | None


@dataclass(frozen=True)
class Trace:
    """The hops in order, what they sum to, and the round trips that the car itself measured last."""

    updates: int
    hops: list[Hop]
    whole: Hop
    round_trips_ms: dict[str, float]


CAR, RULE, LAMBDA, PUBNUB, HERE = (
    "in the car: sample to sent",
    "car to broker and rule",
    "rule to Lambda 1",
    "Lambda 1 to PubNub",
    "PubNub to this subscriber",
)


def times(update: Mapping[str, Any], pubnub_us: int, here_us: int) -> Times:
    """The times that an update carries; raises `ContractError` for anything else."""
    heard = decode_live_update(update)
    return Times(
        sample_us=heard.live.t_us,
        sent_us=heard.live.sent_us,
        rule_us=heard.received_ms * 1000 + _STAMP_US,
        lambda_us=heard.lambda_us,
        pubnub_us=pubnub_us,
        here_us=here_us,
        car_to_cloud_us=heard.live.offset_us,
    )


def clock_of(theirs_us: Callable[[], int], ours_us: Callable[[], int]) -> Clock:
    """Our clock against another that answers, by Cristian's method: the fastest of some tries."""
    found = []
    for _ in range(_TRIES):
        sent = ours_us()
        their = theirs_us()
        received = ours_us()
        found.append(Clock(their - (sent + received) / 2, (received - sent) / 2))
    return min(found, key=lambda clock: clock.uncertainty_us)


@contextmanager
def pubnub_clock(origin: str, *, tls: bool) -> Iterator[Callable[[], int]]:
    """Asks PubNub for its time, in microseconds, over one connection; raises `StationError`."""
    kind = http.client.HTTPSConnection if tls else http.client.HTTPConnection

    def ask() -> int:
        connection.request("GET", "/time/0")
        return int(json.loads(connection.getresponse().read())[0]) // 10

    with closing(kind(origin, timeout=_ANSWER_S)) as connection:
        try:
            connection.connect()
            yield ask
        except (OSError, http.client.HTTPException, ValueError) as error:
            raise StationError(f"PubNub does not say its time: {error}") from error


def trace(
    updates: Sequence[Times],
    *,
    here_to_pubnub: Clock,
    car_uncertainty_ms: float | None,
    newest_rtt: Batch | None = None,
) -> Trace:
    """Put updates together; at least one. ``car_uncertainty_ms`` is what the agent says of its offset."""
    known = all(one.car_to_cloud_us is not None for one in updates)
    here = here_to_pubnub
    legs: dict[str, list[float]] = {
        CAR: [one.sent_us - one.sample_us for one in updates],
        RULE: [one.rule_us - one.sent_us - (one.car_to_cloud_us or 0) for one in updates],
        LAMBDA: [one.lambda_us - one.rule_us for one in updates],
        PUBNUB: [one.pubnub_us - one.lambda_us for one in updates],
        HERE: [one.here_us + here.offset_us - one.pubnub_us for one in updates],
    }
    uncertain: dict[str, float | None] = {
        CAR: 0.0,
        RULE: car_uncertainty_ms if known else None,
        LAMBDA: _STAMP_US / 1000,
        # AWS' clock and PubNub's are both set by NTP; nobody measures one against the other.
        PUBNUB: None,
        HERE: here.uncertainty_us / 1000,
    }
    whole = [sum(parts) for parts in zip(*legs.values(), strict=True)]
    # What one hop takes from its neighbour falls out of the whole, but for the car's clock and ours.
    ends = (
        None if not known or car_uncertainty_ms is None else car_uncertainty_ms + here.uncertainty_us / 1000
    )
    return Trace(
        updates=len(updates),
        hops=[_hop(name, values, uncertain[name]) for name, values in legs.items()],
        whole=_hop("sample to this subscriber", whole, ends),
        round_trips_ms=round_trips_ms(newest_rtt),
    )


def round_trips_ms(newest: Batch | None) -> dict[str, float]:
    """The median round trip of each path in a batch of the stream ``rtt``."""
    found: dict[str, float] = {}
    if newest is None:
        return found
    for path in PING_PATHS:
        column = newest.columns.get(RTT_FIELDS[path], ())
        values = sorted(float(value) for value in column if isinstance(value, (int, float)))
        if values:
            found[path] = values[len(values) // 2]
    return found


def _hop(name: str, values_us: Sequence[float], uncertainty_ms: float | None) -> Hop:
    percents = quantiles(values_us, n=100, method="inclusive") if len(values_us) > 1 else [values_us[0]] * 99
    return Hop(name, round(percents[49] / 1000, 3), round(percents[94] / 1000, 3), uncertainty_ms)
