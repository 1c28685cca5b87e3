"""The quarantine keeps every message of the rejected queue once, with its bytes, from any sender."""

from __future__ import annotations

import base64
import json

import pytest
from botocore.exceptions import ClientError
from hypothesis import given
from hypothesis import strategies as st

from functions import answer, echo, live, presence, upload
from functions.quarantine import Entry, Store, Stream, entries, process
from functions.shared.clients import variables
from functions.shared.queues import DeadLetterQueue, Refused, message
from iort_contract.catalog.rules import RULES
from iort_contract.catalog.vesc import FAULT_FIELD, VOLTAGE_FIELD
from iort_contract.cloud import DRIVER, VIEWER, claim_name, client_prefix
from iort_contract.limits import ContractError
from iort_contract.messages.batch import Batch, decode_batch, decode_item, encode_batch
from iort_contract.messages.envelope import event_message, rule_event
from iort_contract.messages.live import LiveSample, decode_pong, encode_live, encode_ping
from iort_contract.tables import (
    AGENT_VERSION,
    BY_FUNCTION,
    BY_LATER,
    BY_RULE,
    BY_STREAM,
    ENVELOPE,
    EXPIRES_S,
    MESSAGE_BASE64,
    NO_ROBOT,
    NONFINITE,
    PREVIOUS,
    PUT_OFF,
    RECEIVED_MS,
    ROBOT,
    TOPIC,
)
from iort_contract.topics import ASK, FILE, LAMBDA, LIVE, PING, RECORD, RULE, SHADOW, build_topic
from testkit.dynamodb import QUARANTINE, TOPIC_OF_CAR
from tests.rule_sql import evaluate
from verify.lab import spoofed

NOW_MS = 1_700_000_000_123
REFUSAL = "DynamoDBv2Action: The provided key element does not match the schema"
RAW = b"\xff\x00not JSON, not even text"
ARN = "arn:aws:lambda:eu-west-1:000000000000:function:iort-processing-Live-1"
STREAM_ARN = "arn:aws:dynamodb:eu-west-1:0:table/telemetry/stream/1"
INFO = {
    "streamArn": STREAM_ARN,
    "shardId": "shard-1",
    "startSequenceNumber": "2",
    "endSequenceNumber": "3",
    "batchSize": 2,
}


def rule_error(payload=RAW, topic=TOPIC_OF_CAR, **changes):
    """As IoT Core's "Rule error handling" shows it."""
    action, error = REFUSAL.split(": ")
    return json.dumps(
        {
            "ruleName": "iort_record",
            "topic": topic,
            "cloudwatchTraceId": "7e146a2c",
            "clientId": "car",
            "base64OriginalPayload": base64.b64encode(payload).decode(),
            "failures": [{"failedAction": action, "failedResource": "telemetry", "errorMessage": error}],
            **changes,
        }
    )


def image(n):
    return {"topic": {"S": TOPIC_OF_CAR}, "batch": {"S": f"{n:016}-0badcafe-0"}, "v": {"N": "9"}}


def failed_batch():
    """As "Using Lambda with DynamoDB" shows an on-failure record."""
    return json.dumps({"requestContext": {"condition": "RetryAttemptsExhausted"}, "DDBStreamBatchInfo": INFO})


def invocation(event, error="boom"):
    return json.dumps(
        {
            "version": "1.0",
            "requestContext": {"functionArn": f"{ARN}:$LATEST", "condition": "RetriesExhausted"},
            "requestPayload": event,
            "responsePayload": {"errorMessage": error, "errorType": "RefusedError"},
        }
    )


def records(info):
    assert info == INFO
    return [{"dynamodb": {"SequenceNumber": str(n), "NewImage": image(n)}} for n in (2, 3)]


def none(_info):
    return []


# --- what a message of the queue holds --------------------------------------------------------------


ODD = {**image(7), "boot": {"S": "\x00\udfff and \ufffe, which SQS does not carry"}}
LIVE_EVENT = {"topic": build_topic("live", "car", "vesc"), "v": 9}
RULE_RECORD, INVOKED = f"{BY_RULE} iort_record", f"{BY_FUNCTION} iort-processing-Live-1"
PREFIX, LEFT = "$aws/rules/iort_record/", "RetryAttemptsExhausted; the records have left the stream"
EXHAUSTED = "Lambda 2 failed: RetryAttemptsExhausted"


