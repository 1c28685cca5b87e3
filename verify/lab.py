"""What the questions share: a deployment with robots, batches, files, functions and mails."""

from __future__ import annotations

import base64
import hashlib
import http.client
import json
import re
import time
import uuid
from collections.abc import Callable, Mapping
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from typing_extensions import Self

from iort_agent.files.upload import trusting
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.limits import DEFAULT_NAMESPACE
from iort_contract.messages.batch import Batch, batch_id, encode_batch
from iort_contract.messages.files import (
    Address,
    File,
    FileAnswer,
    FileRequest,
    decode_file_answer,
    encode_file_request,
    file_key,
)
from iort_contract.tables import (
    AGENT_VERSION,
    BATCH,
    EXPIRES_S,
    MESSAGE_BASE64,
    RECEIVED_MS,
    ROBOT,
    STREAMS,
    TOPIC,
)
from iort_contract.topics import FILE, PING, PONG, RECORD, build_topic, record_topic
from iort_station.errors import StationError
from iort_station.fleet import registry, robots
from iort_station.fleet.robots import Bundle
from iort_station.operations import quarantine
from iort_station.operations.quarantine import DeadLetter
from iort_station.page.pubnub import Listener
from testkit.mqtt import Robot
from testkit.target import Target, temporary_function
from testkit.waiting import InstrumentError, until

Message = dict[str, Any]
# Returns the first message that matches. Raises `InstrumentError` if none arrives in time.
Receive = Callable[[Callable[[Message], bool], str], Message]
RUN = "0badcafe"
_PROBE = "verify: does this arrive?"
_CODE = re.compile(r"<Code>([^<]+)</Code>")
# Times that the cloud never sends: of 1970, and of the year 2286.
LONG_AGO_MS, FAR_AHEAD_S = 7, 10**10


class CannotAskError(InstrumentError):
    """A question cannot be asked here; the text says why."""


def batch(number: int = 0, *, first_us: int = 0, **changes: Any) -> bytes:
    """A batch with one sample, of now or of ``first_us``; ``changes`` replace members of its envelope."""
    first_us = first_us or (int(time.time()) - 5) * 1_000_000
    encoded = encode_batch(Batch(RUN, number, [first_us + number * 1_000_000], {"speed": [1.5]}))
    return json.dumps({**json.loads(encoded), **changes}).encode()


def batch_number(entry: DeadLetter) -> int:
    """The number of the batch that a dead letter of the stream holds."""
    return batch_id(json.loads(entry.payload or b"{}")[BATCH]["S"]).seq


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


def said_by(error: Exception) -> str:
    """AWS' name of an error."""
    return str(getattr(error, "response", {}).get("Error", {}).get("Code", ""))


class Removed(NamedTuple):
    """The name of a robot that a question registers, and the folder of its bundle."""

    name: str
    folder: Path


