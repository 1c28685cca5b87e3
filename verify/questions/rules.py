"""The topic rules: as the catalogue has them, with faked keys, and what an error action gets."""

from __future__ import annotations

import hashlib
import itertools
import json
import time
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from functions.quarantine import entries
from iort_contract.catalog.questions import CALIBRATION
from iort_contract.catalog.rules import RULES
from iort_contract.catalog.vesc import FAULT_FIELD, VESC_STREAM, VOLTAGE_FIELD
from iort_contract.messages.files import File, FileRequest, encode_file_request, file_key
from iort_contract.messages.live import LiveSample, encode_live, encode_ping
from iort_contract.messages.questions import Ask, decode_answer, encode_ask
from iort_contract.tables import AGENT_VERSION, ALERT_PREFIX, EXPIRES_S, RECEIVED_MS, TOPIC
from iort_contract.topics import (
    ANSWER,
    ASK,
    FILE,
    LAMBDA,
    LIVE,
    PING,
    PONG,
    RECORD,
    RULE,
    SHADOW,
    build_topic,
    rule_name,
)
from iort_station.fleet import registry
from testkit.target import Target
from testkit.waiting import InstrumentError, until
from verify.question import Seen, question
from verify.tools import RUN, Pair, batch, items, listener, pair_of, spoofed

_GUIDE = "https://docs.aws.amazon.com/iot/latest/developerguide"
_SQL = f"{_GUIDE}/iot-sql-select.html"
_DYNAMODB_V2 = f"{_GUIDE}/dynamodb-v2-rule-action.html"
_BINARY = f"{_GUIDE}/binary-payloads.html"
# A batch without `nonfinite`, with DynamoDB's types.
_TYPES = {"v": "N", "batch": "S", "codec": "S", "n": "N", "samples": "S"} | {
    TOPIC: "S",
    RECEIVED_MS: "N",
    EXPIRES_S: "N",
}
_RULES = "contract/iort_contract/catalog/rules.py"


def _recent(received_ms: float) -> bool:
    return abs(received_ms / 1000 - time.time()) < 3600


@question(
    "rules.as_catalogued",
    expected={name: [True, 1, True] for name in RULES},
    source=f"{_GUIDE}/iot-create-rule.html",
    relied_on_by=(_RULES, "stacks/ingest.py"),
)
def as_catalogued(target: Target) -> Seen:
    """AWS IoT keeps each rule as the catalogue has it: its SQL letter by letter, one action, and the way into
    the quarantine."""
    client, namespace = target.cloud.client("iot"), target.cloud.namespace
    kept = {
        name: client.get_topic_rule(ruleName=rule.physical_name(namespace))["rule"]
        for name, rule in RULES.items()
    }
    return {
        name: [
            rule["sql"] == RULES[name].statement(namespace),
            len(rule["actions"]),
            "sqs" in rule["errorAction"],
        ]
        for name, rule in kept.items()
    }


@question(
    "rules.record_spoofed",
    expected={
        "own_partition": 1,
        "victims_partition": 0,
        "keys": sorted(_TYPES),
        "received_by_the_clouds_clock": True,
        "expires_by_the_clouds_clock": True,
        "types": dict(sorted(_TYPES.items())),
    },
    source=f"{_SQL} and {_DYNAMODB_V2}",
    relied_on_by=(_RULES, "functions/shared/seconds.py"),
)
def record_spoofed(target: Target) -> Seen:
    """The rule record stores the keys of a batch and the cloud's three, each by name. A key of the message
    with the name of one of the cloud's is not stored. A key that the message lacks is absent. A text becomes
    S, a number N."""
    with pair_of(target, "verify-spoofs-record") as pair:
        pair.send(RECORD, VESC_STREAM, batch())
        (item,) = until(lambda: items(target, pair.robot.name), "the batch in the telemetry table")
        return {
            "own_partition": 1,
            "victims_partition": len(items(target, pair.victim)),
            "keys": sorted(item),
            "received_by_the_clouds_clock": _recent(int(item[RECEIVED_MS]["N"])),
            "expires_by_the_clouds_clock": abs(int(item[EXPIRES_S]["N"]) - time.time()) < 4000 * 86_400,
            "types": {name: next(iter(value)) for name, value in sorted(item.items())},
        }