def said(topic, robot, source=BY_STREAM, reason=REFUSAL):
    return source, topic, robot, reason


# The queue's message and the stream's records; what the entries say, and their payloads.
KEPT = {
    "a rule's error": (rule_error(), none, said(TOPIC_OF_CAR, "car", RULE_RECORD), [RAW]),
    # AWS' documentation does not say whether the error document has Basic Ingest's prefix.
    "prefix": (rule_error(topic=PREFIX + TOPIC_OF_CAR), none, said(TOPIC_OF_CAR, "car", RULE_RECORD), [RAW]),
    "refused": (message(Refused("5", "v 9", ODD)), none, said(TOPIC_OF_CAR, "car", reason="v 9"), [ODD]),
    "retries": (failed_batch(), records, said(TOPIC_OF_CAR, "car", reason=EXHAUSTED), [image(2), image(3)]),
    "left the stream": (failed_batch(), none, said("", NO_ROBOT, reason=LEFT), [json.loads(failed_batch())]),
    "an invocation": (
        *(invocation(LIVE_EVENT), none),
        *(said(LIVE_EVENT["topic"], "car", INVOKED, "RetriesExhausted: boom"), [LIVE_EVENT]),
    ),
    # Topics without a robot, invalid ones that name it, and prefixes that stay.
    **{
        f"topic {topic}": (rule_error(topic=topic), none, said(topic, robot, RULE_RECORD), [RAW])
        for topic, robot in {
            **dict.fromkeys(("", "dt", "dt/iort", "dt/iort//vesc", "other/iort/car/a"), NO_ROBOT),
            "$aws/events/presence/connected/car": NO_ROBOT,
            f"$aws/rules/iort_live/{TOPIC_OF_CAR}": NO_ROBOT,
            "dt/iort/car/a/b": "car",
            "dt/iort/c r/vesc": "c r",
            "dt/iort/car": "car",
        }.items()
    },
    "two prefixes": (
        *(rule_error(topic=PREFIX * 2 + TOPIC_OF_CAR), none),
        *(said(PREFIX + TOPIC_OF_CAR, NO_ROBOT, RULE_RECORD), [RAW]),
    ),
}


@pytest.mark.parametrize(("body", "stream", "texts", "payloads"), KEPT.values(), ids=KEPT)
def test_a_message_of_the_queue_is_kept(body, stream, texts, payloads):
    body.encode("ascii")
    rows = entries(body, stream)
    assert {(row.source, row.topic, row.robot, row.reason) for row in rows} == {texts}
    assert [row.payload if row.payload == RAW else _content(row.payload) for row in rows] == payloads


def _content(payload):
    return json.loads(payload.decode("utf-8", "surrogatepass"))


FORMS = ("base64OriginalPayload", "base64Item", "reason", "ruleName", "failures")
FORMS += ("requestPayload", "requestContext", "DDBStreamBatchInfo")
documents = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(max_size=10),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(FORMS), inner, max_size=4),
    max_leaves=10,
)


@given(documents.map(json.dumps) | st.text())
def test_any_other_message_of_the_queue_is_kept_as_it_is(body):
    found = entries(body, none)
    assert found
    for entry in found:
        assert entry.reason
        assert entry.robot
    if all("does not know" in entry.reason for entry in found):
        assert [entry.payload for entry in found] == [body.encode("utf-8", "surrogatepass")]


def test_equal_messages_share_one_entry_and_different_ones_do_not():
    ids = {
        Entry(source, topic, reason, payload).id
        for source in ("rule a", "rule b")
        for topic in ("dt/iort/car/vesc", "dt/iort/car/rtt")
        for payload in (b"1", b"2", b"")
        for reason in ("because", "because of something else")
    }
    assert len(ids) == 12


REFUSING = {echo: (PING, LAMBDA), upload: (PING, FILE), answer: (ASK, "calibration"), live: (LIVE, "vesc")}