class Lab:
    """A deployment as a question uses it. What its methods make is undone when the question ends, the last
    one first; `enter` and `undo` add what else has an end."""

    def __init__(self, target: Target) -> None:
        self.target, self.cloud, self.namespace = target, target.cloud, target.cloud.namespace
        # A client of a service, the name of a question's resource in this run, and a new robot of that name.
        self.client: Callable[[str], Any] = target.cloud.client
        self.name, self.robot = target.name, target.robot
        self._exit = ExitStack()
        self.enter, self.undo = self._exit.enter_context, self._exit.callback

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._exit.close()

    # Robots.

    def registered(self, base: str = "verify-victim") -> Bundle:
        """The robot of that name, registered on first use; several questions share it."""
        name = self.name(base)
        folder = self.target.folder / "robots" / name
        return Bundle(name, folder) if folder.exists() else self.robot(base)

    def removed_after(self, base: str) -> Removed:
        """The name of a robot that the question registers itself."""
        name = self.name(base)

        def remove() -> None:
            # It may not be registered yet, or be removed already.
            with suppress(StationError):
                robots.remove(self.cloud, name)

        self.undo(remove)
        return Removed(name, self.target.folder / "claims" / name)

    def connected(self, folder: Path, *, paced: bool = True) -> Robot:
        """The connected robot of a bundle's folder."""
        robot: Robot = self.enter(Robot(folder, paced=paced))
        return robot.online()

    def listener(self, robot: str) -> Listener:
        """A subscriber of the robot's channel. Raises `CannotAskError` if PubNub's keys are not stored."""
        try:
            return self.enter(self.target.listener(robot))
        except StationError as error:
            raise CannotAskError(str(error)) from error

    def pair(self, base: str) -> Pair:
        """A robot of that name, connected, and the shared neighbour."""
        return Pair(self, self.connected(self.registered(base).folder), self.registered().robot)

    def topic(self, lane: str, robot: str, name: str = VESC_STREAM) -> str:
        """A topic of the robot."""
        return build_topic(lane, robot, name, self.namespace)

    # Batches.

    def send(self, bundle: Bundle, *messages: bytes) -> None:
        """Connect as the robot of a bundle, and publish on its record lane."""
        with Robot(bundle.folder) as robot:
            robot.online()
            for message in messages:
                robot.publish(record_topic(robot.name, VESC_STREAM, self.namespace), message)

    def driven(self, base: str, first_us: int, count: int) -> Bundle:
        """A new robot with stored batches of one sample a second."""
        bundle = self.robot(base)
        self.send(bundle, *(batch(number, first_us=first_us) for number in range(count)))
        self.stored(bundle.robot, count)
        return bundle

    def items(self, robot: str) -> list[dict[str, Any]]:
        """The robot's batches as stored in DynamoDB, types included."""
        answer = self.client("dynamodb").query(
            TableName=self.cloud.output("storage", "TelemetryTable"),
            KeyConditionExpression="topic = :topic",
            ExpressionAttributeValues={":topic": {"S": self.topic(RECORD, robot)}},
        )
        return list(answer["Items"])

    def stored(self, robot: str, batches: int) -> None:
        """Wait until the table has so many of the robot's batches, and its row names their stream."""
        until(lambda: len(self.items(robot)) == batches, "the batches in the telemetry table")
        until(
            lambda: VESC_STREAM in (registry.find(self.cloud, robot) or {}).get(STREAMS, ()),
            "the batches' stream in the robot's row",
        )

    def entries(self, robot: str) -> list[DeadLetter]:
        """The robot's entries in the quarantine, with their messages."""
        listed = quarantine.entries(self.cloud, robot=robot)
        return [whole for entry in listed if (whole := quarantine.load(self.cloud, entry))]

    def only_entry(self, robot: str, *, within_s: float = 90.0) -> DeadLetter:
        """Wait for the robot's entry in the quarantine. Raises `InstrumentError` if there are several."""
        entries = until(lambda: self.entries(robot), "the entry in the quarantine", within_s=within_s)
        if len(entries) != 1:
            raise InstrumentError(f"the quarantine must have one entry of {robot}, got {len(entries)}")
        return entries[0]

    # Functions.

    def function(self, name: str, source: str, **settings: Any) -> str:
        """The name of a function with this source: see `temporary_function`."""
        return self.enter(temporary_function(self.target, name, source, **settings))

    def invoke(self, function: str, payload: Any = None) -> Any:
        """A function's answer. Raises `InstrumentError` if it failed."""
        answer = self.client("lambda").invoke(FunctionName=function, Payload=json.dumps(payload or {}))
        returned = json.loads(answer["Payload"].read())
        if "FunctionError" in answer:
            raise InstrumentError(f"{function} failed: {returned}")
        return returned

    def configuration(self, function: str) -> Mapping[str, Any]:
        """A function's configuration."""
        return dict(self.client("lambda").get_function_configuration(FunctionName=function))

    def events(self, group: str, since_ms: int) -> list[Mapping[str, Any]]:
        """The events of a log group since that time, in order."""
        pages = self.client("logs").get_paginator("filter_log_events")
        return [
            event
            for page in pages.paginate(logGroupName=group, startTime=since_ms)
            for event in page["events"]
        ]

    def lines(self, function: str, since_ms: int) -> list[str]:
        """The messages in the log of a function since that time, in order."""
        group = self.configuration(function)["LoggingConfig"]["LogGroup"]
        return [event["message"].strip() for event in self.events(group, since_ms)]

    # Files, and mails.

    def uploader(self, base: str, file: File) -> Uploader:
        """A new robot that uploads the file, which is deleted at the end."""
        bundle, bucket = self.robot(base), self.cloud.output("storage", "FilesBucket")
        key = file_key(bundle.robot, file)
        self.undo(self.client("s3").delete_object, Bucket=bucket, Key=key)
        return Uploader(self, self.connected(bundle.folder), key)

    def sent(
        self, method: str, url: str, body: bytes = b"", headers: Mapping[str, str] | None = None
    ) -> tuple[int, str]:
        """Send a body unchanged to an address; return the status, and the code of S3's error."""
        parts, bundle = urlsplit(url), self.cloud.ca_bundle
        # The system's authorities, and the embedded cloud's.
        context = trusting(Path(bundle) if bundle else None)
        with closing(http.client.HTTPSConnection(parts.netloc, context=context, timeout=60)) as connection:
            connection.request(method, f"{parts.path}?{parts.query}", body, dict(headers or {}))
            answer = connection.getresponse()
            code = _CODE.search(answer.read().decode(errors="replace"))
        return answer.status, code[1] if code else ""

    def inbox(self, topic: str) -> Receive:
        """A queue subscribed to the topic."""
        sqs, sns = self.client("sqs"), self.client("sns")
        # SQS refuses a name for 60 s after its queue was deleted.
        name = f"{self.namespace}-verify-{uuid.uuid4().hex[:8]}"
        url = sqs.create_queue(QueueName=name)["QueueUrl"]
        self.undo(sqs.delete_queue, QueueUrl=url)
        arn = sqs.get_queue_attributes(QueueUrl=url, AttributeNames=["QueueArn"])["Attributes"]["QueueArn"]
        statement = {
            "Effect": "Allow",
            "Principal": {"Service": "sns.amazonaws.com"},
            "Action": "sqs:SendMessage",
            "Resource": arn,
            "Condition": {"ArnEquals": {"aws:SourceArn": topic}},
        }
        policy = json.dumps({"Version": "2012-10-17", "Statement": [statement]})
        sqs.set_queue_attributes(QueueUrl=url, Attributes={"Policy": policy})
        subscription = sns.subscribe(TopicArn=topic, Protocol="sqs", Endpoint=arn)["SubscriptionArn"]
        self.undo(sns.unsubscribe, SubscriptionArn=subscription)

        def received(wanted: Callable[[Message], bool]) -> Message | None:
            answer = sqs.receive_message(QueueUrl=url, MaxNumberOfMessages=10, WaitTimeSeconds=5)
            bodies = [json.loads(message["Body"]) for message in answer.get("Messages", [])]
            return next(filter(wanted, bodies), None)

        def probed() -> Message | None:
            sns.publish(TopicArn=topic, Message=_PROBE)
            return received(lambda message: message["Message"] == _PROBE)

        # A queue's policy may take 60 s to become effective, and earlier messages are lost.
        until(probed, "a message of the topic at its new subscriber")
        return lambda wanted, what: until(lambda: received(wanted), what)


