"""Records on their way into a kept emulator: over a full disk, and over SIGKILL."""

from __future__ import annotations

import json
import ssl
import time
import urllib.request
from contextlib import contextmanager, suppress

import paho.mqtt.client as mqtt
import pytest

from testkit.waiting import GUARD_S, until
from tests.local.persistence.emulators import ROLE, Emulator

TABLE = "records"
_EVERYTHING = {
    "Version": "2012-10-17",
    "Statement": [{"Effect": "Allow", "Action": "iot:*", "Resource": "*"}],
}
# It writes down what it gets, and does not come to the end of a record named "stuck" the first time.
_CODE = """
import pathlib, time
def handler(event, context):
    file = pathlib.Path({path!r})
    for record in event["Records"]:
        key = record["dynamodb"]["Keys"]["key"]["S"]
        with file.open("a") as lines:
            lines.write(key + " ")
        if key == "stuck" and file.read_text().split().count(key) == 1:
            time.sleep(600)
"""


@pytest.fixture(scope="module")
def emulator(tmp_path_factory):
    made = Emulator(tmp_path_factory.mktemp("kept"))
    made.start()
    made.add_role()
    made.add_table(TABLE)
    put = {"dynamoDBv2": {"roleArn": ROLE, "putItem": {"tableName": TABLE}}}
    rule = {"sql": "SELECT * FROM 'record'", "actions": [put]}
    made.client("iot").create_topic_rule(ruleName="record", topicRulePayload=rule)
    yield made
    made.kill()


@pytest.fixture
def robot(emulator, tmp_path):
    """Return a context manager: a connection of a robot with a certificate."""
    iot = emulator.client("iot")
    made = iot.create_keys_and_certificate(setAsActive=True)
    with suppress(iot.exceptions.ResourceAlreadyExistsException):
        iot.create_policy(policyName="everything", policyDocument=json.dumps(_EVERYTHING))
    iot.attach_policy(policyName="everything", target=made["certificateArn"])
    files = {"ca": _root(emulator), "crt": made["certificatePem"], "key": made["keyPair"]["PrivateKey"]}
    for name, text in files.items():
        (tmp_path / name).write_text(text)

    @contextmanager
    def connected(protocol=mqtt.MQTTv311):
        version = mqtt.CallbackAPIVersion.VERSION2
        client = mqtt.Client(version, client_id="car", protocol=protocol)
        client.tls_set(*(str(tmp_path / name) for name in ("ca", "crt", "key")))
        client.reconnect_delay_set(0.1, 0.1)
        client.connect("127.0.0.1", emulator.mqtt_port)
        client.loop_start()
        yield client
        client.disconnect()
        client.loop_stop()

    return connected


def _root(emulator):
    context = ssl.create_default_context(cafile=str(emulator.certificate))
    url = f"https://127.0.0.1:{emulator.port}/_ministack/iot/ca.pem"
    with urllib.request.urlopen(url, timeout=GUARD_S, context=context) as answer:
        return answer.read().decode()


def stored(emulator):
    return {item["key"]["S"] for item in emulator.client("dynamodb").scan(TableName=TABLE)["Items"]}


def test_a_robot_keeps_a_record_that_the_full_disk_refused(emulator, robot):
    with robot() as car:
        car.publish("record", b'{"key": "before"}', qos=1).wait_for_publish(GUARD_S)
        lost = []
        car.on_disconnect = lambda *_: lost.append(time.monotonic())
        with emulator.full_disk():
            refused = car.publish("record", b'{"key": "refused"}', qos=1)
            until(lambda: len(lost) > 1)
            assert not refused.is_published()
            assert stored(emulator) == {"before"}
        # The client sends it again by itself.
        refused.wait_for_publish(GUARD_S)
        assert refused.is_published()
        emulator.restart()
    assert stored(emulator) == {"before", "refused"}


def test_a_robot_of_mqtt_5_stays_connected_on_a_full_disk(emulator, robot):
    with robot(mqtt.MQTTv5) as car:
        said, lost = [], []
        car.on_publish = lambda _client, _data, _number, reason, _properties: said.append(str(reason))
        car.on_disconnect = lambda *_: lost.append(time.monotonic())
        with emulator.full_disk():
            for n in (1, 2):
                car.publish("record", b'{"key": "five"}', qos=1)
                until(lambda n=n: len(said) == n)
        car.publish("record", b'{"key": "five"}', qos=1)
        until(lambda: len(said) == 3)
        assert said[:2] == ["Quota exceeded"] * 2
        assert not lost
    assert "five" in stored(emulator)


def test_a_mapping_goes_on_after_a_kill_with_what_it_had_not_finished(emulator, tmp_path):
    path = tmp_path / "lines"
    emulator.add_function("read", _CODE.format(path=str(path)))
    tables = emulator.client("dynamodb")
    stream = tables.describe_table(TableName=TABLE)["Table"]["LatestStreamArn"]
    emulator.client("lambda").create_event_source_mapping(
        FunctionName="read", EventSourceArn=stream, StartingPosition="LATEST", BatchSize=1
    )
    tables.put_item(TableName=TABLE, Item={"key": {"S": "done"}})
    until(path.exists)
    tables.put_item(TableName=TABLE, Item={"key": {"S": "stuck"}})
    until(lambda: path.read_text().endswith("stuck "))
    tables.put_item(TableName=TABLE, Item={"key": {"S": "waits"}})

    emulator.restart()

    until(lambda: path.read_text().endswith("waits "))
    assert path.read_text() == "done stuck stuck waits "