@pytest.mark.parametrize("function", REFUSING, ids=lambda one: one.__name__)
def test_what_a_function_refuses_is_kept_and_fails_only_without_the_queue(
    function, invoke, rejected, monkeypatch
):
    for name, value in {
        "UPLOAD_BYTES_A_DAY": "1",
        "PUBNUB_PARAMETER": "/iort/pubnub",
        "LIVE_FIELDS": "{}",
    }.items():
        monkeypatch.setenv(name, value)
    lane, name = REFUSING[function]
    event = rule_event(b"\xff", build_topic(lane, "car", name), NOW_MS)
    invoke(function.handler, event)
    (entry,) = rejected()
    assert (entry.source, entry.robot) == (f"function {function.__name__.rpartition('.')[2]}", "car")
    assert (entry.payload, entry.reason[:9]) == (b"\xff", "Refused: ")
    monkeypatch.setenv("REJECTED_QUEUE", "https://sqs.eu-west-1.amazonaws.com/0/none")
    variables.cache_clear()
    with pytest.raises(ContractError):
        invoke(function.handler, event)


# --- into the table ---------------------------------------------------------------------------------


def sqs_event(*bodies, sent_ms=1_700_000_000_000):
    return {
        "Records": [
            {"messageId": f"m{i}", "body": body, "attributes": {"SentTimestamp": str(sent_ms + i)}}
            for i, body in enumerate(bodies)
        ]
    }


@pytest.fixture
def store(dynamodb):
    return Store(dynamodb, table=QUARANTINE, retention_s=3600)


def kept(dynamodb):
    return dynamodb.scan(TableName=QUARANTINE)["Items"]


def test_every_kind_is_kept_with_its_bytes_and_counted(dynamodb, store, capsys):
    event = sqs_event(rule_error(), failed_batch(), invocation({"v": 1}), "nonsense")
    assert process(event, store, records) == {"batchItemFailures": []}
    items = kept(dynamodb)
    assert len(items) == 5
    assert RAW in [item["payload"]["B"] for item in items]
    assert json.loads(capsys.readouterr().out)["Quarantined"] == 5


def test_a_repeated_message_is_one_entry_with_a_count(dynamodb, store):
    process(sqs_event(rule_error()), store, none)
    process(sqs_event(rule_error(cloudwatchTraceId="another"), sent_ms=1_700_000_900_000), store, none)
    (item,) = kept(dynamodb)
    assert item["seen"] == {"N": "2"}
    assert (item["first_ms"], item["last_ms"]) == ({"N": "1700000000000"}, {"N": "1700000900000"})
    assert item["expires_s"] == {"N": "1700004500"}


class Broken:
    """A table that refuses the second item."""

    def __init__(self, error):
        self.calls, self.error = 0, error

    def update_item(self, **_):
        self.calls += 1
        if self.calls == 2:
            raise self.error


THROTTLED = {"Error": {"Code": "ProvisionedThroughputExceededException", "Message": "slow down"}}


@pytest.mark.parametrize(
    "error", [ClientError(THROTTLED, "UpdateItem"), RuntimeError("nobody thought of it")]
)
def test_only_the_message_that_was_not_kept_is_returned_to_the_queue(error):
    event, table = sqs_event(rule_error(b"1"), rule_error(b"2"), rule_error(b"3")), Broken(error)
    answer = process(event, Store(table, table=QUARANTINE, retention_s=1), none)
    assert answer == {"batchItemFailures": [{"itemIdentifier": "m1"}]}
    assert table.calls == 3


@pytest.mark.parametrize(
    "odd",
    [
        invocation({"topic": "live/iort/car/vesc"}, "half of a pair: \ud800"),
        invocation({"topic": "live/iort/car\udfff/vesc"}),
        rule_error(topic="dt/iort/car\ud800/vesc"),
        invocation({"topic": "ping/iort/car/lambda", "a": "NEST"}).replace(
            '"NEST"', "[" * 50_000 + "]" * 50_000
        ),
    ],
    ids=["reason", "robot", "topic", "nested"],
)
def test_an_unreadable_message_is_kept_and_so_are_its_neighbours(odd, dynamodb, store):
    assert process(sqs_event(rule_error(), odd, failed_batch()), store, records) == {"batchItemFailures": []}
    assert len(kept(dynamodb)) == 4


