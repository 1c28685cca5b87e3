"""What a kept emulator has after SIGKILL, and what it answers when its disk is full."""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing

import pytest
from botocore.exceptions import ClientError

from testkit.waiting import until
from tests.local.persistence.emulators import REGION, ROLE, Emulator

_WAIT = {"StartAt": "Wait", "States": {"Wait": {"Type": "Wait", "Seconds": 3600, "End": True}}}
# It does not come to its end the first time.
_CODE = """
import pathlib, time
def handler(event, context):
    file = pathlib.Path(event["file"])
    with file.open("a") as lines:
        lines.write("began\\n")
    if file.read_text() == "began\\n":
        time.sleep(600)
"""


@pytest.fixture(scope="module")
def emulator(tmp_path_factory):
    made = Emulator(tmp_path_factory.mktemp("kept"))
    made.start()
    made.add_role()
    yield made
    made.kill()


def test_all_that_calls_have_made_is_there_after_a_kill(emulator):
    iot, data, sqs, s3 = (emulator.client(name) for name in ("iot", "iot-data", "sqs", "s3"))
    iot.create_thing(thingName="car1")
    certificate = iot.create_keys_and_certificate(setAsActive=True)
    iot.attach_thing_principal(thingName="car1", principal=certificate["certificateArn"])
    data.update_thing_shadow(
        thingName="car1", shadowName="config", payload=b'{"state": {"desired": {"rate": 5}}}'
    )
    for topic in ("kept", "withdrawn"):
        data.publish(topic=topic, qos=1, retain=True, payload=b"hello")
    data.publish(topic="withdrawn", qos=1, retain=True, payload=b"")
    queue = sqs.create_queue(QueueName="queue")["QueueUrl"]
    for text in ("done", "waiting"):
        sqs.send_message(QueueUrl=queue, MessageBody=text)
    [message] = sqs.receive_message(QueueUrl=queue)["Messages"]
    sqs.delete_message(QueueUrl=queue, ReceiptHandle=message["ReceiptHandle"])
    s3.create_bucket(Bucket="bucket", CreateBucketConfiguration={"LocationConstraint": REGION})
    for key in ("a/object", "deleted"):
        s3.put_object(Bucket="bucket", Key=key, Body=b"bytes", Metadata={"robot": "car1"})
    s3.delete_object(Bucket="bucket", Key="deleted")
    states = emulator.client("stepfunctions")
    machine = states.create_state_machine(name="wait", definition=json.dumps(_WAIT), roleArn=ROLE)
    execution = states.start_execution(stateMachineArn=machine["stateMachineArn"])["executionArn"]
    tables = emulator.client("dynamodb")
    emulator.add_table("table")
    for key in ("kept", "deleted"):
        tables.put_item(TableName="table", Item={"key": {"S": key}})
    tables.delete_item(TableName="table", Key={"key": {"S": "deleted"}})
    session = emulator.client("sts").assume_role(RoleArn=ROLE, RoleSessionName="viewer")["Credentials"]

    emulator.restart()

    assert iot.list_thing_principals(thingName="car1")["principals"] == [certificate["certificateArn"]]
    described = iot.describe_certificate(certificateId=certificate["certificateId"])["certificateDescription"]
    assert (described["certificatePem"], described["status"]) == (certificate["certificatePem"], "ACTIVE")
    shadow = json.load(data.get_thing_shadow(thingName="car1", shadowName="config")["payload"])
    assert (shadow["state"]["desired"], shadow["version"]) == ({"rate": 5}, 1)
    assert data.get_retained_message(topic="kept")["payload"] == b"hello"
    assert [one["topic"] for one in data.list_retained_messages()["retainedTopics"]] == ["kept"]
    [message] = sqs.receive_message(QueueUrl=queue, MaxNumberOfMessages=10)["Messages"]
    assert message["Body"] == "waiting"
    got = s3.get_object(Bucket="bucket", Key="a/object")
    assert (got["Body"].read(), got["Metadata"]) == (b"bytes", {"robot": "car1"})
    assert [one["Key"] for one in s3.list_objects_v2(Bucket="bucket")["Contents"]] == ["a/object"]
    assert states.describe_execution(executionArn=execution)["status"] == "RUNNING"
    described = tables.describe_table(TableName="table")["Table"]
    assert (described["ItemCount"], described["StreamSpecification"]["StreamEnabled"]) == (1, True)
    assert tables.scan(TableName="table")["Items"] == [{"key": {"S": "kept"}}]
    viewer = emulator.client("sts", session).get_caller_identity()["Arn"]
    assert viewer.endswith("assumed-role/anybody/viewer")


def test_an_invocation_that_a_kill_interrupts_begins_again(emulator, tmp_path):
    function = emulator.add_function("slow", _CODE)
    rule = {"sql": "SELECT * FROM 'call'", "actions": [{"lambda": {"functionArn": function}}]}
    emulator.client("iot").create_topic_rule(ruleName="call", topicRulePayload=rule)
    lines = tmp_path / "lines"
    emulator.client("iot-data").publish(topic="call", qos=1, payload=json.dumps({"file": str(lines)}))
    until(lambda: lines.exists() and lines.read_text())

    emulator.restart()

    until(lambda: lines.read_text() == "began\nbegan\n")
    with closing(sqlite3.connect(emulator.ledger)) as ledger:
        until(lambda: ledger.execute("SELECT count(*) FROM invocations").fetchone() == (0,))


def test_a_full_disk_is_an_error_and_changes_nothing(emulator):
    s3, ssm, sqs, iam, cloudwatch = map(emulator.client, ("s3", "ssm", "sqs", "iam", "cloudwatch"))
    s3.create_bucket(Bucket="full", CreateBucketConfiguration={"LocationConstraint": REGION})
    s3.put_object(Bucket="full", Key="key", Body=b"before")
    ssm.put_parameter(Name="/parameter", Value="before", Type="String")
    queue = sqs.create_queue(QueueName="full")["QueueUrl"]
    with emulator.full_disk():
        with pytest.raises(ClientError, match=r"50[03]"):
            s3.put_object(Bucket="full", Key="key", Body=b"x" * 10_000)
        with pytest.raises(ClientError, match=r"ServiceUnavailable|InternalError"):
            ssm.put_parameter(Name="/parameter", Value="x" * 4096, Type="String", Overwrite=True)
        with pytest.raises(ClientError, match=r"ServiceUnavailable|InternalError"):
            sqs.send_message(QueueUrl=queue, MessageBody="x" * 10_000)
        # As their clients read it: these do not speak JSON.
        with pytest.raises(ClientError, match="ServiceUnavailable"):
            iam.create_user(UserName="full")
        with pytest.raises(ClientError, match="ServiceUnavailable"):
            cloudwatch.put_metric_alarm(
                AlarmName="full",
                Namespace="iort",
                MetricName="full",
                Statistic="Sum",
                Period=60,
                EvaluationPeriods=1,
                Threshold=1,
                ComparisonOperator="GreaterThanThreshold",
            )
    assert s3.get_object(Bucket="full", Key="key")["Body"].read() == b"before"
    sqs.send_message(QueueUrl=queue, MessageBody="after")

    emulator.restart()

    assert s3.get_object(Bucket="full", Key="key")["Body"].read() == b"before"
    assert sqs.receive_message(QueueUrl=queue)["Messages"][0]["Body"] == "after"
