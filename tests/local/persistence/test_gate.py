"""Nothing is acknowledged before it is committed: MQTT sessions and calls of this process' ministack."""

from __future__ import annotations

import asyncio
import json
import sqlite3
import threading
from contextlib import closing

import pytest
from ministack import app
from ministack.core.responses import request_scope
from ministack.services import dynamodb, iot, sqs

from local.persistence.gate import QUOTA_EXCEEDED, Gate
from local.persistence.ledger import LedgerError
from tests.local.persistence.in_process import ACCOUNT, REGION, kept

NAME = "gate-items"
PUBACK = 0x40


class Cloud:
    """A record rule with an error action, and clients whose packets the test writes by hand."""

    def __init__(self, ledger):
        self.ledger = ledger
        # What was committed when each acknowledgement left.
        self.acknowledged = {}
        self.refused = []

    def committed(self):
        with closing(sqlite3.connect(self.ledger.path)) as other:
            return {key for (key,) in other.execute("SELECT pk FROM items")}

    async def publish(self, key, *, topic="record", qos=1, version=4):
        """Publish a record; returns whether the connection stays."""
        number = len(self.acknowledged) + 1

        async def send(message):
            data = message.get("bytes") or b"\0"
            if data[0] == PUBACK and len(data) > 4 and data[4] >= 0x80:
                self.refused.append((int.from_bytes(data[2:4], "big"), data[4]))
            elif data[0] == PUBACK:
                self.acknowledged[key] = self.committed()

        session = iot._WSSession(send, ACCOUNT, REGION, ACCOUNT)
        properties = b"\0" if version == 5 else b""
        name = bytes([0, 4]) + b"MQTT" + bytes([version, 2, 0, 60]) + properties + bytes([0, len(key)])
        connect = name + key.encode()
        assert await iot._feed_session(session, bytes([0x10, len(connect)]) + connect, 10_000)
        payload = json.dumps({"key": key, "text": "x" * 60}).encode()
        name = bytes([0, len(topic)]) + topic.encode()
        body = name + bytes([0, number] if qos else []) + properties + payload
        packet = bytes([0x30 | qos << 1, len(body)]) + body
        try:
            return await iot._feed_session(session, packet, 10_000)
        except ConnectionError:
            return False

    async def told(self, topic, act):
        """What was committed when the cloud's own message about an act reached a subscriber."""
        found = []

        async def send(message):
            if (message.get("bytes") or b"\0")[0] & 0xF0 == 0x30:
                found.append(self.committed())

        session = iot._WSSession(send, ACCOUNT, REGION, ACCOUNT)
        connect = b"\0\4MQTT\4\2\0\x3c\0\4page"
        subscribe = b"\0\1" + bytes([0, len(topic)]) + topic.encode() + b"\0"
        for kind, body in ((0x10, connect), (0x82, subscribe)):
            assert await iot._feed_session(session, bytes([kind, len(body)]) + body, 10_000)
        act()
        await iot.broker_publish(ACCOUNT, REGION, topic, b"done")
        return found

    @property
    def dead_letters(self):
        return sqs._queue_by_arn(f"arn:aws:sqs:{REGION}:{ACCOUNT}:gate")["messages"]


@pytest.fixture(params=["normal", "full"])
def cloud(tmp_path, monkeypatch, request):
    for name in ("broker_publish", "_dispatch_rule_action", "_fleet_provisioning_reply"):
        monkeypatch.setattr(iot, name, getattr(iot, name))
    monkeypatch.setattr(app, "app", app.app)
    monkeypatch.setattr(iot._WSSession, "handle_packet", iot._WSSession.handle_packet)
    with request_scope(ACCOUNT, REGION), kept(tmp_path / "ledger.db", request.param) as streams:
        Gate(streams.ledger).install()
        dynamodb._create_table(
            {
                "TableName": NAME,
                "KeySchema": [{"AttributeName": "key", "KeyType": "HASH"}],
                "AttributeDefinitions": [{"AttributeName": "key", "AttributeType": "S"}],
                "BillingMode": "PAY_PER_REQUEST",
            }
        )
        sqs._act_create_queue({"QueueName": "gate"}, "")
        queue = f"http://localhost:4566/{ACCOUNT}/gate"
        iot._topic_rules["gate"] = {
            "ruleName": "gate",
            "sql": "SELECT * FROM 'record'",
            "actions": [{"dynamoDBv2": {"putItem": {"tableName": NAME}, "roleArn": ""}}],
            "errorAction": {"sqs": {"queueUrl": queue, "roleArn": ""}},
        }
        yield Cloud(streams.ledger)
        del iot._topic_rules["gate"]
        sqs._queues.clear()
        dynamodb._tables.clear()


def test_a_record_is_committed_when_it_is_acknowledged(cloud):
    assert asyncio.run(cloud.publish("a"))
    assert cloud.acknowledged == {"a": {"a"}}


def test_records_of_the_same_moment_share_a_commit(cloud, monkeypatch):
    commits = []
    commit = cloud.ledger.commit
    monkeypatch.setattr(cloud.ledger, "commit", lambda: commits.append(commit()))

    async def publish():
        return await asyncio.gather(*map(cloud.publish, "abcdefghij"))

    assert all(asyncio.run(publish()))
    assert set(cloud.acknowledged) == cloud.committed() == set("abcdefghij")
    assert all(key in committed for key, committed in cloud.acknowledged.items())
    assert len(commits) < 5