# --- the stream, and the queue before ----------------------------------------------------------------


class FakeStreams:
    """A stream with one record a page, after some empty pages; the second and third are wanted."""

    class exceptions:
        class TrimmedDataAccessException(Exception):
            pass

    def __init__(self, *, trimmed=False, empty=0, ends_at=9):
        self.trimmed, self.empty, self.ends_at = trimmed, empty, ends_at
        self.left = empty

    def get_shard_iterator(self, **request):
        assert request == {
            "StreamArn": STREAM_ARN,
            "ShardId": "shard-1",
            "ShardIteratorType": "AT_SEQUENCE_NUMBER",
            "SequenceNumber": "2",
        }
        if self.trimmed:
            raise self.exceptions.TrimmedDataAccessException
        return {"ShardIterator": "2"}

    def get_records(self, *, ShardIterator):
        n = int(ShardIterator)
        if self.left or n >= self.ends_at:
            self.left -= 1
            return {"Records": [], "NextShardIterator": str(n)}
        self.left = self.empty
        return {"Records": [{"dynamodb": {"SequenceNumber": str(n)}}], "NextShardIterator": str(n + 1)}


@pytest.mark.parametrize("empty", [0, 1, 20])
def test_the_records_of_a_failed_batch_are_read_after_empty_pages(empty):
    found = Stream(FakeStreams(empty=empty)).records(INFO)
    assert [record["dynamodb"]["SequenceNumber"] for record in found] == ["2", "3"]


def test_expired_records_read_as_an_empty_list():
    assert Stream(FakeStreams(trimmed=True)).records(INFO) == []


def test_a_batch_that_is_read_only_in_part_stays_in_the_queue(dynamodb, store):
    answer = process(sqs_event(failed_batch()), store, Stream(FakeStreams(ends_at=3)).records)
    assert answer == {"batchItemFailures": [{"itemIdentifier": "m0"}]}
    assert kept(dynamodb) == []


def test_a_message_larger_than_an_item_is_cut(dynamodb, store):
    big = {**image(7), "x": {"L": [{"N": "1"}] * 60_000}}
    body = message(Refused("5", "no batch", big))
    assert process(sqs_event(body), store, none) == {"batchItemFailures": []}
    (item,) = kept(dynamodb)
    assert item["payload"]["B"].startswith(b'{"topic":{"S":"dt/iort/car/vesc"}')
    assert item["reason"]["S"].startswith("cut from ")
    assert item["reason"]["S"].endswith("no batch")


class FakeQueue:
    def __init__(self, refuses=(), *, throttled=False):
        self.refuses, self.throttled, self.calls = refuses, throttled, []

    def send_message_batch(self, *, QueueUrl, Entries):
        assert QueueUrl == "queue"
        if self.throttled:
            raise ClientError({"Error": {"Code": "Throttling", "Message": ""}}, "SendMessageBatch")
        assert 1 <= len(Entries) <= 10
        assert sum(len(entry["MessageBody"]) for entry in Entries) <= 256 * 1024
        refused = [e for e in Entries if json.loads(e["MessageBody"])["reason"] in self.refuses]
        self.calls.append([e["MessageBody"] for e in Entries if e not in refused])
        return {"Failed": [{"Id": entry["Id"], "Code": "InternalError"} for entry in refused]}


def test_refused_records_are_sent_in_calls_within_the_limits_of_sqs():
    refused = [Refused(str(n), f"reason {n}", image(n)) for n in range(23)]
    queue = FakeQueue()
    assert DeadLetterQueue(queue, queue_url="queue").refuse(refused) == []
    assert [len(call) for call in queue.calls] == [10, 10, 3]
    large = [Refused(str(n), "large", {**image(n), "x": {"S": "x" * 90_000}}) for n in range(5)]
    queue = FakeQueue()
    assert DeadLetterQueue(queue, queue_url="queue").refuse(large) == []
    assert [len(call) for call in queue.calls] == [2, 2, 1]
    assert DeadLetterQueue(queue, queue_url="queue").refuse([]) == []


