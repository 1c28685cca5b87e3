"""Rejected messages of one robot do not affect other robots, and every message is kept."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from functions.live import REFUSALS
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.messages.files import decode_file_answer
from iort_contract.messages.live import LiveSample, encode_live
from iort_contract.topics import FILE, LIVE, PING, PONG, build_topic, record_topic
from iort_station.operations import quarantine
from iort_station.page.pubnub import Listener
from testkit.machine import descendants
from testkit.mqtt import Robot
from testkit.waiting import until

BAD, GOOD = 80, 20


def environments(embedded):
    """Return the processes of Lambda 1."""
    function = embedded.cloud.output("processing", "LiveFunction")
    found = set()
    for pid in descendants(embedded.emulator.pid):
        try:
            command = Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace")
        except OSError:
            continue
        if f"ministack-lambda-{function}-" in command:
            found.add(pid)
    return found


def kept(embedded, robot):
    """Return a robot's quarantined messages, and how often each was kept."""
    listed = quarantine.entries(embedded.cloud, robot=robot)
    return {quarantine.load(embedded.cloud, one).payload: one.seen for one in listed}


def test_rejected_messages_do_not_delay_other_robots_live_lane(embedded, bundle):
    bad, good = bundle("bad"), bundle("good")
    # A time in the future, so that no message is stale on a slow machine.
    t_us = (int(time.time()) + 3600) * 1_000_000
    topics = {car: build_topic(LIVE, car.robot, VESC_STREAM) for car in (bad, good)}
    before = environments(embedded)
    assert before
    with (
        Listener(robot=good.robot, namespace=embedded.namespace, **embedded.keys.reading()) as listener,
        Robot(bad.folder) as hostile,
        Robot(good.folder) as other,
    ):
        hostile.online()
        other.online()
        for n in range(BAD):
            hostile.publish(topics[bad], b"no JSON %d" % n)
            if n % (BAD // GOOD) == 0:
                sample = LiveSample("0badcafe", n, t_us, t_us, {"speed": n}, offset_us=0)
                other.publish(topics[good], encode_live(sample))
        until(lambda: len(listener.heard) == GOOD)
    assert sorted(heard.seq for heard in listener.heard) == list(range(0, BAD, BAD // GOOD))
    # A rejection ended no process; one more may run, since several run at once.
    after = environments(embedded)
    assert before <= after
    assert len(after) <= (os.cpu_count() or 1)
    found = until(lambda: (now := kept(embedded, bad.robot)) and len(now) >= REFUSALS and now)
    assert set(found) <= {b"no JSON %d" % n for n in range(BAD)}
    assert set(found.values()) == {1}
    assert kept(embedded, good.robot) == {}


@pytest.mark.heavy
def test_each_of_a_thousand_unmatched_messages_is_kept_once(embedded, bundle):
    car = bundle()
    sent = {b"no JSON %d" % n for n in range(1000)}
    with Robot(car.folder) as robot:
        robot.online()
        for message in sent:
            robot.publish(record_topic(car.robot, VESC_STREAM), message)
    until(
        lambda: sum(1 for _ in quarantine.entries(embedded.cloud, robot=car.robot)) == len(sent), within_s=300
    )
    assert kept(embedded, car.robot) == dict.fromkeys(sent, 1)


@pytest.mark.parametrize("asked", [b'{"id": "0badcafe"}', b'{"id": "0badcafe", "v": 1, "file": 7}'])
def test_a_malformed_request_with_an_id_is_answered(bundle, asked):
    car = bundle()
    with Robot(car.folder) as robot:
        robot.online().subscribe(build_topic(PONG, car.robot, FILE))
        robot.publish(build_topic(PING, car.robot, FILE), asked)
        _, answer = robot.next_message()
    found = decode_file_answer(answer)
    assert (found.id, found.refused is not None) == ("0badcafe", True)
