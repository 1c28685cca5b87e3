"""A robot says in its messages what only the cloud may say, in its neighbour's name: on the broker, by
its own certificate. tests/unit/test_spoofed_keys.py has the same where a payload's keys win."""

from __future__ import annotations

import hashlib
import itertools
import json
import time
import uuid
from typing import NamedTuple

import pytest

import contract
from contract import (
    FAULT_FIELD,
    FILE,
    LAMBDA,
    LIVE,
    PING,
    PONG,
    RECEIVED_MS,
    RECORD,
    RULE,
    SHADOW,
    VESC_STREAM,
)
from station.items import plain
from station.listener import Listener
from station.robots import Bundle
from tests.local.conftest import until
from verify.robot import Robot
from verify.spoofing import spoofed


class Pair(NamedTuple):
    """The robot that tries, connected, and its neighbour."""

    robot: Robot
    victim: str

    def send(self, lane: str, name: str, message: bytes) -> None:
        topic = contract.build_topic(lane, self.robot.name, name)
        if lane == RECORD:
            topic = contract.record_topic(self.robot.name, name)
        assert self.robot.publish(topic, spoofed(message, self.victim, lane, name)) == "SUCCESS"

    def asked(self, name: str, message: bytes) -> dict[str, object]:
        """What is answered on the lane pong, and that it is the only answer to either robot."""
        answers = contract.build_topic(PONG, self.robot.name, name)
        assert self.robot.subscribe(answers) == "GRANTED_QOS_1"
        self.send(PING, name, message)
        topic, payload = self.robot.next_message()
        assert topic == answers
        answer: dict[str, object] = json.loads(payload)
        return answer


@pytest.fixture
def pair(bundle):
    a: Bundle = bundle("a")
    victim = bundle("b").robot
    with Robot(a.folder) as robot:
        yield Pair(robot.online(), victim)


@pytest.fixture
def row(embedded):
    """A robot's row of the registry."""

    def read(robot):
        answer = embedded.cloud.client("dynamodb").get_item(
            TableName=embedded.cloud.output("storage", "RobotsTable"), Key={contract.ROBOT: {"S": robot}}
        )
        return plain(answer["Item"])

    return read


def near_now(received_ms):
    return abs(int(received_ms) - time.time() * 1000) < 60_000


def test_a_batch_is_stored_as_the_robots_own_and_no_other_key_with_it(embedded, pair):
    def items(robot):
        answer = embedded.cloud.client("dynamodb").query(
            TableName=embedded.cloud.output("storage", "TelemetryTable"),
            KeyConditionExpression="topic = :topic",
            ExpressionAttributeValues={":topic": {"S": contract.build_topic(RECORD, robot, VESC_STREAM)}},
        )
        return [plain(item) for item in answer["Items"]]

    batch = contract.Batch("0badcafe", 0, [int(time.time()) * 1_000_000], {"speed": [1.5]})
    pair.send(RECORD, VESC_STREAM, contract.encode(batch))
    (item,) = until(lambda: items(pair.robot.name))
    assert set(item) == {*contract.ENVELOPE, contract.TOPIC, RECEIVED_MS, contract.EXPIRES_S} - {
        contract.NONFINITE
    }
    assert near_now(item[RECEIVED_MS])
    assert 0 < int(item[contract.EXPIRES_S]) - time.time() < 366 * 86_400
    assert contract.decode_item(item)[1] == batch
    assert items(pair.victim) == []


def test_a_live_message_is_shown_as_the_robots_own(embedded, pair):
    def listener(robot):
        return Listener(robot=robot, namespace=embedded.namespace, **embedded.keys.reading())

    seqs = itertools.count()
    with listener(pair.robot.name) as own, listener(pair.victim) as others:

        def shown():
            # On a slow machine one may be stale before it is shown.
            now_us = time.time_ns() // 1000
            live = contract.LiveSample("0badcafe", next(seqs), now_us, now_us, {"speed": 3}, offset_us=0)
            pair.send(LIVE, VESC_STREAM, contract.encode_live(live))
            return own.heard

        heard = until(shown)[-1]
        assert heard.robot == pair.robot.name
        assert near_now(heard.hops[RECEIVED_MS])
        assert others.heard == []


@pytest.mark.parametrize("path", [RULE, LAMBDA])
def test_a_ping_is_answered_to_the_robot_that_asked_with_the_clouds_time(pair, path):
    ping = contract.encode_ping(7, 1_700_000_000_000_000, "padding")
    answer = pair.asked(path, ping)
    assert near_now(answer.pop(RECEIVED_MS))
    assert answer == json.loads(ping)


def test_a_file_is_the_robots_own(pair):
    content = b"content"
    sha256 = hashlib.sha256(content).hexdigest()
    file = contract.File("notes.txt", "log", "text/plain", len(content), sha256, 1_700_000_000_000_000)
    request = contract.FileRequest(uuid.uuid4().hex, file, {1: sha256})
    answer = pair.asked(FILE, contract.encode_file_request(request))
    assert answer["key"] == contract.file_key(pair.robot.name, file)
    assert pair.victim not in json.dumps(answer)


def test_an_alert_is_the_robots_own(pair, row):
    now_us = time.time_ns() // 1000
    live = contract.LiveSample("0badcafe", 0, now_us, now_us, {FAULT_FIELD: 5, "voltage_input": 9.5})
    pair.send(LIVE, VESC_STREAM, contract.encode_live(live))

    def alerts(robot):
        return {name for name in row(robot) if name.startswith(contract.ALERT_PREFIX)}

    # Of both rules, fault and battery.
    until(lambda: len(alerts(pair.robot.name)) == 2)
    assert alerts(pair.victim) == set()


def test_a_version_is_the_robots_own(pair, row):
    reported = json.loads(spoofed(b'{"agent_version": "9.9.9"}', pair.victim, LIVE, VESC_STREAM))
    reported["agent_version"] = "9.9.9"
    document = json.dumps({"state": {"reported": reported}}).encode()
    topic = f"$aws/things/{pair.robot.name}/shadow/name/{SHADOW}/update"
    assert pair.robot.publish(topic, document) == "SUCCESS"
    until(lambda: row(pair.robot.name).get(contract.AGENT_VERSION) == "9.9.9")
    assert contract.AGENT_VERSION not in row(pair.victim)
