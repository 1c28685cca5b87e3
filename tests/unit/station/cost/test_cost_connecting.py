"""The cost model's figures of a connection match the agent's messages when it connects."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from functions.shared.metrics import emit
from iort_agent.agent import Agent
from iort_agent.config import Config
from iort_agent.mqtt.dispatch import Dispatcher
from iort_agent.mqtt.failures import SHORTEST_S
from iort_agent.runtime import Runtime
from iort_agent.spool.memory import MemorySpool
from iort_contract.topics import SHADOW
from iort_station.cost import scale
from iort_station.cost.bill import model
from iort_station.cost.prices import QUOTAS
from iort_station.cost.usage import Usage
from testkit.agent import Loopback, ManualClock

_ONE = Usage()
# AWS IoT Core, "Additional metering details".
_METER, _SHADOW_METER = 5 * 1024, 1024


def messages(usage):
    """The metered messages of an hour, by kind."""
    return {item.what: item.units for item in model.bill(usage) if item.price == "message"}


class Counting(Loopback):
    """An uplink that records its subscriptions."""

    def __init__(self, *given, **named):
        super().__init__(*given, **named)
        self.filters = []

    def subscribe(self, topic_filter, handler):
        self.filters.append(topic_filter)
        super().subscribe(topic_filter, handler)


def test_an_agent_subscribes_as_the_model_assumes():
    clock, dispatcher = ManualClock(), Dispatcher()
    uplink = Counting(clock, dispatcher)
    config = Config("car1", "host", Path(), Path(), ())
    agent = Runtime(Agent(config, uplink=uplink, spool=MemorySpool(max_bytes=10**6), clock=clock))
    assert len(uplink.filters) == model.SUBSCRIPTIONS
    assert all(len(topic) < _METER for topic in uplink.filters)
    uplink.connect()
    dispatcher.run_pending()
    agent.tick()
    asked = [message for message in uplink.published if f"/name/{SHADOW}/" in message.topic]
    assert [(message.topic.rpartition("/")[2], message.payload) for message in asked] == [("get", b"")]
    # Without desired settings, the shadow holds only the agent's report.
    uplink.deliver(f"{asked[0].topic}/rejected", b'{"code": 404}')
    dispatcher.run_pending()
    agent.tick()
    assert uplink.published[-1].topic.endswith("/update")
    assert len(json.dumps(json.loads(uplink.published[-1].payload)["state"])) < _SHADOW_METER


def test_a_connect_adds_its_messages_to_an_hour():
    more, less = messages(_ONE), messages(replace(_ONE, connects_per_hour=0.0))
    assert {what: more[what] - less[what] for what in more if more[what] != less[what]} == {
        "CONNECT and SUBSCRIBE": 1 + model.SUBSCRIPTIONS,
        "shadow request, answer and PUBACK": 3,
    }


def test_a_connect_adds_two_events_of_presence():
    items = model.bill(replace(_ONE, connects_per_hour=3.0))
    units = {item.price: item.units for item in items if item.lane == "connection"}
    for price in ("rule", "action", "invocation", "write"):
        assert units[price] == 2 * 3, price
    assert units["shadow"] == 3
    assert units["connection"] == 60, "minutes, however often"


def test_a_command_is_sent_received_and_acknowledged():
    commanded = messages(replace(_ONE, command_hz=10.0))
    assert commanded["sent, received, acknowledged"] == 3 * 10 * 3600
    assert messages(_ONE)["sent, received, acknowledged"] == 0


def test_the_thesis_layout_pays_for_connects_without_subscriptions():
    items = {item.what: item.units for item in model.thesis_bill(replace(_ONE, connects_per_hour=2.0))}
    assert items["CONNECT"] == 2


def test_the_modelled_length_of_a_presence_line_matches_the_real_line(capsys, monkeypatch):
    monkeypatch.setenv("NAMESPACE", "iort")
    emit("presence", RobotsConnected=True, RobotsDisconnected=False)
    assert len(capsys.readouterr().out) == pytest.approx(model._PRESENCE_LINE, rel=0.1)


def test_an_outage_is_compared_with_the_lower_quota_of_awss_pages():
    assert QUOTAS["IoT Core: connects in a minute after an outage"].value == 500 * 60
    paper = {need.name: need.times for need in scale.on_paper(Usage(robots=60_000)).needs}
    assert paper["IoT Core: connects in a minute after an outage"] == 2
    assert paper["IoT Core: connects of one client id"] == 1, "the agent waits a second at least"
    assert scale.SHORTEST_RECONNECT_S == SHORTEST_S
