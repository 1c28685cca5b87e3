"""The adapter to DynamoDB, against moto and against a fake that pages and throttles."""

from __future__ import annotations

import math
from decimal import Decimal

import boto3
import pytest
from botocore.exceptions import ClientError, EndpointConnectionError

from functions.shared import tables as tables_module
from functions.shared.tables import attribute
from iort_contract.catalog.derived import Vehicle
from iort_contract.dynamodb import TableError, plain, quick
from iort_contract.messages.batch import Batch, BatchId, batch_id
from iort_contract.tables import BATCH, EXPIRES_S, SECOND, TOPIC
from testkit.dynamodb import (
    ROBOTS,
    SUMMARY,
    TELEMETRY,
    TOPIC_OF_CAR,
    FakeDynamoDB,
    item_of,
    serialize,
    summary_of,
    tables,
)

T0 = 1_700_000_000_000_000


@pytest.fixture(params=["moto", "fake"])
def client(request):
    return FakeDynamoDB() if request.param == "fake" else request.getfixturevalue("dynamodb")


@pytest.fixture
def slept(monkeypatch):
    waits = []
    monkeypatch.setattr(tables_module.time, "sleep", waits.append)
    return waits


def put(client, table, item):
    if isinstance(client, FakeDynamoDB):
        client.put(table, item)
    else:
        client.put_item(TableName=table, Item=item)


def test_a_quick_client_reads_what_botocore_does(dynamodb):
    quickly = quick(boto3.client("dynamodb"))
    calls = [quickly.query, dynamodb.query, quickly.scan, dynamodb.scan]
    for samples in (
        {"S": "\u00e4\n"},
        {"L": [{"N": "1.50"}, {"NULL": True}]},
        {"BS": [b"\x00"]},
        {"B": b"\xff"},
    ):
        item = {TOPIC: {"S": "t"}, BATCH: {"S": str(samples)}, "samples": samples}
        dynamodb.put_item(TableName=TELEMETRY, Item=item)
        condition = {
            "ExpressionAttributeNames": {"#t": TOPIC},
            "ExpressionAttributeValues": {":t": item[TOPIC]},
        }
        query, scan = ({name: "#t = :t"} for name in ("KeyConditionExpression", "FilterExpression"))
        pages = [
            read(TableName=TELEMETRY, **condition, **how)
            for read, how in zip(calls, (query, query, scan, scan), strict=True)
        ]
        for page in pages:
            assert page.pop("ResponseMetadata")["HTTPStatusCode"] == 200
        assert item in pages[0]["Items"]
        assert pages[0] == pages[1]
        assert pages[2] == pages[3]
    with pytest.raises(ClientError):
        quickly.query(TableName="none", **condition, **query)


def times_of(items):
    return [batch_id(item[BATCH]).t_us for item in items]


def store(client, *times_us, topic=TOPIC_OF_CAR):
    for seq, t_us in enumerate(times_us):
        put(client, TELEMETRY, item_of(Batch("aaaaaaaa", seq, [t_us], {"a": [seq]}), topic))


# --- telemetry --------------------------------------------------------------------------------------


def test_batches_of_a_topic_are_read_from_a_time_on_in_order(client):
    store(client, T0 + 5, T0 + 1, T0 + 2, T0, T0 + 4, T0 + 3)
    store(client, T0 + 2, topic="dt/iort/other/vesc")
    found = list(tables(client).batches_from(TOPIC_OF_CAR, T0 + 1, at_once=2))
    assert times_of(found) == [T0 + 1, T0 + 2, T0 + 3, T0 + 4, T0 + 5]
    assert {item[TOPIC] for item in found} == {TOPIC_OF_CAR}


def test_all_pages_are_read():
    client = FakeDynamoDB()
    store(client, *range(T0, T0 + 103))
    assert len(list(tables(client).batches_from(TOPIC_OF_CAR, T0, at_once=2))) == 103
    # Nearly every caller wants a few items; the others want many.
    assert client.calls["query"] == 4


def test_earlier_batches_are_read_nearest_first(client):
    store(client, T0, T0 + 1, T0 + 2, T0 + 3, T0 + 4)
    store(client, T0 + 1, topic="dt/iort/other/vesc")
    assert times_of(tables(client).before(TOPIC_OF_CAR, T0 + 2)) == [T0 + 1, T0]