class Pair(NamedTuple):
    """The robot that attacks, connected, and its neighbour."""

    lab: Lab
    robot: Robot
    victim: str

    def topic(self, lane: str, name: str = VESC_STREAM) -> str:
        """A topic of the robot's own."""
        return self.lab.topic(lane, self.robot.name, name)

    def publish(self, topic: str, payload: bytes) -> None:
        """Publish; raises `InstrumentError` if the broker refuses."""
        answer = self.robot.publish(topic, payload)
        if answer != "SUCCESS":
            raise InstrumentError(f"the broker answered {answer} on {topic}")

    def send(self, lane: str, message: bytes, name: str = VESC_STREAM) -> None:
        """Publish the message with every key of the cloud in the neighbour's name."""
        namespace = self.lab.namespace
        topic = record_topic(self.robot.name, name, namespace) if lane == RECORD else self.topic(lane, name)
        self.publish(topic, spoofed(message, self.victim, lane, name, namespace))

    def answer(self, name: str, message: bytes, lane: str = PING, answers: str = PONG) -> dict[str, Any]:
        """The answer to the message on the robot's own topic for answers."""
        self.robot.subscribe(self.topic(answers, name))
        self.send(lane, message, name)
        answer: dict[str, Any] = json.loads(self.robot.next_message()[1])
        return answer


class Uploader(NamedTuple):
    """A robot that requests addresses for the file with that key, and uploads bodies there."""

    lab: Lab
    robot: Robot
    key: str

    def ask(self, file: File, parts: Mapping[int, bytes], parts_sha256: str | None = None) -> FileAnswer:
        """The answer to a request for these parts."""
        digests = {number: hashlib.sha256(body).hexdigest() for number, body in parts.items()}
        request = FileRequest(uuid.uuid4().hex, file, digests, parts_sha256)
        ping, pong = (self.lab.topic(lane, self.robot.name, FILE) for lane in (PING, PONG))
        self.robot.subscribe(pong)
        self.robot.publish(ping, encode_file_request(request))
        while (answer := decode_file_answer(self.robot.next_message()[1])).id != request.id:
            pass
        return answer

    def put(self, address: Address, body: bytes) -> tuple[int, str]:
        """The status, and the code of S3's error."""
        return self.lab.sent("PUT", address.url, body, address.headers)

    def head(self) -> Mapping[str, Any]:
        """What S3 has stored under the key."""
        bucket = self.lab.cloud.output("storage", "FilesBucket")
        return dict(self.lab.client("s3").head_object(Bucket=bucket, Key=self.key))