@question(
    "rules.live_spoofed",
    expected={"as_its_own": True, "received_by_the_clouds_clock": True, "as_the_victims": 0},
    source=f"{_SQL} and {_BINARY}",
    relied_on_by=(_RULES, "functions/live.py"),
)
def live_spoofed(target: Target) -> Seen:
    """The rule live hands the message over as one value in base64. Lambda 1 publishes it for the robot of the
    topic, whatever the message says."""
    with (
        pair_of(target, "verify-spoofs-live") as pair,
        listener(target, pair.robot.name) as own,
        listener(target, pair.victim) as others,
    ):
        seqs = itertools.count()

        def shown() -> list[Any]:
            # A message that waits for a function's first environment is stale before it is shown.
            now_us = time.time_ns() // 1000
            live = LiveSample(RUN, next(seqs), now_us, now_us, {"speed": 3}, offset_us=0)
            pair.send(LIVE, VESC_STREAM, encode_live(live))
            return own.heard

        heard = until(shown, "the live message on the robot's channel", within_s=60)[-1]
        return {
            "as_its_own": heard.robot == pair.robot.name,
            "received_by_the_clouds_clock": _recent(heard.hops[RECEIVED_MS]),
            "as_the_victims": len(others.heard),
        }


_ANSWERED = {"received_by_the_clouds_clock": True, "the_rest_as_sent": True}


def _ping(target: Target, path: str) -> Seen:
    ping = encode_ping(7, 1_700_000_000_000_000, "padding")
    with pair_of(target, f"verify-spoofs-ping-{path}") as pair:
        answer = pair.asked(path, ping)
    received_ms = answer.pop(RECEIVED_MS)
    return {
        "received_by_the_clouds_clock": _recent(received_ms),
        "the_rest_as_sent": answer == json.loads(ping),
    }


@question(
    "rules.pong_spoofed",
    expected=_ANSWERED,
    source=f"{_SQL} and {_GUIDE}/republish-rule-action.html",
    relied_on_by=(_RULES, "stacks/ingest.py"),
)
def pong_spoofed(target: Target) -> Seen:
    """The rule pong answers to the robot of the topic, with the ping's four fields and the cloud's time."""
    return _ping(target, RULE)


@question(
    "rules.echo_spoofed",
    expected=_ANSWERED,
    source=f"{_SQL} and {_BINARY}",
    relied_on_by=(_RULES, "functions/echo.py"),
)
def echo_spoofed(target: Target) -> Seen:
    """The function echo answers to the robot of the topic, with the ping's fields and the cloud's time."""
    return _ping(target, LAMBDA)


