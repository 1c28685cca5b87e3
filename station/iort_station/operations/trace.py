"""The delay of live updates from the sample in the car to a subscriber, hop by hop.

A hop starts and ends by the clock of the car, AWS, PubNub or this machine. The measured offset between two
clocks is subtracted, and its uncertainty is reported."""

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

# timestamp() in a rule cuts off the microseconds; adding half a millisecond leaves this uncertainty.
_STAMP_US = 500
_TRIES = 8
_ANSWER_S = 5.0


class ClockOffset(NamedTuple):
    """The microseconds to add to one clock to get another, and their uncertainty."""

    offset_us: float
    uncertainty_us: float


class Times(NamedTuple):
    """The times of one update at each place, in microseconds since the epoch by the place's clock. An update
    from the broker was at neither rule nor Lambda 1, and PubNub's time is 0."""

    sample_us: int
    sent_us: int
    rule_us: int | None
    lambda_us: int | None
    pubnub_us: int
    here_us: int
    car_to_cloud_us: int | None


@dataclass(frozen=True)
class Hop:
    """The delays of one hop over many updates; ``uncertainty_ms`` is None for clocks that nobody compared."""

    name: str
    p50_ms: float
    p95_ms: float
    uncertainty_ms: float | None


@dataclass(frozen=True)
class Trace:
    """The hops in order, their sum, and the car's newest round trips."""

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
BROKER = "car to this subscriber, by the broker"


def times(update: Mapping[str, Any], pubnub_us: int, here_us: int) -> Times:
    """The times that an update carries; raises `ContractError` for anything else."""
    heard = decode_live_update(update)
    return Times(
        sample_us=heard.live.t_us,
        sent_us=heard.live.sent_us,
        rule_us=None if heard.received_ms is None else heard.received_ms * 1000 + _STAMP_US,
        lambda_us=heard.lambda_us,
        pubnub_us=pubnub_us,
        here_us=here_us,
        car_to_cloud_us=heard.live.offset_us,
    )


def clock_of(theirs_us: Callable[[], int], ours_us: Callable[[], int]) -> ClockOffset:
    """The offset from our clock to another by Cristian's method: the fastest of several requests."""
    found = []
    for _ in range(_TRIES):
        sent = ours_us()
        their = theirs_us()
        received = ours_us()
        found.append(ClockOffset(their - (sent + received) / 2, (received - sent) / 2))
    return min(found, key=lambda clock: clock.uncertainty_us)


@contextmanager
def pubnub_clock(origin: str, *, tls: bool) -> Iterator[Callable[[], int]]:
    """Yield a function that asks PubNub for its time in microseconds; raises `StationError`."""
    kind = http.client.HTTPSConnection if tls else http.client.HTTPConnection

    def ask() -> int:
        connection.request("GET", "/time/0")
        return int(json.loads(connection.getresponse().read())[0]) // 10

    with closing(kind(origin, timeout=_ANSWER_S)) as connection:
        try:
            connection.connect()
            yield ask
        except (OSError, http.client.HTTPException, ValueError) as error:
            raise StationError(f"PubNub's time cannot be read: {error}") from error


def trace(
    updates: Sequence[Times],
    *,
    here_to_pubnub: ClockOffset | None,
    car_uncertainty_ms: float | None,
    newest_rtt: Batch | None = None,
) -> Trace:
    """Summarise at least one update, from PubNub or, without ``here_to_pubnub``, from the broker.

    ``car_uncertainty_ms`` is the agent's own metric.
    """
    known = all(one.car_to_cloud_us is not None for one in updates)
    here = here_to_pubnub
    delays: dict[str, list[float]] = {CAR: [one.sent_us - one.sample_us for one in updates]}
    uncertain: dict[str, float | None] = {CAR: 0.0}
    if here is None:
        delays[BROKER] = [one.here_us - one.sent_us - (one.car_to_cloud_us or 0) for one in updates]
        # Nobody compares this machine's clock with AWS'; both are set by NTP.
        uncertain[BROKER] = None
    else:
        _by_pubnub(updates, here, delays)
        uncertain |= {
            RULE: car_uncertainty_ms if known else None,
            LAMBDA: _STAMP_US / 1000,
            # Nobody compares the clocks of AWS and PubNub, which are both set by NTP.
            PUBNUB: None,
            HERE: here.uncertainty_us / 1000,
        }
    whole = [sum(parts) for parts in zip(*delays.values(), strict=True)]
    # In the sum, only the offsets of the car's clock and of ours remain.
    compared = known and car_uncertainty_ms is not None and here is not None
    ends = (car_uncertainty_ms or 0.0) + here.uncertainty_us / 1000 if compared and here else None
    return Trace(
        updates=len(updates),
        hops=[_hop(name, values, uncertain[name]) for name, values in delays.items()],
        whole=_hop("sample to this subscriber", whole, ends),
        round_trips_ms=round_trips_ms(newest_rtt),
    )


def _by_pubnub(updates: Sequence[Times], here: ClockOffset, delays: dict[str, list[float]]) -> None:
    for one in updates:
        rule_us, lambda_us = one.rule_us or 0, one.lambda_us or 0
        delays.setdefault(RULE, []).append(rule_us - one.sent_us - (one.car_to_cloud_us or 0))
        delays.setdefault(LAMBDA, []).append(lambda_us - rule_us)
        delays.setdefault(PUBNUB, []).append(one.pubnub_us - lambda_us)
        delays.setdefault(HERE, []).append(one.here_us + here.offset_us - one.pubnub_us)


def round_trips_ms(newest: Batch | None) -> dict[str, float]:
    """The median round trip of each path in a batch of stream ``rtt``."""
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
