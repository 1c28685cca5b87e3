"""The main path on the embedded cloud: a car's messages are stored, summarised and shown completely."""

from __future__ import annotations

import os
import signal
import threading
import time

import pytest

from iort_contract.catalog.vesc import VESC_FIELDS
from iort_contract.limits import CLOCK_MAX_UNCERTAINTY_MS, LIVE_MAX_AGE_MS
from iort_contract.tables import STATS
from iort_contract.topics import RECORD, build_topic
from iort_station import data
from iort_station.operations import audit
from iort_station.page.pubnub import Listener
from local.cloud import EmbeddedCloud
from testkit.waiting import until
from tests.local.conftest import run_agent
from tests.local.data.drives import Agent
from tests.recordings import recording


def _listener(embedded: EmbeddedCloud, robot: str) -> Listener:
    return Listener(
        robot=robot,
        namespace=embedded.namespace,
        **embedded.keys.reading(),
    )


def test_a_recorded_drive_arrives_completely_and_exactly(embedded, bundle):
    from rosbags.highlevel import AnyReader

    path = recording("f1tenth-motor-servo.bag")
    car = bundle(
        sources=[{"type": "bag", "path": str(path), "speed": 0, "stamps": "original"}],
        live={"enabled": False},
    )
    run_agent(car)
    stored = list(audit.batches(embedded.cloud, car.robot, "vesc"))
    assert sum(len(batch.times_us) for batch in stored) == 2244
    with AnyReader([path]) as reader:
        connections = [c for c in reader.connections if c.topic == "/sensors/core"]
        sent = [reader.deserialize(raw, c.msgtype).state for c, _, raw in reader.messages(connections)]
    for field in (name for name, f in VESC_FIELDS.items() if 1 in f.ros):
        kept = [value for batch in stored for value in batch.columns[field]]
        assert kept == [getattr(state, field) for state in sent], field
    until(lambda: audit.samples_summarized(embedded.cloud, car.robot, "vesc") == 2244)


def test_seconds_are_summarised_with_speed_in_mps(embedded, bundle):
    car = bundle(sources=[{"type": "sim", "stream": "vesc", "rate_hz": 20, "duration_s": 2}])
    run_agent(car)
    until(lambda: audit.samples_summarized(embedded.cloud, car.robot, "vesc") == 40)
    topic = build_topic(RECORD, car.robot, "vesc", embedded.namespace)
    items = embedded.cloud.client("dynamodb").query(
        TableName=embedded.cloud.output("storage", "SummaryTable"),
        KeyConditionExpression="topic = :topic",
        ExpressionAttributeValues={":topic": {"S": topic}},
    )["Items"]
    assert items
    assert all(int(item["expires_s"]["N"]) > int(item["second"]["N"]) for item in items)
    assert all("L" in item["speed_mps"] for item in items), "a field's statistics are one list"
    found = data.query(embedded.cloud, car.robot, "vesc", summary=True).columns
    for statistic in STATS:
        mps, erpm = found[f"speed_mps_{statistic}"], found[f"speed_{statistic}"]
        assert mps.tolist() == pytest.approx((erpm / 4614).tolist(), rel=1e-8, abs=1e-12), statistic


def test_messages_delayed_by_a_stalled_broker_are_not_shown(embedded, bundle):
    car = bundle(sources=[{"type": "sim", "stream": "vesc", "rate_hz": 50}], live={"when": "always"})
    with _listener(embedded, car.robot) as listener:
        agent = Agent(car)
        # The car knows its clock offset, and sends it in its messages.
        until(lambda: listener.heard and "offset_us" in listener.heard[-1].hops)
        stalled_us = time.time_ns() // 1000
        os.kill(embedded.emulator.pid, signal.SIGSTOP)
        threading.Event().wait(6)
        resumed_us = time.time_ns() // 1000
        os.kill(embedded.emulator.pid, signal.SIGCONT)
        until(lambda: listener.heard[-1].hops["sent_us"] > resumed_us)
        agent.stop()
        agent.report()
    # All hops share one clock here. By their stamps, Lambda 1 let only fresh messages through, and held back
    # messages from the stall.
    oldest_us = 1000 * (LIVE_MAX_AGE_MS + CLOCK_MAX_UNCERTAINTY_MS)
    told = [heard for heard in listener.heard if "offset_us" in heard.hops]
    assert [heard for heard in told if heard.hops["lambda_us"] - heard.t_us > oldest_us] == []
    before = max(heard.seq for heard in told if heard.hops["sent_us"] < stalled_us)
    after = min(heard.seq for heard in told if heard.hops["sent_us"] > resumed_us)
    shown = sum(before < heard.seq < after for heard in told)
    assert shown < after - before - 1
