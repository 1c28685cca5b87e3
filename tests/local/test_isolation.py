"""Least privilege, tried on the broker with enforcement on: (what robot A does, what it is told)."""

from __future__ import annotations

import pytest
from botocore.exceptions import ClientError

from contract import (
    BROKER,
    CMD,
    FLEET,
    LIVE,
    MAX_MESSAGE_BYTES,
    PING,
    PONG,
    RULE,
    build_topic,
    encode_ping,
    record_topic,
)
from local.gaps import AWS_MESSAGE_BYTES
from station import robots
from tests.local.robot import Robot

A, B = "isolated-a", "isolated-b"


@pytest.fixture(scope="module")
def folders(embedded, tmp_path_factory):
    out = tmp_path_factory.mktemp("robots")
    return {name: robots.add(embedded.cloud, name, out=out).folder for name in (A, B)}


@pytest.fixture(scope="module")
def robot_a(folders):
    with Robot(folders[A]) as robot:
        yield robot.online()


@pytest.mark.parametrize(
    ("topic", "answer"),
    [
        (record_topic(A, "vesc"), "SUCCESS"),
        (build_topic(LIVE, A, "vesc"), "SUCCESS"),
        (build_topic(FLEET, A, "pose"), "SUCCESS"),
        (build_topic(PING, A, BROKER), "SUCCESS"),
        (record_topic(B, "vesc"), "NOT_AUTHORIZED"),
        (build_topic("dt", A, "vesc"), "NOT_AUTHORIZED"),
        (build_topic(LIVE, B, "vesc"), "NOT_AUTHORIZED"),
        (build_topic(FLEET, B, "pose"), "NOT_AUTHORIZED"),
        (build_topic(PING, B, RULE), "NOT_AUTHORIZED"),
        (build_topic(CMD, A, "drive"), "NOT_AUTHORIZED"),
        (build_topic(CMD, B, "drive"), "NOT_AUTHORIZED"),
        (build_topic(PONG, A, RULE), "NOT_AUTHORIZED"),
        (f"$aws/rules/iort_live/live/iort/{A}/vesc", "NOT_AUTHORIZED"),
        ("anything/else", "NOT_AUTHORIZED"),
    ],
)
def test_publish(robot_a, topic, answer):
    assert robot_a.publish(topic, b"{}") == answer


@pytest.mark.parametrize(
    ("topic_filter", "answer"),
    [
        (build_topic(CMD, A, "drive"), "GRANTED_QOS_1"),
        (f"{CMD}/iort/{A}/+", "GRANTED_QOS_1"),
        (f"{PONG}/iort/{A}/+", "GRANTED_QOS_1"),
        (f"{FLEET}/iort/+/#", "GRANTED_QOS_1"),
        (f"{FLEET}/iort/{B}/pose", "GRANTED_QOS_1"),
        (build_topic(CMD, B, "drive"), "NOT_AUTHORIZED"),
        (f"{CMD}/iort/+/drive", "NOT_AUTHORIZED"),
        (f"{PONG}/iort/{B}/{RULE}", "NOT_AUTHORIZED"),
        (f"{LIVE}/iort/{A}/vesc", "NOT_AUTHORIZED"),
        ("#", "NOT_AUTHORIZED"),
        ("+/iort/#", "NOT_AUTHORIZED"),
    ],
)
def test_subscribe(robot_a, topic_filter, answer):
    assert robot_a.subscribe(topic_filter) == answer


def test_connect_as_another_robot_is_refused(folders):
    with Robot(folders[A], client_id=B) as impostor:
        assert impostor.refused.wait(15)
        assert not impostor.connected.is_set()


def test_robots_talk_to_each_other_over_the_broker(folders, robot_a):
    with Robot(folders[B]) as robot_b:
        assert robot_b.online().subscribe(f"{FLEET}/iort/+/#") == "GRANTED_QOS_1"
        robot_a.publish(build_topic(FLEET, A, "pose"), b'{"x": 1}')
        assert robot_b.next_message() == (build_topic(FLEET, A, "pose"), b'{"x": 1}')


def test_rule_republishes_to_the_robot_that_asked(folders, robot_a):
    robot_a.subscribe(f"{PONG}/iort/{A}/+")
    with Robot(folders[B]) as robot_b:
        robot_b.online().subscribe(f"{PONG}/iort/{B}/+")
        robot_b.publish(build_topic(PING, B, RULE), encode_ping(7, 1))
        topic, payload = robot_b.next_message()
    assert topic == build_topic(PONG, B, RULE)
    assert b'"id": 7' in payload
    heard_by_a = [robot_a.messages.get_nowait()[0] for _ in range(robot_a.messages.qsize())]
    assert not [topic for topic in heard_by_a if topic.startswith(PONG)]


def test_largest_message_is_taken(folders):
    with Robot(folders[B]) as robot:
        assert robot.online().publish(build_topic(FLEET, B, "image"), b"x" * MAX_MESSAGE_BYTES) == "SUCCESS"


def test_message_above_128_kb_is_refused(embedded):
    data, topic = embedded.cloud.client("iot-data"), build_topic(FLEET, B, "image")
    data.publish(topic=topic, payload=b"x" * AWS_MESSAGE_BYTES)
    with pytest.raises(ClientError):
        data.publish(topic=topic, payload=b"x" * (AWS_MESSAGE_BYTES + 1))


def test_removed_robot_is_refused(embedded, tmp_path):
    bundle = robots.add(embedded.cloud, "isolated-removed", out=tmp_path)
    robots.remove(embedded.cloud, bundle.robot)
    with Robot(bundle.folder) as robot:
        assert robot.refused.wait(15)
        assert not robot.connected.is_set()