@question(
    "rules.upload_spoofed",
    expected={"key_is_its_own": True, "names_the_victim": False},
    source=f"{_SQL} and {_BINARY}",
    relied_on_by=(_RULES, "functions/upload.py"),
)
def upload_spoofed(target: Target) -> Seen:
    """The function upload answers to the robot of the topic, with addresses below its own prefix."""
    content = b"content"
    sha256 = hashlib.sha256(content).hexdigest()
    file = File("notes.txt", "log", "text/plain", len(content), sha256, time.time_ns() // 1000)
    request = encode_file_request(FileRequest(uuid.uuid4().hex, file, {1: sha256}))
    with pair_of(target, "verify-spoofs-upload") as pair:
        answer = pair.asked(FILE, request)
    return {
        "key_is_its_own": answer.get("key") == file_key(pair.robot.name, file),
        "names_the_victim": pair.victim in json.dumps(answer),
    }


@question(
    "rules.ask_spoofed",
    expected={"answered_its_own": True, "counted_as_its_own": True, "counted_as_the_victims": False},
    source=f"{_SQL} and {_BINARY}",
    relied_on_by=(_RULES, "functions/answer.py"),
)
def ask_spoofed(target: Target) -> Seen:
    """The function answer answers the robot of the topic, and takes the question from its quota."""

    def counted(robot: str) -> bool:
        return CALIBRATION.count_attribute in registry.get(target.cloud, robot)

    asked = Ask(uuid.uuid4().hex, time.time_ns() // 1000, 60_000, {})
    with pair_of(target, "verify-spoofs-ask") as pair:
        answers = build_topic(ANSWER, pair.robot.name, CALIBRATION.name, target.cloud.namespace)
        pair.robot.subscribe(answers)
        pair.send(ASK, CALIBRATION.name, encode_ask(asked))
        topic, answer = pair.robot.next_message()
        return {
            "answered_its_own": (topic, decode_answer(answer).id) == (answers, asked.id),
            "counted_as_its_own": counted(pair.robot.name),
            "counted_as_the_victims": counted(pair.victim),
        }


@question(
    "rules.alerts_spoofed",
    expected={"own_alerts": 2, "victims_alerts": 0},
    source=_SQL,
    relied_on_by=(_RULES, "functions/alert.py"),
)
def alerts_spoofed(target: Target) -> Seen:
    """The rules fault and battery alert of the robot of the topic."""
    now_us = time.time_ns() // 1000
    live = LiveSample(RUN, 0, now_us, now_us, {FAULT_FIELD: 5, VOLTAGE_FIELD: 9.5}, offset_us=0)

    def alerts(robot: str) -> list[str]:
        return [name for name in registry.get(target.cloud, robot) if name.startswith(ALERT_PREFIX)]

    with pair_of(target, "verify-spoofs-alerts") as pair:
        pair.send(LIVE, VESC_STREAM, encode_live(live))
        until(lambda: len(alerts(pair.robot.name)) == 2, "the alerts of both rules", within_s=60)
        return {"own_alerts": 2, "victims_alerts": len(alerts(pair.victim))}


@question(
    "rules.version_spoofed",
    expected={"own": "9.9.9", "victims": None},
    source=f"{_SQL} and {_GUIDE}/reserved-topics.html",
    relied_on_by=(_RULES, "functions/presence.py"),
)
def version_spoofed(target: Target) -> Seen:
    """The rule version takes the robot from the shadow's topic."""

    def version(robot: str) -> Any:
        return registry.get(target.cloud, robot).get(AGENT_VERSION)

    with pair_of(target, "verify-spoofs-version") as pair:
        reported = json.loads(
            spoofed(b'{"agent_version": ""}', pair.victim, LIVE, VESC_STREAM, target.cloud.namespace)
        )
        document = {"state": {"reported": {**reported, AGENT_VERSION: "9.9.9"}}}
        topic = f"$aws/things/{pair.robot.name}/shadow/name/{SHADOW}/update"
        pair.publish(topic, json.dumps(document).encode())
        until(lambda: version(pair.robot.name) == "9.9.9", "the version in the registry", within_s=60)
        return {"own": "9.9.9", "victims": version(pair.victim)}


@contextmanager
def _rule(
    target: Target, select: str, topic: str, *, action: Mapping[str, Any], error: Mapping[str, Any]
) -> Iterator[str]:
    """A rule for this question; yields its name."""
    iot, name = target.cloud.client("iot"), f"{target.cloud.namespace}_verify_{uuid.uuid4().hex[:8]}"
    payload: Any = {
        "sql": f"{select} FROM '{topic}'",
        "awsIotSqlVersion": "2016-03-23",
        "actions": [action],
        "errorAction": error,
    }
    iot.create_topic_rule(ruleName=name, topicRulePayload=payload)
    try:
        yield name
    finally:
        iot.delete_topic_rule(ruleName=name)


def _republishing(target: Target, topic: str) -> dict[str, Any]:
    """An action in the name of the rule pong, which may publish only to robots' pongs."""
    rule = target.cloud.client("iot").get_topic_rule(ruleName=rule_name("pong", target.cloud.namespace))
    (pong,) = rule["rule"]["actions"]
    return {"republish": {"roleArn": pong["republish"]["roleArn"], "topic": topic, "qos": 1}}


def _heard(pair: Pair, topic: str, payload: bytes) -> bytes:
    """The answer to the operator's message, which is repeated until the rule is active."""
    data = pair.target.cloud.client("iot-data")

    def heard() -> bytes | None:
        data.publish(topic=topic, qos=1, payload=payload)
        try:
            return pair.robot.next_message(within_s=2)[1]
        except InstrumentError:
            return None

    return until(heard, f"the rule's answer to {topic}", within_s=50)


@question(
    "rule_errors.document",
    expected={
        "source": "rule NAME",
        "robot_is_the_topics": True,
        "topic_as_published": True,
        "payload_as_published": True,
        "says_why": True,
    },
    source=f"{_GUIDE}/rule-error-handling.html and {_GUIDE}/iot-basic-ingest.html",
    relied_on_by=("functions/quarantine.py", "contract/iort_contract/topics.py"),
)
def document(target: Target) -> Seen:
    """A rule whose action fails gives its error action the topic, the original payload in base64 and the
    reasons. The quarantine reads that, with or without Basic Ingest's prefix before the topic."""
    cloud = target.cloud
    with pair_of(target, "verify-error-document") as pair:
        heard_on = build_topic(PONG, pair.robot.name, RULE, cloud.namespace)
        pair.robot.subscribe(heard_on)
        topic = build_topic(PING, pair.robot.name, "error", cloud.namespace)
        told = _republishing(target, heard_on)
        # The role of the rule pong may not write to the table, and the message lacks the table's key.
        table = {"tableName": cloud.output("storage", "TelemetryTable")}
        fails = {"dynamoDBv2": {"roleArn": told["republish"]["roleArn"], "putItem": table}}
        with _rule(target, "SELECT *", topic, action=fails, error=told) as name:
            body = _heard(pair, f"$aws/rules/{name}/{topic}", b'{"v": 1}').decode()
    document = json.loads(body)
    (entry,) = entries(body, lambda _: ())
    return {
        "source": entry.source.replace(name, "NAME"),
        "robot_is_the_topics": entry.robot == pair.robot.name,
        "topic_as_published": entry.topic == topic,
        "payload_as_published": entry.payload == b'{"v": 1}',
        "says_why": entry.reason != "no reason given",
        "note_keys": sorted(document),
        "note_keys_of_a_failure": sorted(document["failures"][0]),
        "note_topic_has_the_prefix": document["topic"] != topic,
    }


@question(
    "rule_errors.star_beside_a_key",
    expected={"other_keys_stay": True},
    source=f"{_GUIDE}/iot-sql-select.html",
    relied_on_by=("docs/decisions/security/0033-no-mixed-keys.md",),
)
def star_beside_a_key(target: Target) -> Seen:
    """SELECT * with a key beside it adds the key to the payload. AWS does not document which one stays if
    the payload has the same key; no rule of this project depends on it."""
    with pair_of(target, "verify-star") as pair:
        heard_on = build_topic(PONG, pair.robot.name, RULE, target.cloud.namespace)
        pair.robot.subscribe(heard_on)
        topic = build_topic(PING, pair.robot.name, "star", target.cloud.namespace)
        told = _republishing(target, heard_on)
        with _rule(target, f"SELECT *, topic() AS {TOPIC}", topic, action=told, error=told):
            body = _heard(pair, topic, json.dumps({TOPIC: "the message's", "kept": 1}).encode())
    stays = {"the message's": "the message's", topic: "the rule's"}
    members: list[tuple[str, Any]] = json.loads(body, object_pairs_hook=list)
    return {
        "other_keys_stay": ("kept", 1) in members,
        "note_topic_is": [stays.get(value, "another") for name, value in members if name == TOPIC],
    }
