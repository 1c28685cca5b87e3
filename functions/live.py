"""Lambda 1: sends a car's newest sample from the live rule to the car's PubNub channel."""

from __future__ import annotations

import json
import logging
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

from functions.shared.cut_off import CutOff
from functions.shared.dead_letter import DeadLetterQueue, refused_event
from functions.shared.delay_estimator import DelayEstimator
from functions.shared.metrics import Gathered, emit
from functions.shared.pubnub_client import PublishError, PubNubPublisher
from iort_contract.catalog.vesc import absent
from iort_contract.cloud import channel
from iort_contract.limits import LIVE_MAX_AGE_MS, ContractError
from iort_contract.messages.event import event_message
from iort_contract.messages.live import LiveSample, decode_live, live_update
from iort_contract.tables import RECEIVED_MS, TOPIC
from iort_contract.topics import parse_topic

_log = logging.getLogger(__name__)
_log.setLevel(logging.INFO)

Publish = Callable[[str, dict[str, Any]], None]


@dataclass(frozen=True)
class LiveSettings:
    """The fields of each stream on the dashboard; a stream not named sends all its fields."""

    fields: Mapping[str, frozenset[str]]

    @classmethod
    def from_environment(cls) -> LiveSettings:
        """Read ``LIVE_FIELDS``, a JSON object of stream to list of fields."""
        named: dict[str, list[str]] = json.loads(os.environ["LIVE_FIELDS"])
        return cls({stream: frozenset(fields) for stream, fields in named.items()})


def age_ms(robot: str, live: LiveSample, received_ms: int, now_us: int, legs: DelayEstimator) -> float:
    """How old a robot's sample is, regardless of the car's clock.

    A car that knows its clock offset sends it in the message, so the whole way is measured on one clock. For
    other cars the age is the time in the car plus the time in the cloud, each by its own clock, plus the
    network's delay above its usual minimum.
    """
    if live.offset_us is not None:
        return (now_us - live.t_us - live.offset_us) / 1000
    in_car_us = live.sent_us - live.t_us
    in_cloud_us = now_us - received_ms * 1000
    excess_us = legs.excess_us(robot, live.boot, live.sent_us, received_ms)
    return (in_car_us + excess_us + in_cloud_us) / 1000


class RefusedError(Exception):
    """A live message that is malformed."""


def process(
    event: Mapping[str, Any],
    settings: LiveSettings,
    publish: Publish,
    *,
    legs: DelayEstimator,
    counted: Gathered,
    now_us: int,
) -> None:
    """Publish one live message, or count why not. A live message is never retried.

    Failures are logged at once; everything else is ``counted`` and logged periodically. Raises `RefusedError`
    for a malformed message.
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
    if age_ms(topic.robot, live, received_ms, now_us, legs) > LIVE_MAX_AGE_MS:
        # Stale messages are late ones: the alarm must count them, or it would never go off.
        counted.add(now_us / 1e6, LiveStale=1, CarToLambdaMs=way_ms)
        return
    chosen = settings.fields.get(topic.name, live.sample.keys())
    picked = {
        name: None if absent(name, value) else value for name, value in live.sample.items() if name in chosen
    }
    live = replace(live, sample=picked)
    update = live_update(topic.robot, topic.name, live, received_ms, now_us)
    try:
        publish(channel(topic.robot, topic.namespace), update)
    except PublishError as error:
        _log.warning("not published for %s: %s", topic.robot, error)
        emit("live", PubNubFailed=1)
        return
    counted.add(
        now_us / 1e6,
        LivePublished=1,
        InCarMs=max(0.0, (live.sent_us - live.t_us) / 1000),
        UplinkMs=uplink_ms,
        ToLambdaMs=max(0.0, now_us / 1000 - received_ms),
        CarToLambdaMs=way_ms,
    )


def serve(
    event: Any,
    show: Callable[[], None],
    keep: Callable[[str], bool],
    *,
    cut_off: CutOff,
    counted: Gathered,
    function_arn: str,
    now_s: float,
) -> None:
    """Have ``show`` process a live message. A refused message goes to the quarantine's queue by ``keep``.

    A failed invocation may cost its environment, and all robots wait for the next one. So this fails only if
    the queue does not take the message; Lambda then sends it to the same queue.
    """
    robot = _robot(event)
    if cut_off.closed(robot, now_s):
        counted.add(now_s, LiveCutOff=1)
        return
    try:
        show()
    except RefusedError as error:
        reason = str(error)
        if cut_off.refused(robot, now_s):
            reason += "; so many were refused that the next are not looked at, metric LiveCutOff"
            _log.warning("live messages of %s are skipped for a while", robot)
        if not keep(refused_event(function_arn, event, reason)):
            raise


def _robot(event: Any) -> str:
    topic = event.get(TOPIC) if isinstance(event, Mapping) else None
    levels = topic.split("/") if isinstance(topic, str) else []
    return levels[2] if len(levels) > 2 else ""


@cache
def _settings() -> LiveSettings:
    return LiveSettings.from_environment()


@cache
def _publisher() -> PubNubPublisher:
    return PubNubPublisher.from_parameter(os.environ["PUBNUB_PARAMETER"])


@cache
def _legs() -> DelayEstimator:
    return DelayEstimator()


@cache
def _counted() -> Gathered:
    return Gathered("live")


@cache
def _cut_off() -> CutOff:
    return CutOff()


@cache
def _refusals() -> DeadLetterQueue:
    return DeadLetterQueue.at_once(os.environ["REJECTED_QUEUE"])


def handler(event: dict[str, Any], context: Any) -> None:
    """Entry point of the live rule's Lambda action."""
    now_us = time.time_ns() // 1000

    def show() -> None:
        process(event, _settings(), _publisher().publish, legs=_legs(), counted=_counted(), now_us=now_us)

    serve(
        event,
        show,
        lambda body: _refusals().keep(body),
        cut_off=_cut_off(),
        counted=_counted(),
        function_arn=context.invoked_function_arn,
        now_s=now_us / 1e6,
    )
