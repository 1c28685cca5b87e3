"""`iort adopt`: every batch of an old table is in the new one, once, with all that it held, or is told."""

from __future__ import annotations

import json
import time

import pytest

from iort_contract.messages.batch import Batch, encode_batch
from iort_contract.topics import RECORD, build_topic
from iort_station.errors import StationError
from iort_station.recordings.adopt import Left, adopt, source_table
from tests.fakes import TELEMETRY, item_of_message
from tests.unit.station.old_messages import old_message

OLD, T0 = "old", 1_700_000_000_000_000
LATER = 4_000_000_000
FAST = 10**9


class Cloud:
    """A cloud with moto's DynamoDB; ``taken`` is how many writes of a call it takes, the rest comes back."""

    namespace = "iort"

    def __init__(self, dynamodb, *, taken=25, kept=True):
        self.dynamodb, self.taken, self.kept = dynamodb, taken, kept
        self.calls = 0

    def output(self, _stack, name):
        if name == "OldTelemetryTable" and not self.kept:
            raise StationError(
                "stack iort-storage has no output OldTelemetryTable; deploy the current stacks"
            )
        return {"TelemetryTable": TELEMETRY, "OldTelemetryTable": OLD}[name]

    def client(self, service):
        assert service == "dynamodb"
        return self

    def __getattr__(self, name):
        return getattr(self.dynamodb, name)

    def batch_write_item(self, *, RequestItems):
        ((table, requests),) = RequestItems.items()
        self.calls += 1
        if taken := requests[: self.taken]:
            self.dynamodb.batch_write_item(RequestItems={table: taken})
        left = requests[self.taken :]
        return {"UnprocessedItems": {table: left} if left else {}}


@pytest.fixture
def old(dynamodb):
    """Puts messages of version 1 into a table as the record rule of before did."""
    types = {"topic": "S", "t": "N"}
    dynamodb.create_table(
        TableName=OLD,
        KeySchema=[
            {"AttributeName": "topic", "KeyType": "HASH"},
            {"AttributeName": "t", "KeyType": "RANGE"},
        ],
        AttributeDefinitions=[{"AttributeName": name, "AttributeType": kind} for name, kind in types.items()],
        BillingMode="PAY_PER_REQUEST",
    )

    def put(*messages, robot="car", stream="vesc", namespace="iort", expires_s=LATER, **more):
        topic = build_topic(RECORD, robot, stream, namespace)
        for message in messages:
            dynamodb.put_item(TableName=OLD, Item={**item_of_message(message, topic, expires_s), **more})

    return put


@pytest.fixture
def slept(monkeypatch):
    waits = []
    monkeypatch.setattr(time, "sleep", waits.append)
    return waits


def batch(i):
    times = [T0 + i * 1_000_000 + k * 20_000 for k in range(3)]
    return Batch("0badcafe", i, times, {"speed": [1.5, None, float(i)]}, nonfinite=i % 2)


def stored(dynamodb, table=TELEMETRY):
    pages = dynamodb.get_paginator("scan").paginate(TableName=table)
    return in_order(item for page in pages for item in page["Items"])


def in_order(items):
    return sorted(items, key=lambda item: json.dumps(item, sort_keys=True))


def of_today(i, topic=None):
    """What the record rule of today stores of the batch."""
    return item_of_message(encode_batch(batch(i)), topic or build_topic(RECORD, "car", "vesc"), LATER)


def test_every_batch_is_stored_as_if_it_came_today(dynamodb, old):
    old(*(old_message(batch(i)) for i in range(60)))
    old(old_message(batch(0)), robot="car-2", stream="tf")
    before, read = stored(dynamodb, OLD), []
    done = adopt(Cloud(dynamodb), OLD, units_per_s=FAST, progress=read.append)
    assert done.batches == {("car", "vesc"): 60, ("car-2", "tf"): 1}
    assert done.samples == {("car", "vesc"): 180, ("car-2", "tf"): 3}
    assert (done.left, done.expired, sum(read)) == ([], 0, 61)
    expected = [of_today(i) for i in range(60)]
    expected.append(of_today(0, build_topic(RECORD, "car-2", "tf")))
    assert stored(dynamodb) == in_order(expected)
    assert stored(dynamodb, OLD) == before


def test_twice_changes_nothing(dynamodb, old):
    old(*(old_message(batch(i)) for i in range(30)), more={"N": "7"})
    first = adopt(Cloud(dynamodb), OLD, units_per_s=FAST)
    after = stored(dynamodb)
    assert all(item["more"] == {"N": "7"} for item in after)
    assert adopt(Cloud(dynamodb), OLD, units_per_s=FAST) == first
    assert stored(dynamodb) == after
    assert len(after) == 30


def test_one_robot_alone(dynamodb, old):
    """And none whose name only begins like it."""
    for robot in ("car", "car2", "other"):
        old(old_message(batch(0)), robot=robot)
    done = adopt(Cloud(dynamodb), OLD, robot="car", units_per_s=FAST)
    assert done.batches == {("car", "vesc"): 1}
    assert stored(dynamodb) == [of_today(0)]


