"""Messages that cannot be processed are in quarantine with their bytes, and are put back once the cause is
gone.
"""

from __future__ import annotations

import base64
import json
import time

import pytest

from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.messages.batch import Batch, encode_batch
from iort_contract.tables import BY_FUNCTION, BY_STREAM, ENTRY, SAMPLES
from iort_contract.topics import FILE, LAMBDA, LIVE, PING, RECORD, record_topic, rule_name
from iort_station.data.recorded import summary_table, topic_of
from iort_station.operations import audit, quarantine
from testkit.mqtt import Robot
from testkit.waiting import until

RUN = "0badcafe"


@pytest.fixture
def entry_of(embedded):
    """Wait for a robot's only entry; return it with its bytes."""

    def wait(robot):
        (listed,) = until(lambda: list(quarantine.entries(embedded.cloud, robot=robot)))
        return quarantine.load(embedded.cloud, listed)

    return wait


def send(car, *messages, stream=VESC_STREAM, namespace="iort"):
    topic = record_topic(car.robot, VESC_STREAM, namespace)
    topic = topic.removesuffix(VESC_STREAM) + stream
    with Robot(car.folder) as robot:
        robot.online()
        for message in messages:
            assert robot.publish(topic, message) == "SUCCESS"


def batch(seq=0, **changes):
    """Make the message of a current batch, with changes to its envelope."""
    t_us = (int(time.time()) + seq) * 1_000_000
    envelope = json.loads(encode_batch(Batch(RUN, seq, [t_us], {"speed": [1.5]})))
    return json.dumps({**envelope, **changes}).encode()


# --- messages in quarantine, and their origin ---------------------------------------------------------

RULE, FILES = "rule iort_record", f"{BY_FUNCTION} iort-processing-Upload"
RECORDED, LIVE_, PING_FILE = f"{RECORD}/iort/{{}}/vesc", f"{LIVE}/iort/{{}}/vesc", f"{PING}/iort/{{}}/{FILE}"
# Batches go to the rule by Basic Ingest; elsewhere no robot may send them.
STRAIGHT = f"$aws/rules/{rule_name('record')}/"
# The topic and the message, the stage that refuses it, and a part of the reason.
REFUSED = [
    *(
        (RECORDED, message, RULE, "DynamoDBv2Action")
        for message in (
            *(b"not json", b"\xff\xfe\x00", b'{"v": 1}', b"[]", b'{"batch": 5}', b""),
            b'{"batch": "1", "a": ' + b"[" * 50_000 + b"]" * 50_000 + b"}",
            b'{"batch": "1", "a": ' + b"9" * 5_000 + b"}",
        )
    ),
    (RECORDED, batch(1, v=1), BY_STREAM, "schema version must be 2, got 1"),
    (RECORDED, batch(2, codec="later"), BY_STREAM, "codec must be steps"),
    (RECORDED, batch(3, samples="AAAA"), BY_STREAM, "samples must be base64 of zlib"),
    (RECORDED, batch(batch="yesterday"), BY_STREAM, "must be <16 digits of microseconds>-<run>-<number>"),
    (RECORDED, batch(batch="4000000000000000-0badcafe-0"), BY_STREAM, "clock is wrong"),
    (
        f"{RECORD}/iort/{{}}/b ad",
        batch(4),
        BY_STREAM,
        "stream name must be 1 to 64 of A-Z a-z 0-9 _ -, got 'b ad'",
    ),
    (f"{RECORD}/iort/{{}}/a/b", batch(5), BY_STREAM, "must be <lane>/<namespace>/<robot>/<name>"),
    *(
        (LIVE_, message, f"{BY_FUNCTION} iort-processing-Live", "Refused: ContractError: ")
        for message in (b'{"speed": 99}', b"\xff\x00 no JSON")
    ),
    (f"{PING}/iort/{{}}/{LAMBDA}", b"\xff\x00 no JSON", f"{BY_FUNCTION} iort-processing-Echo", "not JSON"),
    *((PING_FILE, message, FILES, "not JSON") for message in (b"", b"\xff\x00", b"no JSON")),
    *(
        (PING_FILE, message, FILES, "Refused: ")
        for message in (
            *(b"[]", b"5", b"{}", b'{"id": 5}', b'{"id": "no-run"}', b'{"id": NaN}'),
            *(b'{"id": null, "file": []}', b'{"id": {"a": 1}, "v": 1}'),
        )
    ),
]