def test_batches_with_equal_times_are_all_read_across_pages(client):
    store(client, *[T0] * 12, T0 + 1)
    for at_once in (1, 2, 11, 12, 13):
        found = list(tables(client).batches_from(TOPIC_OF_CAR, T0, at_once=at_once))
        assert times_of(found) == [T0] * 12 + [T0 + 1]
        assert len({item[BATCH] for item in found}) == 13
    assert len(list(tables(client).before(TOPIC_OF_CAR, T0 + 1))) == 12
    assert list(tables(client).before(TOPIC_OF_CAR, T0)) == []


def test_numbers_gives_the_ids_of_batches_between_two_times(client):
    store(client, T0, T0 + 5, T0 + 5, T0 + 9, T0 + 10)
    store(client, T0 + 5, topic="dt/iort/other/vesc")
    put(client, TELEMETRY, {TOPIC: serialize(TOPIC_OF_CAR), BATCH: serialize(f"{T0 + 6}-nobody's")})
    found = tables(client).numbers(TOPIC_OF_CAR, T0 + 1, T0 + 9)
    assert list(found) == [BatchId(T0 + at, "aaaaaaaa", seq) for at, seq in ((5, 1), (5, 2), (9, 3))]


@pytest.mark.parametrize(
    "read",
    [
        lambda found: found.before(TOPIC_OF_CAR, T0 + 8),
        lambda found: found.batches_from(TOPIC_OF_CAR, T0, at_once=1),
    ],
)
def test_the_first_item_is_read_alone(read):
    client = FakeDynamoDB(page_items=100)
    store(client, *range(T0, T0 + 9))
    next(read(tables(client)))
    assert client.read == 1


# --- robots -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("row", "vehicle"),
    [
        ({"speed_to_erpm_gain": Decimal(4614), "speed_to_erpm_offset": Decimal("0.5")}, Vehicle(4614.0, 0.5)),
        ({"speed_to_erpm_gain": Decimal(-4614)}, Vehicle(-4614.0, 0.0)),
        ({"pole_pairs": Decimal(2)}, None),
        ({"speed_to_erpm_gain": Decimal(0)}, None),
        ({"speed_to_erpm_gain": None}, None),
        ({"speed_to_erpm_gain": "fast"}, None),
        ({"speed_to_erpm_gain": "nan"}, None),
        ({"speed_to_erpm_gain": Decimal(1), "speed_to_erpm_offset": None}, None),
        ({"speed_to_erpm_gain": Decimal(1), "speed_to_erpm_offset": ["1"]}, None),
    ],
)
def test_a_vehicle_is_read_from_its_row_and_an_invalid_row_gives_no_vehicle(client, row, vehicle):
    put(client, ROBOTS, {name: serialize(value) for name, value in {"robot": "car", **row}.items()})
    assert tables(client).vehicle("car") == vehicle


def test_an_unregistered_robot_has_no_vehicle(client):
    assert tables(client).vehicle("nobody") is None


def test_the_registry_is_read_once_a_minute_or_on_demand(monkeypatch):
    client, now = FakeDynamoDB(), [0.0]
    monkeypatch.setattr(tables_module.time, "monotonic", lambda: now[0])
    asked = tables(client)
    for now[0] in (0.0, 30.0, 60.0):
        assert asked.vehicle("car") is None
    assert client.calls["get_item"] == 1
    put(client, ROBOTS, {"robot": {"S": "car"}, "speed_to_erpm_gain": {"N": "4614"}})
    now[0] = 60.1
    assert asked.vehicle("car") == Vehicle(4614.0)
    put(client, ROBOTS, {"robot": {"S": "car"}, "speed_to_erpm_gain": {"N": "1060"}})
    assert asked.vehicle("car") == Vehicle(4614.0)
    asked.forget_vehicles()
    assert asked.vehicle("car") == Vehicle(1060.0)
    assert client.calls["get_item"] == 3


# --- summary ----------------------------------------------------------------------------------------


def test_seconds_are_read_back_as_they_were_written(client):
    summary = {"n": 50, "a_min": -1.5, "b_last": "text", "c_last": False, EXPIRES_S: 1_800_000_000}
    tables(client).put_seconds({(TOPIC_OF_CAR, 1_700_000_000): summary})
    if isinstance(client, FakeDynamoDB):
        (item,) = summary_of(client).values()
    else:
        item = plain(client.scan(TableName=SUMMARY)["Items"][0])
    assert item == {TOPIC: TOPIC_OF_CAR, SECOND: 1_700_000_000, **summary}