def test_a_dry_run_says_the_same_and_writes_nothing(dynamodb, old):
    old(*(old_message(batch(i)) for i in range(3)), old_message(batch(9), boot="?"))
    dry = adopt(Cloud(dynamodb), OLD, units_per_s=FAST, dry_run=True)
    assert stored(dynamodb) == []
    assert dry == adopt(Cloud(dynamodb), OLD, units_per_s=FAST)
    assert len(stored(dynamodb)) == 3


@pytest.mark.parametrize(
    ("changes", "cause"),
    [
        ({"t": -5}, "time must be from 1970 on, got -5 us"),
        ({"samples": "AAAA"}, "samples must be base64 of zlib"),
        ({"codec": "later"}, "got 'later'"),
        ({"v": 9}, ", got 9"),
        ({"n": 7}, "must have 7 dt"),
        ({"robot": "other"}, "in the name of 'other'"),
    ],
    ids=["1970", "samples", "codec", "version", "number", "other"],
)
def test_what_cannot_be_adopted_is_told_and_stays_and_its_neighbours_go(dynamodb, old, changes, cause):
    old(old_message(batch(0)), old_message(batch(1), **changes), old_message(batch(2)))
    done = adopt(Cloud(dynamodb), OLD, units_per_s=FAST)
    (left,) = done.left
    t_us = changes.get("t", batch(1).t_us)
    assert left[:2] == Left("dt/iort/car/vesc", str(t_us), "")[:2]
    assert cause in left.cause
    assert stored(dynamodb) == [of_today(0), of_today(2)]
    assert len(stored(dynamodb, OLD)) == 3


def test_a_batch_of_another_namespace_would_not_be_found(dynamodb, old):
    old(old_message(batch(0)), namespace="lab2")
    (left,) = adopt(Cloud(dynamodb), OLD, units_per_s=FAST).left
    assert left.cause == "the namespace must be iort, got lab2"


def test_a_batch_whose_car_was_years_ahead_is_data_all_the_same(dynamodb, old):
    old(old_message(batch(0)), received_ms={"N": "1000"})
    done = adopt(Cloud(dynamodb), OLD, units_per_s=FAST)
    assert (done.left, stored(dynamodb)) == ([], [{**of_today(0), "received_ms": {"N": "1000"}}])


def test_what_has_expired_is_not_written_to_be_deleted_again(dynamodb, old):
    old(old_message(batch(0)), expires_s=1_700_000_000)
    old(old_message(batch(1)))
    done = adopt(Cloud(dynamodb), OLD, units_per_s=FAST)
    assert (done.expired, stored(dynamodb)) == (1, [of_today(1)])


def test_what_dynamodb_does_not_take_at_once_is_sent_again(dynamodb, old):
    old(*(old_message(batch(i)) for i in range(20)))
    cloud = Cloud(dynamodb, taken=8)
    adopt(cloud, OLD, units_per_s=FAST)
    assert (cloud.calls, len(stored(dynamodb))) == (3, 20)


def test_what_dynamodb_never_takes_is_an_error_that_says_what_to_do(dynamodb, old, slept):
    old(old_message(batch(0)))
    with pytest.raises(StationError, match=r"1 items of telemetry not written .*do it again"):
        adopt(Cloud(dynamodb, taken=0), OLD, units_per_s=FAST)
    assert slept


def test_no_more_is_written_a_second_than_a_stream_can_spare(dynamodb, old, slept):
    """A topic is in one partition, which the robot writes too."""
    old(*(old_message(batch(i)) for i in range(100)))
    adopt(Cloud(dynamodb), OLD, units_per_s=5)
    # A small batch is one unit, and 25 are written at once.
    assert len(slept) == 4
    assert sum(slept) == pytest.approx(100 / 5, abs=4)


def test_a_table_restored_from_a_backup_is_copied_as_it_is(dynamodb):
    layout = dynamodb.describe_table(TableName=TELEMETRY)["Table"]
    dynamodb.create_table(
        TableName="restored",
        **{name: layout[name] for name in ("KeySchema", "AttributeDefinitions")},
        BillingMode="PAY_PER_REQUEST",
    )
    bad = {**of_today(2), "samples": {"S": "AAAA"}}
    for item in (of_today(0), of_today(1), bad):
        dynamodb.put_item(TableName="restored", Item=item)
    done = adopt(Cloud(dynamodb), "restored", units_per_s=FAST)
    assert stored(dynamodb) == [of_today(0), of_today(1)]
    assert [left.key for left in done.left] == [bad["batch"]["S"]]


# --- which table ----------------------------------------------------------------------------------------


def test_the_table_is_the_one_that_was_kept_or_that_is_named(dynamodb, old):
    old(old_message(batch(0)))
    assert source_table(Cloud(dynamodb), None) == (OLD, 1)
    assert source_table(Cloud(dynamodb, kept=False), OLD) == (OLD, 1)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (None, "no output OldTelemetryTable.*old_telemetry=true, or name a table"),
        ("nowhere", "there is no table nowhere"),
        ("summary", "summary has the keys topic, second: must be topic, t or topic, batch"),
        (TELEMETRY, "telemetry is the telemetry table itself"),
    ],
    ids=["none kept", "none there", "summaries", "itself"],
)
def test_a_table_that_is_none_says_so(dynamodb, name, words):
    with pytest.raises(StationError, match=words):
        source_table(Cloud(dynamodb, kept=False), name)
