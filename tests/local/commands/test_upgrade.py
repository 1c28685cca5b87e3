"""An upgrade of a deployment from before batches had ids loses neither stored batches nor messages of old
robots.
"""

from __future__ import annotations

import json
import time

import pytest
from boto3.dynamodb.types import TypeSerializer

from iort_contract.messages.batch import Batch
from iort_contract.tables import EXPIRES_S, RECEIVED_MS, TOPIC
from iort_contract.topics import RECORD, build_topic, record_topic
from iort_station import data
from iort_station.operations import quarantine
from iort_station.operations.delivery import counts
from tests.local.conftest import until
from tests.unit.station.recordings.old_messages import old_envelope, old_message
from verify.tools.robot import Robot

RUN = "0badcafe"
BATCHES, EACH = 30, 10
DAY_S = 86_400


def drive(start_us):
    """Make half a minute of one-second batches."""
    for i in range(BATCHES):
        times = [start_us + i * 1_000_000 + k * 100_000 for k in range(EACH)]
        yield Batch(RUN, i, times, {"speed": [float(i * EACH + k) for k in range(EACH)]})


@pytest.fixture
def old_table(embedded):
    """Make a table of the old format; `old_table(robot, messages)` stores them as the old rule did."""
    client, name = embedded.cloud.client("dynamodb"), "telemetry-of-before"
    keys = [("topic", "HASH", "S"), ("t", "RANGE", "N")]
    client.create_table(
        TableName=name,
        KeySchema=[{"AttributeName": key, "KeyType": kind} for key, kind, _ in keys],
        AttributeDefinitions=[{"AttributeName": key, "AttributeType": kind} for key, _, kind in keys],
        BillingMode="PAY_PER_REQUEST",
    )

    def put(robot, *messages, stream="vesc"):
        serialize = TypeSerializer().serialize
        received_ms = int((time.time() - 3 * DAY_S) * 1000)
        more = {TOPIC: build_topic(RECORD, robot, stream), RECEIVED_MS: received_ms}
        more[EXPIRES_S] = int(time.time()) + 80 * DAY_S
        for message in messages:
            item = {key: serialize(value) for key, value in {**message, **more}.items()}
            client.put_item(TableName=name, Item=item)

    yield put
    client.delete_table(TableName=name)


def test_an_old_table_is_adopted(embedded, bundle, iort, old_table):
    """Queries, audit and summaries contain every batch; a second run changes nothing; failures are
    reported.
    """
    cloud, car = embedded.cloud, bundle()
    start_us = int(time.time() - 3 * DAY_S) * 1_000_000
    batches = list(drive(start_us))
    old_table(car.robot, *map(old_envelope, batches))
    old_table(car.robot, old_envelope(batches[0], t=-7), stream="lost")

    def adopted(*options):
        done = iort("adopt", "telemetry-of-before", "--robot", car.robot, "--json", *options)
        said = json.loads(done.stdout)
        assert done.exit_code == 1, done.output
        expected = {"robot": car.robot, "stream": "vesc", "batches": BATCHES, "samples": BATCHES * EACH}
        assert said["adopted"] == [expected]
        (left,) = said["left"]
        assert (left["key"], left["cause"]) == ("-7", "time must be from 1970 on, got -7 us")

    def there():
        items = sorted(counts.items(cloud, car.robot, "vesc"), key=lambda item: item["batch"])
        found = data.query(cloud, car.robot, "vesc", fields=["speed"])
        summary = data.query(cloud, car.robot, "vesc", summary=True, fields=["speed"])
        return items, found.columns["speed"].tolist(), summary.columns["speed_max"].tolist()

    adopted("--dry-run")
    assert list(counts.items(cloud, car.robot, "vesc")) == []
    adopted()
    until(lambda: counts.samples_summarized(cloud, car.robot, "vesc") == BATCHES * EACH)
    items, speeds, fastest = there()
    assert speeds == list(range(BATCHES * EACH))
    assert fastest == [i * EACH + EACH - 1 for i in range(BATCHES)]
    assert len(items) == BATCHES
    assert all(item[EXPIRES_S] > time.time() + 79 * DAY_S for item in items)
    audit = iort("audit", car.robot, "--stream", "vesc", "--from-start", "--json")
    assert audit.exit_code == 0, audit.output
    (stream,) = json.loads(audit.stdout)["streams"]
    (run,) = stream["runs"]
    assert (run["batches"], run["samples"], run["missing_batches"]) == (BATCHES, BATCHES * EACH, 0)
    # The registry has it from Lambda 2.
    assert iort("audit", car.robot).exit_code == 0
    adopted()
    assert there() == (items, speeds, fastest)
    shown = iort("adopt", "telemetry-of-before", "--robot", car.robot)
    assert f"{car.robot} vesc: {BATCHES} batches of {BATCHES * EACH} samples adopted" in shown.stdout
    assert f"dt/iort/{car.robot}/lost at -7: time must be from 1970 on, got -7 us" in shown.stdout


def test_an_error_without_an_old_table_gives_advice(iort):
    assert "old_telemetry=true" in str(iort("adopt").exception)
    assert "there is no table nowhere" in str(iort("adopt", "nowhere").exception)


def test_a_message_of_an_old_agent_waits_in_quarantine_and_is_put_back_once(embedded, bundle, iort):
    """The stacks are updated first: the record rule cannot store a message without an id."""
    cloud, car = embedded.cloud, bundle()
    batches = list(drive(int(time.time()) * 1_000_000))[:3]
    with Robot(car.folder) as robot:
        robot.online()
        for batch in batches:
            assert robot.publish(record_topic(car.robot, "vesc"), old_message(batch)) == "SUCCESS"
    entries = until(lambda: (found := list(quarantine.entries(cloud, robot=car.robot)))[2:] and found)
    assert {entry.source for entry in entries} == {"rule iort_record"}
    payloads = {quarantine.load(cloud, entry).payload for entry in entries}
    assert payloads == {old_message(batch) for batch in batches}
    assert list(counts.items(cloud, car.robot, "vesc")) == []
    done = iort("replay-errors", "--robot", car.robot)
    assert (done.exit_code, "3 replayed" in done.stdout) == (0, True), done.output
    stored = list(counts.batches(cloud, car.robot, "vesc"))
    assert [(batch.id, list(batch.times_us)) for batch in stored] == [(b.id, b.times_us) for b in batches]
    assert [batch.columns for batch in stored] == [batch.columns for batch in batches]
    until(lambda: counts.samples_summarized(cloud, car.robot, "vesc") == 3 * EACH)
    assert list(quarantine.entries(cloud, robot=car.robot)) == []
    assert iort("audit", car.robot, "--stream", "vesc", "--from-start").exit_code == 0
