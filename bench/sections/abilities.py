"""Tables 6.1 to 6.3: what each service can do, every answer by doing it in this run.

The thesis gave its answers from documentation and use; here a probe exercises each ability on the deployed
stacks, and what it saw stands beside. *Used* says that the thesis' system rested on the ability.
"""

from __future__ import annotations

import json
import threading
import time
import uuid
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from typing import Any

from typing_extensions import Self

from bench import borrowed
from bench.raw_mqtt import RawClient
from bench.result import Ratio, Section, Table
from bench.target import Say, Target
from contract import (
    BROKER,
    CMD,
    FLEET,
    LAMBDA,
    LIVE,
    PING,
    PONG,
    RECEIVED_MS,
    RULE,
    SHADOW,
    VESC_STREAM,
    Batch,
    LiveSample,
    build_topic,
    encode,
    encode_live,
    encode_ping,
    record_topic,
)
from station import delivery, quarantine

_WAIT_S = 30.0
_CLIENTS, _WRITERS, _LISTENERS, _INSTANCES = 20, 8, 4, 4
FUNCTIONALITY, INTEROPERABILITY, SCALABILITY = (
    "Functionality (table 6.1)",
    "Interoperability and composability (table 6.2)",
    "Scalability (table 6.3)",
)


class No(Exception):  # noqa: N818 - an answer, not an error
    """The service does not have the ability; the text says what was seen."""


@dataclass(frozen=True)
class Probe:
    """One cell: ``ask`` exercises the ability and says what it saw, or raises."""

    table: str
    service: str
    ability: str
    thesis: str
    ask: Callable[[], str]


def run(target: Target, say: Say) -> Section:
    """Ask every probe."""
    section = Section("abilities", "Abilities (tables 6.1 to 6.3)")
    answers: dict[str, list[list[str]]] = {FUNCTIONALITY: [], INTEROPERABILITY: [], SCALABILITY: []}
    failed = 0
    with _Bench(target) as bench:
        for probe in bench.probes():
            say(f"{probe.service}: {probe.ability}")
            answer, seen = _answer(probe)
            failed += answer == "no"
            answers[probe.table].append([probe.ability, probe.service, answer, probe.thesis, seen])
    for title, rows in answers.items():
        section.tables.append(
            Table(title, ["ability", "service", "here", "thesis, 2018", "what the probe saw"], rows)
        )
    count = sum(map(len, answers.values()))
    section.ratios.append(Ratio("abilities that a probe did not find", failed, 0, f"of {count}"))
    section.raw = {"answers": answers}
    return section


def _answer(probe: Probe) -> tuple[str, str]:
    try:
        return "yes", probe.ask()
    except No as no:
        return "no", str(no)
    except Exception as error:  # noqa: BLE001 - whatever the service does instead is the answer
        return "no", f"{type(error).__name__}: {error}"[:160]