def test_a_record_that_cannot_be_committed_is_not_acknowledged(cloud, monkeypatch):
    with monkeypatch.context() as context:
        context.setattr(cloud.ledger, "_connection", Failing(cloud.ledger._connection))
        assert not asyncio.run(cloud.publish("a"))
    assert cloud.acknowledged == {}
    assert cloud.committed() == set()
    assert cloud.dead_letters == []
    assert asyncio.run(cloud.publish("a"))
    assert cloud.acknowledged == {"a": {"a"}}


class Failing:
    """A connection whose disk is full at the commit."""

    def __init__(self, connection):
        self._connection = connection

    def __getattr__(self, name):
        return getattr(self._connection, name)

    def execute(self, sql, *arguments):
        if sql == "COMMIT":
            raise sqlite3.OperationalError("database or disk is full")
        return self._connection.execute(sql, *arguments)


def put(key):
    dynamodb._put_item({"TableName": NAME, "Item": {"key": {"S": key}}})


def test_a_record_that_anothers_failure_undoes_is_not_acknowledged(cloud, monkeypatch):
    dispatch = iot._dispatch_rule_action

    async def and_fail(*arguments):
        await dispatch(*arguments)
        with pytest.raises(LedgerError), cloud.ledger.write() as connection:
            connection.execute("INSERT INTO nothing VALUES (1)")

    with monkeypatch.context() as context:
        context.setattr(iot, "_dispatch_rule_action", and_fail)
        assert not asyncio.run(cloud.publish("a"))
    assert cloud.acknowledged == {}
    assert asyncio.run(cloud.publish("a"))


def test_the_cloud_tells_and_answers_what_is_committed(cloud):
    assert asyncio.run(cloud.told("told", lambda: put("a"))) == [{"a"}]

    async def reply():
        put("b")

    asyncio.run(Gate(cloud.ledger)._replying(reply)())
    assert cloud.committed() == {"a", "b"}


def test_a_slow_disk_does_not_stop_the_others(cloud, monkeypatch):
    threads = []
    wait = cloud.ledger._wait_for_disk
    monkeypatch.setattr(
        cloud.ledger, "_wait_for_disk", lambda: (threads.append(threading.current_thread()), wait())
    )
    assert asyncio.run(cloud.publish("a"))
    assert bool(threads) == (cloud.ledger.sync == "full")
    assert threading.main_thread() not in threads


def test_a_record_is_refused_with_its_republished_message(cloud, monkeypatch):
    again = {"republish": {"topic": "record", "qos": 0, "roleArn": ""}}
    rule = {"ruleName": "again", "sql": "SELECT * FROM 'again'", "actions": [again]}
    monkeypatch.setitem(iot._topic_rules, "again", rule)
    cloud.ledger.floor_bytes = 1 << 60
    assert not asyncio.run(cloud.publish("a", topic="again"))
    cloud.ledger.floor_bytes = 0
    assert asyncio.run(cloud.publish("a", topic="again"))
    assert cloud.acknowledged == {"a": {"a"}}


def test_records_are_refused_before_the_disk_is_full(cloud):
    cloud.ledger.floor_bytes = 1 << 60
    assert not asyncio.run(cloud.publish("a"))
    assert cloud.acknowledged == {}
    assert cloud.dead_letters == []
    # Who wants no acknowledgement stays connected.
    assert asyncio.run(cloud.publish("b", qos=0))
    cloud.ledger.floor_bytes = 0
    assert asyncio.run(cloud.publish("a"))
    assert cloud.acknowledged == {"a": {"a"}}


def test_a_robot_stays_connected_when_its_record_is_refused(cloud):
    cloud.ledger.floor_bytes = 1 << 60
    assert asyncio.run(cloud.publish("a", version=5))
    assert (cloud.acknowledged, cloud.refused) == ({}, [(1, QUOTA_EXCEEDED)])
    cloud.ledger.floor_bytes = 0
    assert asyncio.run(cloud.publish("a", version=5))
    assert (cloud.acknowledged, len(cloud.refused)) == ({"a": {"a"}}, 1)


async def call(action, **data):
    """A call of the gateway; returns its status."""
    sent = []

    async def receive():
        return {"type": "http.request", "body": json.dumps(data).encode(), "more_body": False}

    async def send(message):
        sent.append(message)

    headers = [
        (b"host", b"localhost"),
        (b"x-amz-target", f"DynamoDB_20120810.{action}".encode()),
        (b"content-type", b"application/x-amz-json-1.0"),
        (
            b"authorization",
            f"AWS4-HMAC-SHA256 Credential=test/20260101/{REGION}/dynamodb/aws4_request".encode(),
        ),
    ]
    scope = {"type": "http", "method": "POST", "path": "/", "headers": headers, "client": ("127.0.0.1", 1)}
    await app.app(scope, receive, send)
    assert [message["type"] for message in sent] == ["http.response.start", "http.response.body"]
    return sent[0]["status"]


def test_a_call_is_answered_when_its_change_is_committed(cloud, monkeypatch):
    assert asyncio.run(call("PutItem", TableName=NAME, Item={"key": {"S": "a"}})) == 200
    assert cloud.committed() == {"a"}
    with monkeypatch.context() as context:
        context.setattr(cloud.ledger, "_connection", Failing(cloud.ledger._connection))
        assert asyncio.run(call("PutItem", TableName=NAME, Item={"key": {"S": "b"}})) == 503
    assert asyncio.run(call("GetItem", TableName=NAME, Key={"key": {"S": "a"}})) == 200
    assert cloud.committed() == {"a"}