def test_each_refused_message_is_kept_byte_by_byte_with_its_stage_and_reason(embedded, bundle):
    car = bundle()
    with Robot(car.folder) as robot:
        robot.online()
        for topic, message, *_ in REFUSED:
            straight = STRAIGHT if topic.startswith(f"{RECORD}/") else ""
            assert robot.publish(f"{straight}{topic.format(car.robot)}", message) == "SUCCESS"
    listed = until(
        lambda: (
            len(found := list(quarantine.entries(embedded.cloud, robot=car.robot))) >= len(REFUSED) and found
        )
    )
    entries = [quarantine.load(embedded.cloud, one) for one in listed]
    for topic, message, stage, reason in REFUSED:
        (entry,) = [one for one in entries if holds(one, topic.format(car.robot), message)]
        assert entry.source.startswith(stage), message[:80]
        assert reason in entry.reason, message[:80]
    assert len(entries) == len(REFUSED)


def holds(entry, topic, message):
    """Whether an entry has this message: its bytes, or what the rule has stored of it."""
    if entry.source != BY_STREAM:
        return (entry.topic, entry.payload) == (topic, message)
    stored = json.loads(entry.payload)
    try:
        sent = json.loads(message)
    except (ValueError, RecursionError):
        return False
    return (
        isinstance(sent, dict)
        and "samples" in sent
        and stored["topic"] == {"S": topic}
        and all(stored.get(name) in ({"S": value}, {"N": str(value)}) for name, value in sent.items())
    )


def test_an_undecodable_batch_does_not_delay_its_neighbours(embedded, bundle, entry_of):
    car = bundle()
    send(car, batch(0), batch(1, samples="AAAA"), batch(2))
    until(lambda: audit.samples_summarized(embedded.cloud, car.robot, VESC_STREAM) == 2)
    assert json.loads(entry_of(car.robot).payload)["batch"]["S"].endswith("-1")


# --- the operator's commands ---------------------------------------------------------------------------


def rejected(embedded, robot, message):
    """Make the message that the record rule's error action sends when the table is throttled."""
    document = {
        "ruleName": rule_name("record"),
        "topic": f"dt/iort/{robot}/{VESC_STREAM}",
        "base64OriginalPayload": base64.b64encode(message).decode(),
        "failures": [{"failedAction": "DynamoDBv2Action", "errorMessage": "throttled"}],
    }
    queue = embedded.cloud.output("quarantine", "RejectedQueue")
    embedded.cloud.client("sqs").send_message(QueueUrl=queue, MessageBody=json.dumps(document))


def test_errors_are_listed_and_shown(bundle, iort, entry_of):
    car = bundle()
    send(car, b"\xff\x00" + b"[bold]no markup[/bold]\x1b[2J")
    entry = entry_of(car.robot)
    listed = json.loads(iort("errors", "--robot", car.robot, "--last", "10m", "--json").stdout)
    assert [(one[ENTRY], one["seen"]) for one in listed["entries"]] == [(entry.id, 1)]
    assert json.loads(iort("errors", "--to", "2020-01-01Z", "--json").stdout)["entries"] == []
    assert car.robot in iort("errors").stdout
    shown = iort("errors", entry.id)
    assert shown.exit_code == 0
    assert "000000  ff 00 5b 62" in shown.stdout
    assert "\x1b[2J" not in shown.stdout
    as_json = json.loads(iort("errors", entry.id, "--json").stdout)
    assert base64.b64decode(as_json["payload_base64"]) == entry.payload
    assert "no dead letter has the id" in str(iort("errors", "0" * 16).exception)


def test_a_throttled_batch_is_put_back_once_and_then_deleted(embedded, bundle, iort, entry_of):
    car = bundle()
    rejected(embedded, car.robot, batch(0))
    entry_of(car.robot)
    dry = iort("replay-errors", "--robot", car.robot, "--dry-run")
    assert "1 would be replayed" in dry.stdout
    assert audit.samples_summarized(embedded.cloud, car.robot, VESC_STREAM) == 0
    done = iort("replay-errors", "--robot", car.robot)
    assert (done.exit_code, "1 replayed" in done.stdout) == (0, True), done.output
    until(lambda: audit.samples_summarized(embedded.cloud, car.robot, VESC_STREAM) == 1)
    assert list(quarantine.entries(embedded.cloud, robot=car.robot)) == []
    assert "nothing in quarantine" in iort("replay-errors", "--robot", car.robot).stdout


