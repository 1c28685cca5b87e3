"""`iort adopt` copies every batch of another table once and completely, or reports it."""

from __future__ import annotations

import json
import time

import pytest

from iort_contract.messages.batch import Batch, encode_batch
from iort_contract.topics import RECORD, build_topic
from iort_station.errors import StationError
from iort_station.recordings.adopt import Left, adopt, items_in
from tests.fakes import TELEMETRY, item_of_message

OLD, T0 = "old", 1_700_000_000_000_000
LATER = 4_000_000_000
FAST = 10**9


class Cloud:
    """A cloud with moto's DynamoDB; each call takes ``taken`` writes and returns the rest as unprocessed."""

    namespace = "iort"

    def __init__(self, dynamodb, *, taken=25):
        self.dynamodb, self.taken = dynamodb, taken
        self.calls = 0

    def output(self, _stack, name):
        return {"TelemetryTable": TELEMETRY}[name]

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
    """Puts messages into a table that DynamoDB restored from a backup."""
    layout = dynamodb.describe_table(TableName=TELEMETRY)["Table"]
    dynamodb.create_table(
        TableName=OLD,
        **{name: layout[name] for name in ("KeySchema", "AttributeDefinitions")},
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


def message(batch, **changes):
    return json.dumps({**json.loads(encode_batch(batch)), **changes}).encode()


def batch(i):
    times = [T0 + i * 1_000_000 + k * 20_000 for k in range(3)]
    return Batch("0badcafe", i, times, {"speed": [1.5, None, float(i)]}, nonfinite=i % 2)


def stored(dynamodb, table=TELEMETRY):
    pages = dynamodb.get_paginator("scan").paginate(TableName=table)
    return in_order(item for page in pages for item in page["Items"])


def in_order(items):
    return sorted(items, key=lambda item: json.dumps(item, sort_keys=True))


def of_today(i, topic=None):
    """The item that today's record rule stores for the batch."""
    return item_of_message(encode_batch(batch(i)), topic or build_topic(RECORD, "car", "vesc"), LATER)


def test_every_batch_is_stored_as_it_was(dynamodb, old):
    old(*(message(batch(i)) for i in range(60)))
    old(message(batch(0)), robot="car-2", stream="tf")
    before, read = stored(dynamodb, OLD), []
    done = adopt(Cloud(dynamodb), OLD, units_per_s=FAST, progress=read.append)
    assert done.batches == {("car", "vesc"): 60, ("car-2", "tf"): 1}
    assert done.samples == {("car", "vesc"): 180, ("car-2", "tf"): 3}
    assert (done.left, done.expired, sum(read)) == ([], 0, 61)
    expected = [of_today(i) for i in range(60)]
    expected.append(of_today(0, build_topic(RECORD, "car-2", "tf")))
    assert stored(dynamodb) == in_order(expected)
    assert stored(dynamodb, OLD) == before


def test_a_second_adoption_changes_nothing(dynamodb, old):
    old(*(message(batch(i)) for i in range(30)), more={"N": "7"})
    first = adopt(Cloud(dynamodb), OLD, units_per_s=FAST)
    after = stored(dynamodb)
    assert all(item["more"] == {"N": "7"} for item in after)
    assert adopt(Cloud(dynamodb), OLD, units_per_s=FAST) == first
    assert stored(dynamodb) == after
    assert len(after) == 30


def test_one_robot_can_be_adopted_alone(dynamodb, old):
    """Robots whose names only begin with the same text are left out."""
    for robot in ("car", "car2", "other"):
        old(message(batch(0)), robot=robot)
    done = adopt(Cloud(dynamodb), OLD, robot="car", units_per_s=FAST)
    assert done.batches == {("car", "vesc"): 1}
    assert stored(dynamodb) == [of_today(0)]


def test_a_dry_run_reports_the_same_and_writes_nothing(dynamodb, old):
    old(*(message(batch(i)) for i in range(3)), message(batch(9), codec="later"))
    dry = adopt(Cloud(dynamodb), OLD, units_per_s=FAST, dry_run=True)
    assert stored(dynamodb) == []
    assert dry == adopt(Cloud(dynamodb), OLD, units_per_s=FAST)
    assert len(stored(dynamodb)) == 3


@pytest.mark.parametrize(
    ("changes", "cause"),
    [
        ({"samples": "AAAA"}, "samples must be base64 of zlib"),
        ({"codec": "later"}, "got 'later'"),
        ({"v": 9}, ", got 9"),
        ({"n": 7}, "must have 7 dt"),
        ({"robot": "other"}, "in the name of 'other'"),
    ],
    ids=["samples", "codec", "version", "number", "other"],
)
def test_an_invalid_batch_is_reported_and_its_neighbours_are_adopted(dynamodb, old, changes, cause):
    old(message(batch(0)), message(batch(1), **changes), message(batch(2)))
    done = adopt(Cloud(dynamodb), OLD, units_per_s=FAST)
    (left,) = done.left
    assert left[:2] == Left("dt/iort/car/vesc", str(batch(1).id), "")[:2]
    assert cause in left.cause
    assert stored(dynamodb) == [of_today(0), of_today(2)]
    assert len(stored(dynamodb, OLD)) == 3


def test_a_batch_of_another_namespace_is_not_adopted(dynamodb, old):
    old(message(batch(0)), namespace="lab2")
    (left,) = adopt(Cloud(dynamodb), OLD, units_per_s=FAST).left
    assert left.cause == "the namespace must be iort, got lab2"


def test_a_batch_of_a_car_with_a_clock_years_ahead_is_adopted(dynamodb, old):
    old(message(batch(0)), received_ms={"N": "1000"})
    done = adopt(Cloud(dynamodb), OLD, units_per_s=FAST)
    assert (done.left, stored(dynamodb)) == ([], [{**of_today(0), "received_ms": {"N": "1000"}}])


def test_an_expired_batch_is_not_adopted(dynamodb, old):
    old(message(batch(0)), expires_s=1_700_000_000)
    old(message(batch(1)))
    done = adopt(Cloud(dynamodb), OLD, units_per_s=FAST)
    assert (done.expired, stored(dynamodb)) == (1, [of_today(1)])


def test_unprocessed_items_are_sent_again(dynamodb, old):
    old(*(message(batch(i)) for i in range(20)))
    cloud = Cloud(dynamodb, taken=8)
    adopt(cloud, OLD, units_per_s=FAST)
    assert (cloud.calls, len(stored(dynamodb))) == (3, 20)


def test_items_that_stay_unprocessed_are_an_error_with_advice(dynamodb, old, slept):
    old(message(batch(0)))
    with pytest.raises(StationError, match=r"1 items of telemetry not written .*do it again"):
        adopt(Cloud(dynamodb, taken=0), OLD, units_per_s=FAST)
    assert slept


def test_the_write_rate_is_limited(dynamodb, old, slept):
    """A topic is one partition, and the robot writes to it at the same time."""
    old(*(message(batch(i)) for i in range(100)))
    adopt(Cloud(dynamodb), OLD, units_per_s=5)
    # A small batch is one unit, and 25 are written at once.
    assert len(slept) == 4
    assert sum(slept) == pytest.approx(100 / 5, abs=4)


# --- which table ----------------------------------------------------------------------------------------


def test_the_number_of_items_is_that_of_the_table(dynamodb, old):
    old(message(batch(0)))
    assert items_in(Cloud(dynamodb), OLD) == 1


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("nowhere", "there is no table nowhere"),
        ("summary", "summary has the keys topic, second: must be topic, batch"),
        (TELEMETRY, "telemetry is the telemetry table itself"),
    ],
    ids=["none there", "summaries", "itself"],
)
def test_an_invalid_table_is_an_error(dynamodb, name, words):
    with pytest.raises(StationError, match=words):
        items_in(Cloud(dynamodb), name)
