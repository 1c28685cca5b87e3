"""The fixture of the probes: two robots with raw connections, and a function that identifies itself."""

from __future__ import annotations

import json
import time
import uuid
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from datetime import datetime, timedelta, timezone
from typing import Any

from typing_extensions import Self

from bench.floors.raw_mqtt import RawClient
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.messages.batch import Batch, batches_between, encode_batch
from iort_contract.messages.live import LiveSample, encode_live, encode_ping
from iort_contract.tables import BATCH, RECEIVED_MS
from iort_contract.topics import (
    BROKER,
    CMD,
    FLEET,
    LAMBDA,
    LIVE,
    PING,
    PONG,
    RECORD,
    RULE,
    SHADOW,
    build_topic,
    record_topic,
)
from iort_station.operations import audit, quarantine
from testkit.target import Target, temporary_function
from testkit.waiting import InstrumentError, reached

WAIT_S = 30.0
_WHO = """
import os, time, uuid
INSTANCE = uuid.uuid4().hex
def handler(event, context):
    time.sleep(event["seconds"])
    return {"instance": INSTANCE, "memory_mb": os.environ.get("AWS_LAMBDA_FUNCTION_MEMORY_SIZE")}
"""


class AbilityMissingError(InstrumentError):
    """The service lacks the ability; the text says what the probe saw."""


def equal(found: Any, expected: Any) -> None:
    """Raise `AbilityMissingError` unless ``found`` equals ``expected``."""
    if found != expected:
        raise AbilityMissingError(f"must be {expected!r:.80}, got {found!r:.80}")


def until(true: Callable[[], object], what: str, seconds: float = WAIT_S) -> None:
    """Wait until ``true`` says so. Raises `AbilityMissingError` after ``seconds``."""
    if not reached(true, within_s=seconds):
        raise AbilityMissingError(f"waited {seconds:.0f} s for {what}")


