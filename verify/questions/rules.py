"""The topic rules: as the catalogue has them, with faked keys, and what an error action gets."""

from __future__ import annotations

import hashlib
import itertools
import json
import time
import uuid
from collections.abc import Mapping
from typing import Any

from functions.quarantine import entries
from iort_contract.catalog.questions import CALIBRATION
from iort_contract.catalog.rules import RULES
from iort_contract.catalog.vesc import FAULT_FIELD, VESC_STREAM, VOLTAGE_FIELD
from iort_contract.messages.files import File, FileRequest, encode_file_request, file_key
from iort_contract.messages.live import LiveSample, encode_live, encode_ping
from iort_contract.messages.questions import Ask, decode_answer, encode_ask
from iort_contract.tables import AGENT_VERSION, ALERT_PREFIX, EXPIRES_S, RECEIVED_MS, TOPIC
from iort_contract.topics import ANSWER, ASK, FILE, LAMBDA, LIVE, PING, PONG, RECORD, RULE, SHADOW, rule_name
from iort_station.fleet import registry
from testkit.waiting import InstrumentError, until
from verify.lab import RUN, Lab, Pair, batch, spoofed
from verify.question import Seen, question

# A batch without `nonfinite`, with DynamoDB's types.
_TYPES = {"v": "N", "batch": "S", "codec": "S", "n": "N", "samples": "S"} | {
    TOPIC: "S",
    RECEIVED_MS: "N",
    EXPIRES_S: "N",
}


def _recent(received_ms: float) -> bool:
    return abs(received_ms / 1000 - time.time()) < 3600


def _live(number: int, values: Mapping[str, float]) -> bytes:
    now_us = time.time_ns() // 1000
    return encode_live(LiveSample(RUN, number, now_us, now_us, values, offset_us=0))


@question(
    "rules.as_catalogued",
    aws="iot:iot-create-rule",
    expected={name: [True, 1, True] for name in RULES},
)
def as_catalogued(lab: Lab) -> Seen:
    """AWS IoT keeps each rule as the catalogue has it: its SQL letter by letter, one action, and the way into
    the quarantine."""

    def kept(name: str) -> list[bool | int]:
        physical = RULES[name].physical_name(lab.namespace)
        rule = lab.client("iot").get_topic_rule(ruleName=physical)["rule"]
        same = rule["sql"] == RULES[name].statement(lab.namespace)
        return [same, len(rule["actions"]), "sqs" in rule["errorAction"]]

    return {name: kept(name) for name in RULES}


@question(
    "rules.record_spoofed",
    aws="iot:iot-sql-select iot:dynamodb-v2-rule-action",
    expected={
        "own_partition": 1,
        "victims_partition": 0,
        "keys": sorted(_TYPES),
        "received_by_the_clouds_clock": True,
        "expires_by_the_clouds_clock": True,
        "types": _TYPES,
    },
)
def record_spoofed(lab: Lab) -> Seen:
    """The rule record stores the keys of a batch and the cloud's three, each by name. A key of the message
    with the name of one of the cloud's is not stored. A key that the message lacks is absent. A text becomes
    S, a number N."""
    pair = lab.pair("verify-spoofs-record")
    pair.send(RECORD, batch())
    (item,) = until(lambda: lab.items(pair.robot.name), "the batch in the telemetry table")
    return {
        "own_partition": 1,
        "victims_partition": len(lab.items(pair.victim)),
        "keys": sorted(item),
        "received_by_the_clouds_clock": _recent(int(item[RECEIVED_MS]["N"])),
        "expires_by_the_clouds_clock": abs(int(item[EXPIRES_S]["N"]) - time.time()) < 4000 * 86_400,
        "types": {name: next(iter(value)) for name, value in sorted(item.items())},
    }


@question(
    "rules.live_spoofed",
    aws="iot:iot-sql-select iot:binary-payloads",
    expected={"as_its_own": True, "received_by_the_clouds_clock": True, "as_the_victims": 0},
)
def live_spoofed(lab: Lab) -> Seen:
    """The rule live hands the message over as one value in base64. Lambda 1 publishes it for the robot of the
    topic, whatever the message says."""
    pair = lab.pair("verify-spoofs-live")
    own, others, numbers = lab.listener(pair.robot.name), lab.listener(pair.victim), itertools.count()

    def shown() -> list[Any]:
        # A message that waits for a function's first environment is stale before it is shown.
        pair.send(LIVE, _live(next(numbers), {"speed": 3}))
        return own.heard

    heard = until(shown, "the live message on the robot's channel", within_s=60)[-1]
    return {
        "as_its_own": heard.robot == pair.robot.name,
        "received_by_the_clouds_clock": _recent(heard.hops[RECEIVED_MS]),
        "as_the_victims": len(others.heard),
    }


