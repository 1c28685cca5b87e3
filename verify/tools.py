"""Tools of several questions: robots, batches, files, mails. They may use everything but the questions."""

from __future__ import annotations

import base64
import hashlib
import http.client
import json
import re
import ssl
import time
import uuid
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from iort_agent.files.upload import trusting
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.limits import DEFAULT_NAMESPACE
from iort_contract.messages.batch import Batch, encode_batch
from iort_contract.messages.files import (
    Address,
    File,
    FileAnswer,
    FileRequest,
    decode_file_answer,
    encode_file_request,
    file_key,
)
from iort_contract.tables import AGENT_VERSION, EXPIRES_S, MESSAGE_BASE64, RECEIVED_MS, ROBOT, STREAMS, TOPIC
from iort_contract.topics import FILE, PING, PONG, RECORD, build_topic, record_topic
from iort_station.errors import StationError
from iort_station.fleet import registry, robots
from iort_station.fleet.robots import Bundle
from iort_station.operations import quarantine
from iort_station.operations.quarantine import DeadLetter
from iort_station.page.pubnub import Listener
from testkit.mqtt import Robot
from testkit.target import Target
from testkit.waiting import InstrumentError, until
from verify.question import CannotAskError

_PROBE = "verify: does this arrive?"
Message = dict[str, Any]
# Returns the first message that matches. Raises `InstrumentError` if none arrives in time.
Receive = Callable[[Callable[[Message], bool], str], Message]


@contextmanager
def inbox(target: Target, topic: str) -> Iterator[Receive]:
    """A queue subscribed to the topic; subscription and queue are removed at the end."""
    sqs, sns = target.cloud.client("sqs"), target.cloud.client("sns")
    # SQS refuses a name for 60 s after its queue was deleted.
    name = f"{target.cloud.namespace}-verify-{uuid.uuid4().hex[:8]}"
    url = sqs.create_queue(QueueName=name)["QueueUrl"]
    try:
        arn = sqs.get_queue_attributes(QueueUrl=url, AttributeNames=["QueueArn"])["Attributes"]["QueueArn"]
        sqs.set_queue_attributes(QueueUrl=url, Attributes={"Policy": _policy(arn, topic)})
        subscription = sns.subscribe(TopicArn=topic, Protocol="sqs", Endpoint=arn)["SubscriptionArn"]
        try:
            # A queue's policy may take 60 s to become effective, and earlier messages are lost.
            until(lambda: _probed(sns, topic, sqs, url), "a message of the topic at its new subscriber")
            yield lambda wanted, what: until(lambda: _received(sqs, url, wanted), what)
        finally:
            sns.unsubscribe(SubscriptionArn=subscription)
    finally:
        sqs.delete_queue(QueueUrl=url)


def _policy(arn: str, topic: str) -> str:
    statement = {
        "Effect": "Allow",
        "Principal": {"Service": "sns.amazonaws.com"},
        "Action": "sqs:SendMessage",
        "Resource": arn,
        "Condition": {"ArnEquals": {"aws:SourceArn": topic}},
    }
    return json.dumps({"Version": "2012-10-17", "Statement": [statement]})


def _probed(sns: Any, topic: str, sqs: Any, url: str) -> Message | None:
    sns.publish(TopicArn=topic, Message=_PROBE)
    return _received(sqs, url, lambda message: message["Message"] == _PROBE)


def _received(sqs: Any, url: str, wanted: Callable[[Message], bool]) -> Message | None:
    answer = sqs.receive_message(QueueUrl=url, MaxNumberOfMessages=10, WaitTimeSeconds=5)
    bodies = [json.loads(message["Body"]) for message in answer.get("Messages", [])]
    return next(filter(wanted, bodies), None)


def lines(target: Target, function: str, since_ms: int) -> list[str]:
    """The messages in the log of a function since that time, in order."""
    configuration = target.cloud.client("lambda").get_function_configuration(FunctionName=function)
    pages = (
        target.cloud.client("logs")
        .get_paginator("filter_log_events")
        .paginate(logGroupName=configuration["LoggingConfig"]["LogGroup"], startTime=since_ms)
    )
    return [event["message"].strip() for page in pages for event in page["events"]]