@pytest.mark.parametrize("throttled", [False, True])
def test_records_that_the_queue_does_not_take_are_returned(throttled):
    refused = [Refused(str(n), f"reason {n}", image(n)) for n in range(12)]
    queue = FakeQueue(refuses={"reason 1", "reason 11"}, throttled=throttled)
    left = refused if throttled else [refused[1], refused[11]]
    assert DeadLetterQueue(queue, queue_url="queue").refuse(refused) == left
    taken = [one.reason for one in refused if one not in left]
    assert [json.loads(body)["reason"] for call in queue.calls for body in call] == taken


def test_a_record_too_large_for_a_queue_is_sent_as_its_key():
    # "1e125" on the wire; a message may hold ten thousand of them.
    numbers = {f"a{i}": {"N": "1" + "0" * 125} for i in range(8_000)}
    refused = Refused("5", "schema version 9", {**image(7), **numbers})
    body = message(refused)
    assert len(body) <= 1024 * 1024
    (entry,) = entries(body, none)
    assert (entry.source, entry.topic, entry.robot) == (BY_STREAM, TOPIC_OF_CAR, "car")
    assert json.loads(entry.payload) == {name: image(7)[name] for name in ("topic", "batch")}
    assert "telemetry table" in entry.reason
    assert "schema version 9" in entry.reason


def test_deferred_batches_that_failed_are_kept_by_their_keys():
    topic = build_topic(RECORD, "car", "vesc")
    body = json.dumps({PUT_OFF: [[topic, "0000000000000001-0badcafe-0"]]})
    (entry,) = entries(body, list)
    assert (entry.source, entry.robot, entry.payload) == (BY_LATER, "car", body.encode())
    for odd in ({PUT_OFF: []}, {PUT_OFF: 5}, {PUT_OFF: [["a"]]}):
        (entry,) = entries(json.dumps(odd), list)
        assert "does not know" in entry.reason


# No rule mistakes a key of a robot's message for a key that the cloud adds.

T_US = 1_700_000_000_000_000
RETENTION_S = 3600
BATCH = encode_batch(Batch("0badcafe", 3, [T_US], {"speed": [1.5]}, nonfinite=2, previous=()))
SAMPLE = {FAULT_FIELD: 3, VOLTAGE_FIELD: 9.5}
LIVE_MESSAGE = encode_live(LiveSample("0badcafe", 3, T_US, T_US, SAMPLE))
PING_MESSAGE = encode_ping(7, T_US, "padding")
REPORT = json.dumps({"state": {"reported": {AGENT_VERSION: "1.2.3", ROBOT: "b"}}}).encode()
CONNECTED = json.dumps(
    {"clientId": "a", "eventType": "connected", "timestamp": NOW_MS, "versionNumber": 1}
    | {"principalIdentifier": "f" * 64}
).encode()

# By rule: lane and name of the topic of robot a, and the honest message.
SENT = {
    "record": (RECORD, "vesc", BATCH),
    "live": (LIVE, "vesc", LIVE_MESSAGE),
    "fault": (LIVE, "vesc", LIVE_MESSAGE),
    "battery": (LIVE, "vesc", LIVE_MESSAGE),
    "pong": (PING, RULE, PING_MESSAGE),
    "echo": (PING, LAMBDA, PING_MESSAGE),
    "upload": (PING, FILE, PING_MESSAGE),
    "ask": (ASK, "calibration", PING_MESSAGE),
}
WHOSE = {rule: build_topic(lane, "a", name) for rule, (lane, name, _) in SENT.items()}


def of_rule(rule, topic, payload):
    """The event or item that a rule makes from a message on a topic."""
    return evaluate(RULES[rule].statement(retention_s=RETENTION_S), topic, payload, NOW_MS)


def test_every_rule_has_a_spoofed_message():
    assert {*SENT, "presence", "version"} == set(RULES)


