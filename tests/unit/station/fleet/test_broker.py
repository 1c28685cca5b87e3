"""The connection of a viewer or a driver, with a client that answers as told."""

from __future__ import annotations

from concurrent.futures import Future
from types import SimpleNamespace
from typing import Any

import pytest
from awscrt import mqtt5

from iort_station.errors import StationError
from iort_station.fleet.broker import Broker


def answered(*codes: mqtt5.SubackReasonCode) -> Future[Any]:
    """The broker's answer to a subscription."""
    answer: Future[Any] = Future()
    answer.set_result(SimpleNamespace(reason_codes=list(codes)))
    return answer


def test_a_subscription_that_is_refused_after_a_lost_connection_ends_the_drive() -> None:
    sent: list[Any] = []
    role: Any = SimpleNamespace(name="driver")
    broker = Broker(role, role, filters=["live/iort/car7/+"])
    broker._client = SimpleNamespace(publish=sent.append)  # type: ignore[assignment]  # a fake
    broker._subscribed(answered(mqtt5.SubackReasonCode.GRANTED_QOS_0))
    broker.publish("cmd/iort/car7/drive", b"{}")
    broker._subscribed(answered(mqtt5.SubackReasonCode.NOT_AUTHORIZED))
    with pytest.raises(StationError, match="refuses a driver: its subscription is refused"):
        broker.publish("cmd/iort/car7/drive", b"{}")
    assert len(sent) == 1
    broker._subscribed(answered(mqtt5.SubackReasonCode.GRANTED_QOS_0))
    broker.publish("cmd/iort/car7/drive", b"{}")