# Times that the cloud never sends: of 1970, and of the year 2286.
LONG_AGO_MS, FAR_AHEAD_S = 7, 10**10


def spoofed(message: bytes, victim: str, lane: str, name: str, namespace: str = DEFAULT_NAMESPACE) -> bytes:
    """The message with every such key, first and last (a JSON reader may take either)."""
    keys = {
        TOPIC: build_topic(lane, victim, name, namespace),
        RECEIVED_MS: LONG_AGO_MS,
        EXPIRES_S: FAR_AHEAD_S,
        ROBOT: victim,
        MESSAGE_BASE64: base64.b64encode(b'{"v": 1}').decode(),
        AGENT_VERSION: "spoofed",
        "clientId": victim,
        "eventType": "disconnected",
        "unknown": "not stored",
    }
    members = json.dumps(keys)[1:-1]
    return f"{{{members}, {message.decode().strip()[1:-1]}, {members}}}".encode()


def registered(target: Target, base: str) -> Bundle:
    """The robot of that name, registered on first use."""
    name = target.name(base)
    folder = target.folder / "robots" / name
    return Bundle(name, folder) if folder.exists() else target.robot(base)


@contextmanager
def removed_after(target: Target, base: str) -> Iterator[tuple[str, Path]]:
    """The name of a robot that a question registers, and its folder; the robot is removed at the end."""
    name = target.name(base)
    try:
        yield name, target.folder / "claims" / name
    finally:
        # It may not be registered yet, or be removed already.
        with suppress(StationError):
            robots.remove(target.cloud, name)


def listener(target: Target, robot: str) -> Listener:
    """A subscriber of the robot's channel. Raises `CannotAskError` if PubNub's keys are not stored."""
    try:
        return target.listener(robot)
    except StationError as error:
        raise CannotAskError(str(error)) from error


class Pair(NamedTuple):
    """The robot that attacks, connected, and its neighbour."""

    target: Target
    robot: Robot
    victim: str

    def send(self, lane: str, name: str, message: bytes) -> None:
        """Publish the message with every key of the cloud in the neighbour's name."""
        namespace = self.target.cloud.namespace
        topic = build_topic(lane, self.robot.name, name, namespace)
        if lane == RECORD:
            topic = record_topic(self.robot.name, name, namespace)
        self.publish(topic, spoofed(message, self.victim, lane, name, namespace))

    def publish(self, topic: str, payload: bytes) -> None:
        """Publish; raises `InstrumentError` if the broker refuses."""
        answer = self.robot.publish(topic, payload)
        if answer != "SUCCESS":
            raise InstrumentError(f"the broker answered {answer} on {topic}")

    def asked(self, name: str, message: bytes) -> dict[str, Any]:
        """The answer on the robot's own lane pong."""
        self.robot.subscribe(build_topic(PONG, self.robot.name, name, self.target.cloud.namespace))
        self.send(PING, name, message)
        answer: dict[str, Any] = json.loads(self.robot.next_message()[1])
        return answer


@contextmanager
def pair_of(target: Target, base: str) -> Iterator[Pair]:
    """A robot of that name, connected, and the shared neighbour."""
    victim, bundle = registered(target, "verify-victim").robot, registered(target, base)
    with Robot(bundle.folder) as robot:
        yield Pair(target, robot.online(), victim)


RUN = "0badcafe"


def batch(number: int = 0, *, first_us: int = 0, **changes: Any) -> bytes:
    """A batch with one sample, of now or of ``first_us``; ``changes`` replace members of its envelope."""
    first_us = first_us or (int(time.time()) - 5) * 1_000_000
    made = Batch(RUN, number, [first_us + number * 1_000_000], {"speed": [1.5]})
    return json.dumps({**json.loads(encode_batch(made)), **changes}).encode()


def send(target: Target, bundle: Bundle, *messages: bytes) -> None:
    """Connect as the robot of a bundle, and publish on its record lane."""
    with Robot(bundle.folder) as robot:
        robot.online()
        for message in messages:
            robot.publish(record_topic(robot.name, VESC_STREAM, target.cloud.namespace), message)


def topic(target: Target, robot: str) -> str:
    """The partition of the robot's batches."""
    return build_topic(RECORD, robot, VESC_STREAM, target.cloud.namespace)