@pytest.mark.parametrize("rule", SENT)
def test_a_rule_handles_a_spoofed_message_like_an_honest_one(rule):
    lane, name, message = SENT[rule]
    honest = of_rule(rule, WHOSE[rule], message)
    told = of_rule(rule, WHOSE[rule], spoofed(message, "b", lane, name))
    if MESSAGE_BASE64 in honest:
        assert event_message(honest) == message
        # The encoded message may hold any keys.
        assert event_message(told) == spoofed(message, "b", lane, name)
        honest, told = ({**one, MESSAGE_BASE64: ""} for one in (honest, told))
    assert told == honest
    assert told[RECEIVED_MS] == NOW_MS
    assert told.get(TOPIC, WHOSE[rule]) == WHOSE[rule]
    assert told.get(EXPIRES_S) == (NOW_MS // 1000 + RETENTION_S if rule == "record" else None)


def test_lambda_2_gets_the_robot_of_the_topic_and_its_batch():
    item = of_rule("record", WHOSE["record"], spoofed(BATCH, "b", RECORD, "vesc"))
    topic, batch = decode_item(item)
    assert (topic.robot, batch) == ("a", decode_batch(BATCH))
    assert set(item) == {*ENVELOPE, TOPIC, RECEIVED_MS, EXPIRES_S}


def test_a_batch_without_nonfinite_is_stored_without_it():
    message = encode_batch(Batch("0badcafe", 3, [T_US], {"speed": [1.5]}))
    item = of_rule("record", WHOSE["record"], message)
    assert not {NONFINITE, PREVIOUS} & set(item)
    assert decode_item(item)[1] == decode_batch(message)


def test_the_rules_pong_has_the_clouds_time():
    answer = of_rule("pong", WHOSE["pong"], spoofed(PING_MESSAGE, "b", PING, RULE))
    assert decode_pong(json.dumps(answer)) == (7, T_US, NOW_MS)


def test_a_version_belongs_to_the_robot_of_the_shadows_topic():
    topic = f"$aws/things/a/shadow/name/{SHADOW}/update/accepted"
    document = json.loads(spoofed(REPORT, "b", LIVE, "vesc"))
    event = of_rule("version", topic, json.dumps(document).encode())
    assert event == {AGENT_VERSION: "1.2.3", ROBOT: "a"}
    assert presence.change(event)["Key"] == {ROBOT: {"S": "a"}}
    assert of_rule("version", topic, b'{"state": {"reported": {}}}') is None


def test_the_brokers_own_event_is_passed_on_unchanged():
    event = of_rule("presence", "$aws/events/presence/connected/a", CONNECTED)
    assert event == json.loads(CONNECTED)
    assert presence.change(event)["Key"] == {ROBOT: {"S": "a"}}
    assert of_rule("presence", "$aws/events/presence/x/a", b'{"eventType": "connect_failed"}') is None


# "Lifecycle events": a certificate's id, or IAM credentials.
CERTIFICATE, SESSION = "0123456789abcdef" * 4, "AROAEXAMPLEEXAMPLEEX:CognitoIdentityCredentials"


@pytest.mark.parametrize("kind", ["connected", "disconnected"])
@pytest.mark.parametrize(
    ("client", "principal", "noted"),
    [
        ("a", CERTIFICATE, True),
        ("iort-viewer-robot", CERTIFICATE, True),
        (f"{client_prefix(VIEWER)}0a1b2c3d", SESSION, False),
        (f"{client_prefix(DRIVER)}0a1b2c3d", SESSION, False),
        (f"{claim_name()}-0a1b2c3d", CERTIFICATE, False),
        # A role that a page or program of another deployment has.
        ("a", SESSION, False),
        ("a", "AIDAEXAMPLEEXAMPLEEX", False),
    ],
)
def test_presence_is_called_for_robots_only(client, principal, kind, noted):
    event = {**json.loads(CONNECTED), "clientId": client, "principalIdentifier": principal, "eventType": kind}
    sent = json.dumps(event).encode()
    assert (of_rule("presence", f"$aws/events/presence/{kind}/{client}", sent) is not None) == noted