def _ping(lab: Lab, path: str) -> Seen:
    ping = encode_ping(7, 1_700_000_000_000_000, "padding")
    answer = lab.pair(f"verify-spoofs-ping-{path}").answer(path, ping)
    recent = _recent(answer.pop(RECEIVED_MS))
    return {"received_by_the_clouds_clock": recent, "the_rest_as_sent": answer == json.loads(ping)}


@question(
    "rules.pong_spoofed",
    aws="iot:iot-sql-select iot:republish-rule-action",
    expected={"received_by_the_clouds_clock": True, "the_rest_as_sent": True},
)
def pong_spoofed(lab: Lab) -> Seen:
    """The rule pong answers to the robot of the topic, with the ping's four fields and the cloud's time."""
    return _ping(lab, RULE)


@question(
    "rules.echo_spoofed",
    aws="iot:iot-sql-select iot:binary-payloads",
    expected={"received_by_the_clouds_clock": True, "the_rest_as_sent": True},
)
def echo_spoofed(lab: Lab) -> Seen:
    """The function echo answers to the robot of the topic, with the ping's fields and the cloud's time."""
    return _ping(lab, LAMBDA)


@question(
    "rules.upload_spoofed",
    aws="iot:iot-sql-select iot:binary-payloads",
    expected={"key_is_its_own": True, "names_the_victim": False},
)
def upload_spoofed(lab: Lab) -> Seen:
    """The function upload answers to the robot of the topic, with addresses below its own prefix."""
    sha256 = hashlib.sha256(b"content").hexdigest()
    file = File("notes.txt", "log", "text/plain", len(b"content"), sha256, time.time_ns() // 1000)
    pair = lab.pair("verify-spoofs-upload")
    answer = pair.answer(FILE, encode_file_request(FileRequest(uuid.uuid4().hex, file, {1: sha256})))
    own = answer.get("key") == file_key(pair.robot.name, file)
    return {"key_is_its_own": own, "names_the_victim": pair.victim in json.dumps(answer)}


@question(
    "rules.ask_spoofed",
    aws="iot:iot-sql-select iot:binary-payloads",
    expected={"answered_its_own": True, "counted_as_its_own": True, "counted_as_the_victims": False},
)
def ask_spoofed(lab: Lab) -> Seen:
    """The function answer answers the robot of the topic, and takes the question from its quota."""

    def counted(robot: str) -> bool:
        return CALIBRATION.count_attribute in registry.get(lab.cloud, robot)

    request, pair = Ask(uuid.uuid4().hex, time.time_ns() // 1000, 60_000, {}), lab.pair("verify-spoofs-ask")
    answers = pair.topic(ANSWER, CALIBRATION.name)
    pair.robot.subscribe(answers)
    pair.send(ASK, encode_ask(request), CALIBRATION.name)
    topic, answer = pair.robot.next_message()
    return {
        "answered_its_own": (topic, decode_answer(answer).id) == (answers, request.id),
        "counted_as_its_own": counted(pair.robot.name),
        "counted_as_the_victims": counted(pair.victim),
    }


@question(
    "rules.alerts_spoofed",
    aws="iot:iot-sql-select",
    expected={"own_alerts": 2, "victims_alerts": 0},
)
def alerts_spoofed(lab: Lab) -> Seen:
    """The rules fault and battery alert of the robot of the topic."""

    def alerts(robot: str) -> int:
        return sum(name.startswith(ALERT_PREFIX) for name in registry.get(lab.cloud, robot))

    pair = lab.pair("verify-spoofs-alerts")
    pair.send(LIVE, _live(0, {FAULT_FIELD: 5, VOLTAGE_FIELD: 9.5}))
    until(lambda: alerts(pair.robot.name) == 2, "the alerts of both rules", within_s=60)
    return {"own_alerts": 2, "victims_alerts": alerts(pair.victim)}


@question(
    "rules.version_spoofed",
    aws="iot:iot-sql-select iot:reserved-topics",
    expected={"own": "9.9.9", "victims": None},
)
def version_spoofed(lab: Lab) -> Seen:
    """The rule version takes the robot from the shadow's topic."""

    def version(robot: str) -> Any:
        return registry.get(lab.cloud, robot).get(AGENT_VERSION)

    pair = lab.pair("verify-spoofs-version")
    keys = spoofed(b'{"agent_version": ""}', pair.victim, LIVE, VESC_STREAM, lab.namespace)
    document = {"state": {"reported": {**json.loads(keys), AGENT_VERSION: "9.9.9"}}}
    topic = f"$aws/things/{pair.robot.name}/shadow/name/{SHADOW}/update"
    pair.publish(topic, json.dumps(document).encode())
    until(lambda: version(pair.robot.name) == "9.9.9", "the version in the registry", within_s=60)
    return {"own": "9.9.9", "victims": version(pair.victim)}


def _rule(lab: Lab, select: str, topic: str, action: Mapping[str, Any], error: Mapping[str, Any]) -> str:
    """The name of a rule for this question."""
    iot, name = lab.client("iot"), f"{lab.namespace}_verify_{uuid.uuid4().hex[:8]}"
    payload = {
        "sql": f"{select} FROM '{topic}'",
        "awsIotSqlVersion": "2016-03-23",
        "actions": [action],
        "errorAction": error,
    }
    iot.create_topic_rule(ruleName=name, topicRulePayload=payload)
    lab.undo(iot.delete_topic_rule, ruleName=name)
    return name


def _republishing(lab: Lab, topic: str) -> dict[str, Any]:
    """An action in the name of the rule pong, which may publish only to robots' pongs."""
    rule = lab.client("iot").get_topic_rule(ruleName=rule_name("pong", lab.namespace))["rule"]
    role = rule["actions"][0]["republish"]["roleArn"]
    return {"republish": {"roleArn": role, "topic": topic, "qos": 1}}


def _heard(pair: Pair, topic: str, payload: bytes) -> str:
    """The answer to the operator's message, which is repeated until the rule is active."""
    data = pair.lab.client("iot-data")

    def heard() -> bytes | None:
        data.publish(topic=topic, qos=1, payload=payload)
        try:
            return pair.robot.next_message(within_s=2)[1]
        except InstrumentError:
            return None

    return until(heard, f"the rule's answer to {topic}", within_s=50).decode()


@question(
    "rule_errors.document",
    aws="iot:rule-error-handling iot:iot-basic-ingest",
    expected={
        "source": "rule NAME",
        "robot_is_the_topics": True,
        "topic_as_published": True,
        "payload_as_published": True,
        "says_why": True,
    },
)
def document(lab: Lab) -> Seen:
    """A rule whose action fails gives its error action the topic, the original payload in base64 and the
    reasons. The quarantine reads that, with or without Basic Ingest's prefix before the topic."""
    pair, payload = lab.pair("verify-error-document"), b'{"v": 1}'
    topic, answers = pair.topic(PING, "error"), pair.topic(PONG, RULE)
    pair.robot.subscribe(answers)
    error = _republishing(lab, answers)
    # The role of the rule pong may not write to the table, and the message lacks the table's key.
    table = {"tableName": lab.cloud.output("storage", "TelemetryTable")}
    fails = {"dynamoDBv2": {"roleArn": error["republish"]["roleArn"], "putItem": table}}
    name = _rule(lab, "SELECT *", topic, fails, error)
    body = _heard(pair, f"$aws/rules/{name}/{topic}", payload)
    document, (entry,) = json.loads(body), entries(body, lambda _: ())
    return {
        "source": entry.source.replace(name, "NAME"),
        "robot_is_the_topics": entry.robot == pair.robot.name,
        "topic_as_published": entry.topic == topic,
        "payload_as_published": entry.payload == payload,
        "says_why": entry.reason != "no reason given",
        "note_keys": sorted(document),
        "note_keys_of_a_failure": sorted(document["failures"][0]),
        "note_topic_has_the_prefix": document["topic"] != topic,
    }


@question(
    "rule_errors.star_beside_a_key",
    aws="iot:iot-sql-select",
    expected={"other_keys_stay": True},
)
def star_beside_a_key(lab: Lab) -> Seen:
    """SELECT * with a key beside it adds the key to the payload. AWS does not document which one stays if
    the payload has the same key; no rule of this project depends on it."""
    pair = lab.pair("verify-star")
    topic, answers = pair.topic(PING, "star"), pair.topic(PONG, RULE)
    pair.robot.subscribe(answers)
    republishing = _republishing(lab, answers)
    _rule(lab, f"SELECT *, topic() AS {TOPIC}", topic, republishing, republishing)
    body = _heard(pair, topic, json.dumps({TOPIC: "the message's", "kept": 1}).encode())
    whose = {"the message's": "the message's", topic: "the rule's"}
    members: list[tuple[str, Any]] = json.loads(body, object_pairs_hook=list)
    return {
        "other_keys_stay": ("kept", 1) in members,
        "note_topic_is": [whose.get(value, "another") for name, value in members if name == TOPIC],
    }