def test_a_message_that_is_still_invalid_stays_in_quarantine(embedded, bundle, iort, entry_of):
    car = bundle()
    send(car, b"not json")
    before = entry_of(car.robot)
    done = iort("replay-errors", "--robot", car.robot)
    assert "1 still refused" in done.stdout
    assert entry_of(car.robot) == before


def test_a_batch_that_fails_in_lambda_2_is_quarantined_and_put_back(embedded, bundle, iort, entry_of):
    """The summary table's name is wrong for a while: every attempt fails, and the stream continues."""
    cloud, car = embedded.cloud, bundle()
    client, name = cloud.client("lambda"), cloud.output("processing", "SummarizeFunction")
    right = client.get_function_configuration(FunctionName=name)["Environment"]["Variables"]
    wrong = {**right, "SUMMARY_TABLE": "no-such-table"}
    client.update_function_configuration(FunctionName=name, Environment={"Variables": wrong})
    try:
        send(car, batch(0))
        entry = entry_of(car.robot)
        assert "RetryAttemptsExhausted" in entry.reason
        failed = iort("replay-errors", "--robot", car.robot)
        assert failed.exit_code == 1
        assert "failed again: Lambda 2 failed" in failed.stdout
        assert entry_of(car.robot).replays == 1
    finally:
        client.update_function_configuration(FunctionName=name, Environment={"Variables": right})
    assert audit.samples_summarized(cloud, car.robot, VESC_STREAM) == 0
    done = iort("replay-errors", "--robot", car.robot)
    assert "1 replayed" in done.stdout, done.output
    assert audit.samples_summarized(cloud, car.robot, VESC_STREAM) == 1
    assert list(quarantine.entries(cloud, robot=car.robot)) == []


def test_a_message_that_quarantine_cannot_keep_is_put_back_from_the_last_queue(embedded, bundle, iort):
    """The quarantine function is broken: after five attempts the message waits in the last queue."""
    cloud, car = embedded.cloud, bundle()
    sqs, last = cloud.client("sqs"), cloud.output("quarantine", "LastQueue")
    document = {"ruleName": "iort_record", "topic": f"dt/iort/{car.robot}/vesc", "failures": []}
    document["base64OriginalPayload"] = base64.b64encode(b"never kept so far").decode()
    sqs.send_message(QueueUrl=last, MessageBody=json.dumps(document))
    assert "did not take" in iort("errors").stderr
    assert "on the way to it again" in iort("replay-errors", "--robot", car.robot).stderr
    (entry,) = until(lambda: list(quarantine.entries(cloud, robot=car.robot)))
    assert quarantine.load(cloud, entry).payload == b"never kept so far"


# --- effects of one robot on the others ---------------------------------------------------------------


def hostile_messages():
    """Make messages that no agent sends; the record rule stores or rejects them."""
    t_us = int(time.time()) * 1_000_000
    far = {f"a{i}": 1e125 for i in range(1000)}
    changes = [
        {"batch": 10**124},
        far,
        {"batch": "x" * 3000},
        {"batch": "-5"},
        {"nonfinite": -1},
        {"n": 10**9},
        {"robot": "other"},
    ]
    changes += [{"samples": "x" * 100_000}, {"batch": "\ud800"}, {"x": [1] * 20_000}, {"codec": None}]
    nested = b'{"v":2,"batch":"%d-0badcafe-0","a":' % t_us + b"[" * 900 + b"]" * 900 + b"}"
    return [batch(i, **change) for i, change in enumerate(changes)] + [
        nested,
        b'{"batch":"5","n":1e400}',
        b'{"":1,"batch":"7"}',
    ]


def test_invalid_messages_do_not_delay_other_robots_summaries(bundle, embedded):
    cloud = embedded.cloud
    send(bundle("bad"), *hostile_messages())
    good = bundle("good")
    send(good, batch())
    table, topic = summary_table(cloud), topic_of(cloud, good.robot, VESC_STREAM)
    (second,) = until(lambda: next(table.pages(topic)).items)
    assert second[SAMPLES] == {"N": "1"}