class ProbeFixture:
    """Two robots, ``a`` and ``b``, and a function that exist from `__enter__` to `__exit__`."""

    def __init__(self, target: Target) -> None:
        self.target, self._exit = target, ExitStack()
        self.cloud, self.namespace, self.client = target.cloud, target.cloud.namespace, target.cloud.client
        self._drives = self._seq = 0

    def __enter__(self) -> Self:
        self._bundles = [self.target.robot(f"bench-ability-{i}") for i in range(2)]
        self.a, self.b = (bundle.robot for bundle in self._bundles)
        function = temporary_function(self.target, "who", _WHO, memory_mb=128, timeout_s=10)
        self.function = self._exit.enter_context(function)
        return self

    def __exit__(self, *_: object) -> None:
        self._exit.close()

    def connection(self, index: int = 0) -> RawClient:
        """Return a connection of the first robot (0) or the second (1)."""
        return RawClient(self._bundles[index].folder)

    def table(self, name: str) -> str:
        """The name of a table."""
        return self.cloud.output("storage", f"{name}Table")

    def topic(self, lane: str, name: str) -> str:
        """A topic of the first robot."""
        return build_topic(lane, self.a, name, self.namespace)

    def pong(self, path: str) -> dict[str, Any]:
        """Return the answer of the path to a ping of the first robot."""
        with self.connection() as connection:
            connection.subscribe(self.topic(PONG, path))
            number = time.time_ns() % 1_000_000
            connection.publish(self.topic(PING, path), encode_ping(number, time.time_ns() // 1000))
            answer: dict[str, Any] = json.loads(connection.receive()[1])
        equal(answer["id"], number)
        return answer

    def drive(self) -> list[Batch]:
        """Publish a drive of three seconds as the first robot; return its batches after they are stored."""
        # Each drive has its own seconds, which the one before has not filled.
        self._drives += 1
        first_s = int(time.time()) - 60 * self._drives
        boot = uuid.uuid4().hex[:8]
        batches = [
            Batch(boot, i, [(first_s + i) * 1_000_000 + k * 20_000 for k in range(50)], {"speed": [i] * 50})
            for i in range(3)
        ]
        with self.connection() as connection:
            for batch in batches:
                connection.publish(record_topic(self.a, VESC_STREAM, self.namespace), encode_batch(batch))
            connection.ping()
            until(lambda: sum(b.boot == boot for b in self.stored()) == 3, "the rule to store the batches")
        return batches

    def stored(self) -> list[Batch]:
        """Return the first robot's batches in the telemetry table."""
        return list(audit.batches(self.cloud, self.a, VESC_STREAM))

    def summarized(self) -> int:
        """The first robot's samples in the summary table."""
        return audit.samples_summarized(self.cloud, self.a, VESC_STREAM)

    def live_until(self, connection: RawClient, true: Callable[[], object], what: str) -> None:
        """Publish live samples until ``true``; the first may be stale before a cold function starts."""

        def heard() -> object:
            self._seq += 1
            now_us = time.time_ns() // 1000
            live = encode_live(LiveSample("0badcafe", self._seq, now_us, now_us, {"speed": 1}))
            connection.publish(self.topic(LIVE, VESC_STREAM), live)
            return true()

        until(heard, what)

    def invoke(self, function: str, event: object) -> dict[str, Any]:
        """A function's answer."""
        answer = self.client("lambda").invoke(FunctionName=function, Payload=json.dumps(event).encode())
        return dict(json.loads(answer["Payload"].read()))

    def who(self, seconds: float) -> dict[str, Any]:
        """Return ``instance`` and ``memory_mb`` from the function, which takes ``seconds`` to answer."""
        return self.invoke(self.function, {"seconds": seconds})


WRITERS = 8


def stores(fixture: ProbeFixture) -> str:
    """An item comes back as it was put."""
    client, table = fixture.client("dynamodb"), fixture.table("Robots")
    key = {"robot": {"S": fixture.target.name("bench-ability-item")}}
    item = {**key, "value": {"S": uuid.uuid4().hex}, "n": {"N": "1.5"}}
    client.put_item(TableName=table, Item=item)
    try:
        equal(client.get_item(TableName=table, Key=key, ConsistentRead=True)["Item"], item)
    finally:
        client.delete_item(TableName=table, Key=key)
    return "an item came back as it was put"


def range_of_time(fixture: ProbeFixture) -> str:
    """A range query returns the batches that begin in the range."""
    sent = fixture.drive()
    first, last = batches_between(sent[1].t_us, sent[2].t_us - 1)
    answer = fixture.client("dynamodb").query(
        TableName=fixture.table("Telemetry"),
        KeyConditionExpression="topic = :topic AND #batch BETWEEN :a AND :b",
        # A reserved word of DynamoDB.
        ExpressionAttributeNames={"#batch": BATCH},
        ExpressionAttributeValues={
            ":topic": {"S": fixture.topic(RECORD, VESC_STREAM)},
            ":a": {"S": first},
            ":b": {"S": last},
        },
    )
    equal([item[BATCH]["S"] for item in answer["Items"]], [str(sent[1].id)])
    return "of three batches, a range gave the one in it"


def stream_of_changes(fixture: ProbeFixture) -> str:
    """The function behind the stream summarises the stored batches."""
    before = fixture.summarized()
    fixture.drive()
    until(lambda: fixture.summarized() >= before + 150, "the stream's function to write the other table")
    return "batches of one table arrived summarised in the other"


def many_writers(fixture: ProbeFixture) -> str:
    """Threads write as fast as they can; a throttled write raises."""
    client, table = fixture.client("dynamodb"), fixture.table("Robots")

    def write(i: int) -> int:
        key = {"robot": {"S": fixture.target.name(f"bench-writer-{i}")}}
        for n in range(25):
            client.put_item(TableName=table, Item={**key, "n": {"N": str(n)}})
        client.delete_item(TableName=table, Key=key)
        return 25

    with ThreadPoolExecutor(WRITERS) as pool:
        written = sum(pool.map(write, range(WRITERS)))
    return f"{written} writes by {WRITERS} threads, none refused"


def on_demand(fixture: ProbeFixture) -> str:
    """The table describes itself as on demand."""
    described = fixture.client("dynamodb").describe_table(TableName=fixture.table("Telemetry"))["Table"]
    mode = described.get("BillingModeSummary", {}).get("BillingMode")
    if mode != "PAY_PER_REQUEST":
        raise AbilityMissingError(f"the billing mode is {mode}")
    return f"the table says {mode}"


INSTANCES = 4


def computes(fixture: ProbeFixture) -> str:
    """Lambda 2 answers an empty event."""
    summarize = fixture.cloud.output("processing", "SummarizeFunction")
    equal(fixture.invoke(summarize, {"Records": []}), {"batchItemFailures": []})
    return "Lambda 2 answered an event"


def many_instances(fixture: ProbeFixture) -> str:
    """Simultaneous invocations run in several instances."""
    with ThreadPoolExecutor(INSTANCES) as pool:
        answers = list(pool.map(lambda _: fixture.who(0.5), range(INSTANCES)))
    instances = {answer["instance"] for answer in answers}
    if len(instances) < 2:
        raise AbilityMissingError(f"{INSTANCES} invocations at once ran in one instance")
    return f"{INSTANCES} invocations at once ran in {len(instances)} instances"


def memory_size(fixture: ProbeFixture) -> str:
    """The function sees its memory size change."""
    client = fixture.client("lambda")
    before = fixture.who(0)["memory_mb"]
    client.update_function_configuration(FunctionName=fixture.function, MemorySize=512)
    client.get_waiter("function_updated_v2").wait(FunctionName=fixture.function)
    after = fixture.who(0)["memory_mb"]
    equal((before, after), ("128", "512"))
    return f"the function saw {before} MB, and {after} MB after a change"


CLIENTS = 20


def robot_to_robot(fixture: ProbeFixture) -> str:
    """A message of one robot reaches another robot's subscription."""
    topic, payload = fixture.topic(FLEET, "pose"), uuid.uuid4().hex.encode()
    with fixture.connection() as one, fixture.connection(1) as other:
        other.subscribe(topic)
        one.publish(topic, payload)
        equal(other.receive(), (topic, payload))
    return "one robot's message came to another's subscription"


def rule_republishes(fixture: ProbeFixture) -> str:
    """A ping comes back with the cloud's time."""
    answer = fixture.pong(RULE)
    if RECEIVED_MS not in answer:
        raise AbilityMissingError(f"the answer has {sorted(answer)}")
    return f"the republished message has {RECEIVED_MS} {answer[RECEIVED_MS]}"


def newest_state(fixture: ProbeFixture) -> str:
    """The shadow returns the state that was written to it."""
    client, value = fixture.client("iot-data"), uuid.uuid4().hex
    document = json.dumps({"state": {"desired": {"bench": value}}})
    client.update_thing_shadow(thingName=fixture.b, shadowName=SHADOW, payload=document)
    kept = json.loads(client.get_thing_shadow(thingName=fixture.b, shadowName=SHADOW)["payload"].read())
    equal(kept["state"]["desired"]["bench"], value)
    return "the robot's shadow gave back what was written"


def any_mqtt_client(fixture: ProbeFixture) -> str:
    """A client of another MQTT version than the agent's gets its message back."""
    with fixture.connection() as connection:
        topic = fixture.topic(PING, BROKER)
        connection.subscribe(topic)
        took_s = connection.round_trip(topic, b"{}")
    return f"a client of a hundred lines had its message back in {took_s * 1000:.1f} ms"


def messages_over_https(fixture: ProbeFixture) -> str:
    """A message that was sent over HTTPS arrives over MQTT."""
    topic, payload = fixture.topic(CMD, "bench"), uuid.uuid4().hex.encode()
    with fixture.connection() as connection:
        connection.subscribe(topic)
        fixture.client("iot-data").publish(topic=topic, qos=0, payload=payload)
        equal(connection.receive(), (topic, payload))
    return "a message put in over HTTPS came out over MQTT"


def rule_to_table(fixture: ProbeFixture) -> str:
    """The batches of a drive become items of the table."""
    sent = fixture.drive()
    stored = [b for b in fixture.stored() if b.boot == sent[0].boot]
    equal([list(b.times_us) for b in stored], [list(b.times_us) for b in sent])
    return f"{len(stored)} published batches are items, equal to the sample"


def rule_to_function(fixture: ProbeFixture) -> str:
    """A function answers a ping."""
    return f"a function answered ping {fixture.pong(LAMBDA)['id']}"


def what_fails_is_kept(fixture: ProbeFixture) -> str:
    """A message that is no batch reaches the quarantine unchanged."""
    message = json.dumps({"bench": uuid.uuid4().hex}).encode()
    with fixture.connection() as connection:
        connection.publish(record_topic(fixture.a, VESC_STREAM, fixture.namespace), message)
        connection.ping()

    def there() -> bool:
        listed = quarantine.entries(fixture.cloud, robot=fixture.a)
        kept = (quarantine.load(fixture.cloud, entry) for entry in listed)
        return any(entry is not None and entry.payload == message for entry in kept)

    until(there, "the message in quarantine")
    return "a message that is no batch is in quarantine, with its own bytes"


def many_connections(fixture: ProbeFixture) -> str:
    """All of `CLIENTS` simultaneous sessions answer."""
    bundles = [fixture.target.robot(f"bench-many-{i}") for i in range(CLIENTS)]
    with ExitStack() as stack, ThreadPoolExecutor(CLIENTS) as pool:
        clients = list(pool.map(lambda b: stack.enter_context(RawClient(b.folder)), bundles))
        slowest = max(pool.map(lambda client: client.ping(), clients))
    return f"{CLIENTS} sessions stood together and each answered, the slowest in {slowest * 1000:.0f} ms"


LISTENERS = 4


def live_sample(fixture: ProbeFixture) -> str:
    """A live sample reaches a subscriber."""
    with fixture.target.listener(fixture.a) as listener, fixture.connection() as connection:
        fixture.live_until(connection, lambda: listener.heard, "the subscriber to hear a sample")
        return f"a live sample came to a subscriber after {listener.heard[0].delay_ms:.0f} ms"


def many_subscribers(fixture: ProbeFixture) -> str:
    """The same message reaches several subscribers."""
    with ExitStack() as stack:
        listeners = [stack.enter_context(fixture.target.listener(fixture.a)) for _ in range(LISTENERS)]
        fixture.live_until(
            stack.enter_context(fixture.connection()),
            lambda: all(listener.heard for listener in listeners),
            "all subscribers to hear a sample",
        )
    return f"all {LISTENERS} heard one message"


def metrics(fixture: ProbeFixture) -> str:
    """CloudWatch returns the mean of the values of a metric."""
    client, now = fixture.client("cloudwatch"), datetime.now(timezone.utc)
    name, minutes = f"Bench{uuid.uuid4().hex[:8]}", timedelta(minutes=5)
    values = {"Values": [1.0, 2.0, 6.0], "Counts": [1.0, 1.0, 1.0]}
    metric: Any = {"MetricName": name, "Timestamp": now, **values}
    client.put_metric_data(Namespace="iort-bench", MetricData=[metric])
    found: list[Any] = []

    def there() -> bool:
        found[:] = client.get_metric_statistics(
            Namespace="iort-bench",
            MetricName=name,
            StartTime=now - minutes,
            EndTime=now + minutes,
            Period=60,
            Statistics=["Average", "SampleCount"],
        )["Datapoints"]
        return bool(found)

    until(there, "the metric's statistics", 180 if fixture.target.embedded is None else WAIT_S)
    equal(round(found[0]["Average"], 6), 3.0)
    return "the mean of 1, 2 and 6 came back as 3"


def logs(fixture: ProbeFixture) -> str:
    """The log has the lines of an invocation."""
    function = fixture.cloud.output("processing", "EchoFunction")
    client, logs = fixture.client("lambda"), fixture.client("logs")
    group = client.get_function_configuration(FunctionName=function)["LoggingConfig"]["LogGroup"]
    since = int(time.time() * 1000) - 1000
    fixture.pong(LAMBDA)
    until(lambda: logs.filter_log_events(logGroupName=group, startTime=since)["events"], "the log's lines")
    return "an invocation's lines are in its log"


def dashboards(fixture: ProbeFixture) -> str:
    """The deployment has dashboards with widgets."""
    client = fixture.client("cloudwatch")
    names = [entry["DashboardName"] for entry in client.list_dashboards()["DashboardEntries"]]
    if not names:
        raise AbilityMissingError("there is no dashboard")
    widgets = sum(
        len(json.loads(client.get_dashboard(DashboardName=name)["DashboardBody"])["widgets"])
        for name in names
    )
    return f"{len(names)} dashboards of {widgets} widgets"