def items(target: Target, robot: str) -> list[dict[str, Any]]:
    """The robot's batches as stored in DynamoDB, types included."""
    answer = target.cloud.client("dynamodb").query(
        TableName=target.cloud.output("storage", "TelemetryTable"),
        KeyConditionExpression="topic = :topic",
        ExpressionAttributeValues={":topic": {"S": topic(target, robot)}},
    )
    return list(answer["Items"])


def stored(target: Target, robot: str, batches: int) -> None:
    """Wait until the table has so many of the robot's batches, and its row names their stream."""
    until(lambda: len(items(target, robot)) == batches, "the batches in the telemetry table")
    until(
        lambda: VESC_STREAM in (registry.find(target.cloud, robot) or {}).get(STREAMS, ()),
        "the batches' stream in the robot's row",
    )


def listed(target: Target, robot: str) -> list[DeadLetter]:
    """The robot's entries in the quarantine, without their messages."""
    return list(quarantine.entries(target.cloud, robot=robot))


def entries(target: Target, robot: str) -> list[DeadLetter]:
    """The robot's entries in the quarantine, with their messages."""
    return [entry for one in listed(target, robot) if (entry := quarantine.load(target.cloud, one))]


def only_entry(target: Target, robot: str, *, within_s: float = 90.0) -> DeadLetter:
    """Wait for the robot's entry in the quarantine; raises `InstrumentError` unless it is the only one."""
    found = until(lambda: entries(target, robot), "the entry in the quarantine", within_s=within_s)
    if len(found) != 1:
        raise InstrumentError(f"the quarantine must have one entry of {robot}, got {len(found)}")
    return found[0]


_CODE = re.compile(r"<Code>([^<]+)</Code>")


class Asking:
    """A robot that requests addresses and uploads bodies there."""

    def __init__(self, target: Target, robot: Robot) -> None:
        self._robot, self._namespace = robot, target.cloud.namespace
        self._trust = trust(target)
        robot.subscribe(build_topic(PONG, robot.name, FILE, self._namespace))

    def ask(self, file: File, parts: Mapping[int, bytes], parts_sha256: str | None = None) -> FileAnswer:
        """The answer to a request for these parts."""
        digests = {number: hashlib.sha256(body).hexdigest() for number, body in parts.items()}
        request = FileRequest(uuid.uuid4().hex, file, digests, parts_sha256)
        topic = build_topic(PING, self._robot.name, FILE, self._namespace)
        self._robot.publish(topic, encode_file_request(request))
        while (answer := decode_file_answer(self._robot.next_message()[1])).id != request.id:
            pass
        return answer

    def put(self, address: Address, body: bytes) -> tuple[int, str]:
        """The status, and the code of S3's error."""
        return sent(self._trust, "PUT", address.url, body, address.headers)


def trust(target: Target) -> ssl.SSLContext:
    """The system's authorities, and the embedded cloud's."""
    bundle = target.cloud.ca_bundle
    return trusting(Path(bundle) if bundle else None)


def sent(
    context: ssl.SSLContext,
    method: str,
    url: str,
    body: bytes = b"",
    headers: Mapping[str, str] | None = None,
) -> tuple[int, str]:
    """Send a body unchanged to an address; return the status, and the code of S3's error."""
    parts = urlsplit(url)
    with closing(http.client.HTTPSConnection(parts.netloc, context=context, timeout=60)) as connection:
        connection.request(method, f"{parts.path}?{parts.query}", body, dict(headers or {}))
        answer = connection.getresponse()
        found = _CODE.search(answer.read().decode(errors="replace"))
    return answer.status, found[1] if found else ""


@contextmanager
def asking(target: Target, base: str, file: File) -> Iterator[tuple[Asking, str]]:
    """A new robot and the key of its file; the file is deleted at the end."""
    bundle, bucket = target.robot(base), target.cloud.output("storage", "FilesBucket")
    key = file_key(bundle.robot, file)
    with Robot(bundle.folder) as robot:
        try:
            yield Asking(target, robot.online()), key
        finally:
            target.cloud.client("s3").delete_object(Bucket=bucket, Key=key)
