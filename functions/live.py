"""Live: sends a car's newest sample from the live rule to the car's PubNub channel."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

from functions.shared.clients import variables
from functions.shared.metrics import Gathered, emit
from functions.shared.pubnub_client import NotConfiguredError, PublishError, StoredPublisher
from functions.shared.queues import quarantined
from functions.shared.quotas import RateLimiter
from iort_contract.catalog.environments import LiveEnvironment
from iort_contract.catalog.vesc import absent
from iort_contract.cloud import channel
from iort_contract.limits import LIVE_MAX_AGE_MS, ContractError
from iort_contract.messages.envelope import event_message
from iort_contract.messages.live import LiveSample, decode_live, live_update
from iort_contract.tables import RECEIVED_MS, TOPIC
from iort_contract.topics import parse_topic

_log = logging.getLogger(__name__)
_log.setLevel(logging.INFO)

# Malformed messages of a robot that are looked at: this many at once, and one more with every second. Each
# costs a call to the queue, a good one does not.
REFUSALS, REFUSALS_A_SECOND = 20, 1.0


class RefusedError(ContractError):
    """A live message that is malformed."""


@dataclass
class Lane:
    """The live lane in one environment of the function.

    ``fields`` are those on the dashboard, by stream; a stream not named sends all. ``publish`` sends to
    PubNub.
    """

    fields: Mapping[str, list[str]]
    publish: Callable[[str, dict[str, Any]], None]
    counted: Gathered = field(default_factory=lambda: Gathered("live"))
    refusals: RateLimiter = field(
        default_factory=lambda: RateLimiter(burst=REFUSALS, a_second=REFUSALS_A_SECOND)
    )

    def serve(self, event: Any, now_us: int) -> None:
        """`show` a message.

        While a robot's refusals are used up, its messages are skipped, good or bad. About one a second is
        still looked at, so that a repaired robot is seen again at once.
        """
        robot, now_s = _robot(event), now_us / 1e6
        if self.refusals.left(robot, now_s) < 1:
            self.counted.add(now_s, LiveCutOff=1)
            return
        try:
            self.show(event, now_us)
        except RefusedError as error:
            if self.refusals.spend(robot, now_s, 1) >= 1:
                raise
            _log.warning("live messages of %s are skipped for a while", robot)
            more = "so many were refused that the next are not looked at, metric LiveCutOff"
            raise RefusedError(f"{error}; {more}") from error

    def show(self, event: Mapping[str, Any], now_us: int) -> None:
        """Publish one live message, or count why not. A live message is never retried.

        Failures are logged at once; everything else is gathered. Raises `RefusedError` for a malformed one.
        """
        try:
            topic = parse_topic(event[TOPIC])
            live = decode_live(event_message(event))
            received_ms = int(event[RECEIVED_MS])
        except (ContractError, AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
            emit("live", LiveRefused=1)
            raise RefusedError(f"{type(error).__name__}: {error}") from error
        # Without the car's clock offset, neither the network's delay nor the total is known.
        uplink_ms = way_ms = 0.0
        if live.offset_us is not None:
            uplink_ms = max(0.0, received_ms - (live.sent_us + live.offset_us) / 1000)
            way_ms = max(0.0, (now_us - live.sent_us - live.offset_us) / 1000)
        if age_ms(live, received_ms, now_us) > LIVE_MAX_AGE_MS:
            # Stale messages are late ones: the alarm must count them, or it would never go off.
            self.counted.add(now_us / 1e6, LiveStale=1, CarToLambdaMs=way_ms)
            return
        chosen = self.fields.get(topic.name, live.sample)
        picked = {
            name: None if absent(name, value) else value
            for name, value in live.sample.items()
            if name in chosen
        }
        update = live_update(topic.robot, topic.name, replace(live, sample=picked), received_ms, now_us)
        try:
            self.publish(channel(topic.robot, topic.namespace), update)
        except NotConfiguredError:
            # Nobody is missing it: the deployment has the lane, and no keys yet.
            self.counted.add(now_us / 1e6, LiveNotConfigured=1)
            return
        except PublishError as error:
            _log.warning("not published for %s: %s", topic.robot, error)
            emit("live", PubNubFailed=1)
            return
        self.counted.add(
            now_us / 1e6,
            LivePublished=1,
            InCarMs=max(0.0, (live.sent_us - live.t_us) / 1000),
            UplinkMs=uplink_ms,
            ToLambdaMs=max(0.0, now_us / 1000 - received_ms),
            CarToLambdaMs=way_ms,
        )


def age_ms(live: LiveSample, received_ms: int, now_us: int) -> float:
    """How old a sample is.

    A car that knows its clock offset sends it in the message, so the whole way is measured on one clock. For
    other cars the age is the time in the car plus the time in the cloud, each by its own clock.
    """
    if live.offset_us is not None:
        return (now_us - live.t_us - live.offset_us) / 1000
    return (live.sent_us - live.t_us + now_us) / 1000 - received_ms


def _robot(event: Any) -> str:
    topic = event.get(TOPIC) if isinstance(event, Mapping) else None
    levels = topic.split("/") if isinstance(topic, str) else []
    return levels[2] if len(levels) > 2 else ""


@cache
def lane() -> Lane:
    """The lane of this environment."""
    environment = variables(LiveEnvironment)
    return Lane(environment.live_fields, StoredPublisher(environment.pubnub_parameter).publish)


@quarantined
def handler(event: Any) -> None:
    """Entry point of the live rule's Lambda action."""
    lane().serve(event, time.time_ns() // 1000)