class _Bench:
    """What the probes share: two robots with raw connections, and a function that says who it is."""

    def __init__(self, target: Target) -> None:
        self._target, self._exit = target, ExitStack()
        self._cloud, self._namespace = target.cloud, target.cloud.namespace
        self._drives = self._seq = 0

    def __enter__(self) -> Self:
        self._bundles = [self._target.robot(f"bench-ability-{i}") for i in range(2)]
        self._a, self._b = (bundle.robot for bundle in self._bundles)
        self._function = self._exit.enter_context(
            borrowed.function(self._target, "who", _WHO, memory_mb=128, timeout_s=10)
        )
        return self

    def __exit__(self, *_: object) -> None:
        self._exit.close()

    def probes(self) -> list[Probe]:
        """Every cell of the three tables."""
        used, unsaid = "used", "-"
        iot, dynamodb, function, pubnub, watch = "IoT Core", "DynamoDB", "Lambda", "PubNub", "CloudWatch"
        return [
            Probe(
                FUNCTIONALITY, iot, "pushes a robot's message to another robot", used, self._robot_to_robot
            ),
            Probe(FUNCTIONALITY, iot, "transforms messages by rule", used, self._rule_adds),
            Probe(FUNCTIONALITY, iot, "keeps a robot's newest state", unsaid, self._shadow),
            Probe(FUNCTIONALITY, dynamodb, "stores and gives back the same", used, self._stores),
            Probe(FUNCTIONALITY, dynamodb, "reads a range of time", used, self._ranges),
            Probe(FUNCTIONALITY, dynamodb, "pushes what changed", used, self._stream),
            Probe(FUNCTIONALITY, function, "computes on a message", used, self._computes),
            Probe(FUNCTIONALITY, pubnub, "pushes to a dashboard", used, self._dashboard),
            Probe(FUNCTIONALITY, watch, "stores metrics and gives statistics", used, self._metrics),
            Probe(FUNCTIONALITY, watch, "stores what functions log", used, self._logs),
            Probe(FUNCTIONALITY, watch, "holds dashboards", used, self._dashboards),
            Probe(INTEROPERABILITY, iot, "speaks MQTT 3.1.1 with any client", used, self._mqtt3),
            Probe(INTEROPERABILITY, iot, "takes messages over HTTPS", unsaid, self._https_in),
            Probe(INTEROPERABILITY, iot, "rule into DynamoDB", used, self._rule_to_table),
            Probe(INTEROPERABILITY, iot, "rule into Lambda and back", used, self._rule_to_function),
            Probe(INTEROPERABILITY, iot, "rule republishes", used, self._rule_adds),
            Probe(INTEROPERABILITY, iot, "what a rule cannot store goes to a queue", unsaid, self._rejected),
            Probe(INTEROPERABILITY, dynamodb, "stream into Lambda into another table", used, self._stream),
            Probe(INTEROPERABILITY, function, "into PubNub", used, self._dashboard),
            Probe(SCALABILITY, iot, f"{_CLIENTS} connections at once", unsaid, self._connections),
            Probe(
                SCALABILITY, dynamodb, f"{_WRITERS} writers at once, nothing throttled", unsaid, self._writers
            ),
            Probe(SCALABILITY, dynamodb, "paid by request, no capacity to set", unsaid, self._on_demand),
            Probe(SCALABILITY, function, "in instances", unsaid, self._instances),
            Probe(SCALABILITY, function, "in size", unsaid, self._memory),
            Probe(SCALABILITY, pubnub, f"{_LISTENERS} subscribers hear the same", unsaid, self._subscribers),
        ]

    def _client(self, index: int) -> RawClient:
        return RawClient(self._bundles[index].folder)

    def _topic(self, lane: str, robot: str, name: str) -> str:
        return build_topic(lane, robot, name, self._namespace)

    def _robot_to_robot(self) -> str:
        topic, payload = self._topic(FLEET, self._a, "pose"), uuid.uuid4().hex.encode()
        with self._client(0) as one, self._client(1) as other:
            other.subscribe(topic)
            one.publish(topic, payload)
            _equal(other.receive(), (topic, payload))
        return "one robot's message came to another's subscription"

    def _rule_adds(self) -> str:
        answer = self._pong(RULE)
        if RECEIVED_MS not in answer:
            raise No(f"the answer has {sorted(answer)}")
        return f"the republished message has {RECEIVED_MS} {answer[RECEIVED_MS]}"

    def _rule_to_function(self) -> str:
        return f"a function answered ping {self._pong(LAMBDA)['id']}"

    def _pong(self, path: str) -> dict[str, Any]:
        with self._client(0) as client:
            client.subscribe(self._topic(PONG, self._a, path))
            number = time.time_ns() % 1_000_000
            client.publish(self._topic(PING, self._a, path), encode_ping(number, time.time_ns() // 1000))
            answer: dict[str, Any] = json.loads(client.receive()[1])
        _equal(answer["id"], number)
        return answer

    def _mqtt3(self) -> str:
        with self._client(0) as client:
            topic = self._topic(PING, self._a, BROKER)
            client.subscribe(topic)
            took_s = client.round_trip(topic, b"{}")
        return f"a client of a hundred lines had its message back in {took_s * 1000:.1f} ms"

    def _https_in(self) -> str:
        topic, payload = self._topic(CMD, self._a, "bench"), uuid.uuid4().hex.encode()
        with self._client(0) as client:
            client.subscribe(topic)
            self._cloud.client("iot-data").publish(topic=topic, qos=0, payload=payload)
            _equal(client.receive(), (topic, payload))
        return "a message put in over HTTPS came out over MQTT"

    def _shadow(self) -> str:
        client, value = self._cloud.client("iot-data"), uuid.uuid4().hex
        document = json.dumps({"state": {"desired": {"bench": value}}})
        client.update_thing_shadow(thingName=self._b, shadowName=SHADOW, payload=document)
        kept = json.loads(client.get_thing_shadow(thingName=self._b, shadowName=SHADOW)["payload"].read())
        _equal(kept["state"]["desired"]["bench"], value)
        return "the robot's shadow gave back what was written"

    def _stores(self) -> str:
        client, table = self._cloud.client("dynamodb"), self._cloud.output("storage", "RobotsTable")
        item = {
            "robot": {"S": self._target.name("bench-ability-item")},
            "value": {"S": uuid.uuid4().hex},
            "n": {"N": "1.5"},
        }
        key = {"robot": item["robot"]}
        client.put_item(TableName=table, Item=item)
        try:
            _equal(client.get_item(TableName=table, Key=key, ConsistentRead=True)["Item"], item)
        finally:
            client.delete_item(TableName=table, Key=key)
        return "an item came back as it was put"

    def _drive(self) -> list[Batch]:
        """Publish a drive of three seconds of the first robot's; its batches, once they are stored."""
        # Each drive in seconds of its own, which the one before has not filled.
        self._drives += 1
        first_s = int(time.time()) - 60 * self._drives
        boot = uuid.uuid4().hex[:8]
        batches = [
            Batch(boot, i, [(first_s + i) * 1_000_000 + k * 20_000 for k in range(50)], {"speed": [i] * 50})
            for i in range(3)
        ]
        with self._client(0) as client:
            for batch in batches:
                client.publish(record_topic(self._a, VESC_STREAM, self._namespace), encode(batch))
            client.ping()
            _until(lambda: sum(b.boot == boot for b in self._stored()) == 3, "the rule to store the batches")
        return batches

    def _stored(self) -> list[Batch]:
        return list(delivery.batches(self._cloud, self._a, VESC_STREAM))

    def _rule_to_table(self) -> str:
        sent = self._drive()
        stored = [b for b in self._stored() if b.boot == sent[0].boot]
        _equal([list(b.times_us) for b in stored], [list(b.times_us) for b in sent])
        return f"{len(stored)} published batches are items, equal to the sample"

    def _ranges(self) -> str:
        sent = self._drive()
        answer = self._cloud.client("dynamodb").query(
            TableName=self._cloud.output("storage", "TelemetryTable"),
            KeyConditionExpression="topic = :topic AND t BETWEEN :a AND :b",
            ExpressionAttributeValues={
                ":topic": {"S": build_topic("dt", self._a, VESC_STREAM, self._namespace)},
                ":a": {"N": str(sent[1].t_us)},
                ":b": {"N": str(sent[2].t_us - 1)},
            },
        )
        _equal([int(item["t"]["N"]) for item in answer["Items"]], [sent[1].t_us])
        return "of three batches, a range gave the one in it"

    def _stream(self) -> str:
        before = delivery.samples_summarized(self._cloud, self._a, VESC_STREAM)
        self._drive()
        _until(
            lambda: delivery.samples_summarized(self._cloud, self._a, VESC_STREAM) >= before + 150,
            "the stream's function to write the other table",
        )
        return "what was stored in one table came summarised to the other"

    def _computes(self) -> str:
        function = self._cloud.output("processing", "SummarizeFunction")
        answer = self._cloud.client("lambda").invoke(FunctionName=function, Payload=b'{"Records": []}')
        _equal(json.loads(answer["Payload"].read()), {"batchItemFailures": []})
        return "Lambda 2 answered an event"

    def _live_until(self, client: RawClient, true: Callable[[], bool], what: str) -> None:
        """Publish live samples as a car does: the first ones may be stale before a cold function starts."""

        def heard() -> bool:
            self._seq += 1
            now_us = time.time_ns() // 1000
            live = encode_live(LiveSample("0badcafe", self._seq, now_us, now_us, {"speed": 1}))
            client.publish(self._topic(LIVE, self._a, VESC_STREAM), live)
            return true()

        _until(heard, what)

    def _dashboard(self) -> str:
        with self._target.listener(self._a) as listener, self._client(0) as client:
            self._live_until(client, lambda: bool(listener.heard), "the subscriber to hear a sample")
            return f"a live sample came to a subscriber after {listener.heard[0].delay_ms:.0f} ms"

    def _subscribers(self) -> str:
        with ExitStack() as stack:
            listeners = [stack.enter_context(self._target.listener(self._a)) for _ in range(_LISTENERS)]
            self._live_until(
                stack.enter_context(self._client(0)),
                lambda: all(listener.heard for listener in listeners),
                "all subscribers to hear a sample",
            )
        return f"all {_LISTENERS} heard one message"

    def _metrics(self) -> str:
        client, now = self._cloud.client("cloudwatch"), datetime.now(timezone.utc)
        name = f"Bench{uuid.uuid4().hex[:8]}"
        values = {"Values": [1.0, 2.0, 6.0], "Counts": [1.0, 1.0, 1.0]}
        client.put_metric_data(
            Namespace="iort-bench", MetricData=[{"MetricName": name, "Timestamp": now, **values}]
        )
        found: list[dict[str, Any]] = []

        def there() -> bool:
            found[:] = client.get_metric_statistics(
                Namespace="iort-bench",
                MetricName=name,
                StartTime=now - timedelta(minutes=5),
                EndTime=now + timedelta(minutes=5),
                Period=60,
                Statistics=["Average", "SampleCount"],
            )["Datapoints"]
            return bool(found)

        _until(there, "the metric's statistics", 180 if self._target.embedded is None else _WAIT_S)
        _equal(round(found[0]["Average"], 6), 3.0)
        return "the mean of 1, 2 and 6 came back as 3"

    def _logs(self) -> str:
        function = self._cloud.output("processing", "EchoFunction")
        client = self._cloud.client("lambda")
        group = client.get_function_configuration(FunctionName=function)["LoggingConfig"]["LogGroup"]
        since = int(time.time() * 1000) - 1000
        self._pong(LAMBDA)
        logs = self._cloud.client("logs")
        _until(
            lambda: bool(logs.filter_log_events(logGroupName=group, startTime=since)["events"]),
            "the log's lines",
        )
        return "an invocation's lines are in its log"

    def _dashboards(self) -> str:
        client = self._cloud.client("cloudwatch")
        names = [entry["DashboardName"] for entry in client.list_dashboards()["DashboardEntries"]]
        if not names:
            raise No("there is no dashboard")
        widgets = sum(
            len(json.loads(client.get_dashboard(DashboardName=name)["DashboardBody"])["widgets"])
            for name in names
        )
        return f"{len(names)} dashboards of {widgets} widgets"

    def _rejected(self) -> str:
        mark = uuid.uuid4().hex
        message = json.dumps({"bench": mark}).encode()
        with self._client(0) as client:
            client.publish(record_topic(self._a, VESC_STREAM, self._namespace), message)
            client.ping()

        def there() -> bool:
            listed = quarantine.entries(self._cloud, robot=self._a)
            kept = (quarantine.load(self._cloud, entry) for entry in listed)
            return any(entry is not None and entry.payload == message for entry in kept)

        _until(there, "the message in quarantine")
        return "a message that is no batch is in quarantine, with its own bytes"

    def _connections(self) -> str:
        bundles = [self._target.robot(f"bench-many-{i}") for i in range(_CLIENTS)]
        with ExitStack() as stack, ThreadPoolExecutor(_CLIENTS) as pool:
            clients = list(pool.map(lambda b: stack.enter_context(RawClient(b.folder)), bundles))
            slowest = max(pool.map(lambda client: client.ping(), clients))
        return f"{_CLIENTS} sessions stood together and each answered, the slowest in {slowest * 1000:.0f} ms"

    def _writers(self) -> str:
        client, table = self._cloud.client("dynamodb"), self._cloud.output("storage", "RobotsTable")

        def write(i: int) -> int:
            key = {"robot": {"S": self._target.name(f"bench-writer-{i}")}}
            for n in range(25):
                client.put_item(TableName=table, Item={**key, "n": {"N": str(n)}})
            client.delete_item(TableName=table, Key=key)
            return 25

        with ThreadPoolExecutor(_WRITERS) as pool:
            written = sum(pool.map(write, range(_WRITERS)))
        return f"{written} writes by {_WRITERS} threads, none refused"

    def _on_demand(self) -> str:
        table = self._cloud.output("storage", "TelemetryTable")
        described = self._cloud.client("dynamodb").describe_table(TableName=table)["Table"]
        mode = described.get("BillingModeSummary", {}).get("BillingMode")
        if mode != "PAY_PER_REQUEST":
            raise No(f"the billing mode is {mode}")
        return f"the table says {mode}"

    def _instances(self) -> str:
        with ThreadPoolExecutor(_INSTANCES) as pool:
            answers = list(pool.map(lambda _: self._who(0.5), range(_INSTANCES)))
        instances = {answer["instance"] for answer in answers}
        if len(instances) < 2:
            raise No(f"{_INSTANCES} invocations at once ran in one instance")
        return f"{_INSTANCES} invocations at once ran in {len(instances)} instances"

    def _memory(self) -> str:
        client = self._cloud.client("lambda")
        before = self._who(0)["memory_mb"]
        client.update_function_configuration(FunctionName=self._function, MemorySize=512)
        client.get_waiter("function_updated_v2").wait(FunctionName=self._function)
        after = self._who(0)["memory_mb"]
        _equal((before, after), ("128", "512"))
        return f"the function saw {before} MB, and {after} MB after a change"

    def _who(self, seconds: float) -> dict[str, Any]:
        payload = json.dumps({"seconds": seconds}).encode()
        answer = self._cloud.client("lambda").invoke(FunctionName=self._function, Payload=payload)
        found: dict[str, Any] = json.loads(answer["Payload"].read())
        return found


_WHO = """
import os, time, uuid
INSTANCE = uuid.uuid4().hex
def handler(event, context):
    time.sleep(event["seconds"])
    return {"instance": INSTANCE, "memory_mb": os.environ.get("AWS_LAMBDA_FUNCTION_MEMORY_SIZE")}
"""


def _equal(found: Any, expected: Any) -> None:
    if found != expected:
        raise No(f"{found!r:.80} is not {expected!r:.80}")


def _until(true: Callable[[], bool], what: str, seconds: float = _WAIT_S) -> None:
    deadline = time.monotonic() + seconds
    while not true():
        if time.monotonic() > deadline:
            raise No(f"waited {seconds:.0f} s for {what}")
        threading.Event().wait(0.1)