@pytest.mark.parametrize("n", [0, 1, 25, 26, 60])
def test_writes_are_sent_in_calls_of_at_most_25_items(n):
    client = FakeDynamoDB()
    tables(client).put_seconds({(TOPIC_OF_CAR, second): {"n": 1} for second in range(n)})
    assert sorted(summary_of(client)) == list(range(n))
    assert client.calls["batch_write_item"] == math.ceil(n / 25)


def test_unprocessed_items_are_sent_again_with_backoff(slept):
    client = FakeDynamoDB(unprocessed=3)
    tables(client).put_seconds({(TOPIC_OF_CAR, second): {"n": second} for second in range(30)})
    assert {second: item["n"] for second, item in summary_of(client).items()} == {s: s for s in range(30)}
    assert len(slept) == 3
    assert slept == sorted(slept)
    assert slept[0] < slept[-1]


def test_items_that_stay_unprocessed_are_an_error_within_lambdas_time(slept):
    client = FakeDynamoDB(unprocessed=10**9)
    with pytest.raises(TableError, match=r"12 items of summary not written after 8 attempts"):
        tables(client).put_seconds({(TOPIC_OF_CAR, second): {"n": 1} for second in range(20)})
    # Lambda 2 has 60 s; one call takes a few milliseconds.
    assert sum(slept) < 10


def test_a_summary_too_large_for_an_item_omits_its_largest_values(dynamodb):
    """The maximum number of fields, each with the longest allowed text."""
    summary = {f"note_{i:03}_last": "ä" * (4096 - i) for i in range(512)} | {"n": 50, "a_mean": 1.5}
    tables(dynamodb).put_seconds({(TOPIC_OF_CAR, 1): summary})
    item = plain(dynamodb.scan(TableName=SUMMARY)["Items"][0])
    kept = [name for name in summary if name in item]
    assert item["omitted"] == len(summary) - len(kept) > 0
    assert (item["n"], item["a_mean"]) == (50, Decimal("1.5"))
    # The shortest values stayed, and they use nearly all of the item's size.
    assert sorted(kept)[:1] == ["a_mean"]
    assert "note_511_last" in item
    assert sum(len(str(value).encode()) for value in item.values()) > 350_000


# --- values -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (None, {"NULL": True}),
        (True, {"BOOL": True}),
        (False, {"BOOL": False}),
        ("", {"S": ""}),
        ("1", {"S": "1"}),
        (0, {"N": "0"}),
        (2**64 - 1, {"N": "18446744073709551615"}),
        (-(2**63), {"N": "-9223372036854775808"}),
        (0.1, {"N": "0.1"}),
        (1e21, {"N": "1e+21"}),
        (1e-130, {"N": "1e-130"}),
        (9.9e-131, {"N": "0"}),
        (5e-324, {"N": "0"}),
        (-5e-324, {"N": "0"}),
        (9.99e125, {"N": "9.99e+125"}),
        (1e126, {"S": "1e+126"}),
        (1e300, {"S": "1e+300"}),
        (-1e300, {"S": "-1e+300"}),
        (math.inf, {"S": "inf"}),
        (math.nan, {"S": "nan"}),
    ],
)
def test_a_value_becomes_a_valid_dynamodb_attribute(value, expected):
    assert attribute(value) == expected


def test_a_robot_with_ever_new_streams_has_a_bounded_row(client):
    put(client, ROBOTS, {"robot": {"S": "car"}})
    written = tables(client)
    for number in range(tables_module.MAX_STREAMS + 5):
        written.note_stream("car", f"s{number:04d}")
    row = client.get_item(TableName=ROBOTS, Key={"robot": {"S": "car"}})["Item"]
    assert len(row["streams"]["SS"]) == tables_module.MAX_STREAMS


def test_a_stream_that_cannot_be_noted_fails_no_record(client):
    class Unreachable:
        def update_item(self, **_request):
            raise EndpointConnectionError(endpoint_url="https://dynamodb")

    tables(Unreachable()).note_stream("car", "vesc")
