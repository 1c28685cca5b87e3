"""Probes of AWS IoT Core."""

from __future__ import annotations

import json
import uuid
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack

from bench.floors.raw_mqtt import RawClient
from bench.probes.probe_fixture import AbilityMissingError, ProbeFixture, equal, until
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.tables import RECEIVED_MS
from iort_contract.topics import BROKER, CMD, FLEET, LAMBDA, PING, RULE, SHADOW, record_topic
from iort_station.operations import quarantine

CLIENTS = 20


def robot_to_robot(fixture: ProbeFixture) -> str:
    """A message of one robot reaches another robot's subscription."""
    topic, payload = fixture.topic(FLEET, fixture.a, "pose"), uuid.uuid4().hex.encode()
    with fixture.client(0) as one, fixture.client(1) as other:
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
    client, value = fixture.cloud.client("iot-data"), uuid.uuid4().hex
    document = json.dumps({"state": {"desired": {"bench": value}}})
    client.update_thing_shadow(thingName=fixture.b, shadowName=SHADOW, payload=document)
    kept = json.loads(client.get_thing_shadow(thingName=fixture.b, shadowName=SHADOW)["payload"].read())
    equal(kept["state"]["desired"]["bench"], value)
    return "the robot's shadow gave back what was written"


def any_mqtt_client(fixture: ProbeFixture) -> str:
    """A client of another MQTT version than the agent's gets its message back."""
    with fixture.client(0) as client:
        topic = fixture.topic(PING, fixture.a, BROKER)
        client.subscribe(topic)
        took_s = client.round_trip(topic, b"{}")
    return f"a client of a hundred lines had its message back in {took_s * 1000:.1f} ms"


def messages_over_https(fixture: ProbeFixture) -> str:
    """A message that was sent over HTTPS arrives over MQTT."""
    topic, payload = fixture.topic(CMD, fixture.a, "bench"), uuid.uuid4().hex.encode()
    with fixture.client(0) as client:
        client.subscribe(topic)
        fixture.cloud.client("iot-data").publish(topic=topic, qos=0, payload=payload)
        equal(client.receive(), (topic, payload))
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
    mark = uuid.uuid4().hex
    message = json.dumps({"bench": mark}).encode()
    with fixture.client(0) as client:
        client.publish(record_topic(fixture.a, VESC_STREAM, fixture.namespace), message)
        client.ping()

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
