"""DynamoDB's items and streams in the ledger, in this process' ministack."""

from __future__ import annotations

import json
from contextlib import suppress
from decimal import Decimal

import pytest
from hypothesis import given
from hypothesis import strategies as st
from ministack.core.responses import request_scope
from ministack.services import dynamodb, lambda_svc

from local.persistence import install as kept_emulator
from local.persistence import items
from local.persistence.items import place_of
from local.persistence.ledger import LedgerError
from tests.local.emulator import series_table
from tests.local.persistence.in_process import ACCOUNT, REGION, kept

NAME = "kept-items"
STREAM = {"StreamSpecification": {"StreamEnabled": True, "StreamViewType": "NEW_IMAGE"}}


@pytest.fixture
def streams(tmp_path):
    with request_scope(ACCOUNT, REGION), kept(tmp_path / "ledger.db") as streams:
        series_table.create(NAME, **STREAM)
        yield streams
        dynamodb._tables.pop(NAME, None)


def item(n, **more):
    return {"topic": {"S": "a"}, "t": {"N": str(n)}, **more}


def put(*numbers, **more):
    for n in numbers:
        assert dynamodb._put_item({"TableName": NAME, "Item": item(n, **more)})[0] == 200


def call(action, **data):
    status, _, body = getattr(dynamodb, action)({"TableName": NAME, **data})
    assert status == 200, body
    return json.loads(body)


def numbers(scan=None):
    return sorted(int(one["t"]["N"]) for one in (scan or call("_scan"))["Items"])


def recorded():
    records = dynamodb.stream_live_records(NAME)
    return [(one["eventName"], one["dynamodb"]["Keys"]["t"]["N"]) for one in records]


@given(st.lists(st.decimals(allow_nan=False, allow_infinity=False, min_value=-(10**38), max_value=10**38)))
def test_places_are_in_the_order_of_numbers(values):
    texts = [str(value) for value in values]
    by_place = sorted(texts, key=lambda text: place_of("N", text))
    assert [Decimal(text) for text in by_place] == sorted(values)
    assert place_of("N", "1.0") == place_of("N", "1") == place_of("N", "1E0")


def test_a_restart_finds_items_streams_and_counts(tmp_path):
    with request_scope(ACCOUNT, REGION), kept(tmp_path / "ledger.db"):
        series_table.create(NAME, **STREAM)
        put(1, 2, 3, text={"S": "ü"})
        call(
            "_update_item",
            Key=item(2),
            UpdateExpression="SET more = :v",
            ExpressionAttributeValues={":v": {"BOOL": True}},
        )
        call("_delete_item", Key=item(3))
        saved = dynamodb.get_state()
        dynamodb._tables.clear()
    assert not next(iter(saved["tables"].all_values()))["items"]
    with request_scope(ACCOUNT, REGION), kept(tmp_path / "ledger.db"):
        dynamodb.load_persisted_state(saved)
        assert numbers() == [1, 2]
        assert call("_get_item", Key=item(2))["Item"] == item(2, text={"S": "ü"}, more={"BOOL": True})
        assert call("_describe_table")["Table"]["ItemCount"] == 2
        put(4)
        events = ["INSERT 1", "INSERT 2", "INSERT 3", "MODIFY 2", "REMOVE 3", "INSERT 4"]
        assert [" ".join(event) for event in recorded()] == events
        dynamodb._tables.clear()


def test_an_item_and_its_record_are_one_change(streams, monkeypatch):
    put(1)

    def broken(*_arguments):
        raise RuntimeError("no record")

    monkeypatch.setattr(dynamodb, "_build_change_record", broken)
    with pytest.raises(RuntimeError, match="no record"):
        put(2)
    assert numbers() == [1]
    dynamodb._expire_items(0.0)
    assert call("_describe_table")["Table"]["ItemCount"] == 1


def test_a_table_whose_first_item_was_undone_gets_a_place_of_its_own(streams):
    with suppress(LedgerError), streams.ledger.write() as connection:
        put(1)
        connection.execute("INSERT INTO items VALUES (1)")
    assert numbers() == []
    series_table.create("kept-other")
    assert dynamodb._put_item({"TableName": "kept-other", "Item": item(7)})[0] == 200
    put(1)
    assert numbers() == [1]
    assert numbers(call("_scan", TableName="kept-other")) == [7]
    del dynamodb._tables["kept-other"]


def test_a_full_file_undoes_items_and_records(streams):
    put(1)
    streams.ledger.commit()
    ((pages,),) = streams.ledger.read("PRAGMA page_count")
    streams.ledger.read(f"PRAGMA max_page_count = {pages}")
    with pytest.raises(LedgerError, match="full"):
        put(*range(2, 200), text={"S": "x" * 1000})
    assert numbers() == [1]
    streams.ledger.read("PRAGMA max_page_count = 1000000")
    dynamodb._expire_items(0.0)
    assert call("_describe_table")["Table"]["ItemCount"] == 1
    put(5)
    assert recorded() == [("INSERT", "1"), ("INSERT", "5")]
    assert [int(one["dynamodb"]["SequenceNumber"]) for one in dynamodb.stream_live_records(NAME)] == [0, 1]


def test_a_failed_transaction_leaves_the_items(streams):
    put(1, 2)
    statements = [
        {"Statement": f"DELETE FROM \"{NAME}\" WHERE topic = 'a' AND t = 1"},
        {"Statement": f"UPDATE \"{NAME}\" SET x = 1 WHERE topic = 'a' AND t = 9"},
    ]
    status, _, body = dynamodb._execute_transaction({"TransactStatements": statements})
    assert status == 400, body
    assert numbers() == [1, 2]
    put(3)
    assert numbers() == [1, 2, 3]


def test_an_index_finds_items_of_the_ledger(streams):
    schema = [{"AttributeName": "robot", "KeyType": "HASH"}]
    index = {"IndexName": "by-robot", "KeySchema": schema, "Projection": {"ProjectionType": "ALL"}}
    dynamodb._tables[NAME]["GlobalSecondaryIndexes"] = [index]
    put(1, 3, robot={"S": "a"})
    put(2, robot={"S": "b"})
    put(4)
    query = {
        "IndexName": "by-robot",
        "KeyConditionExpression": "robot = :r",
        "ExpressionAttributeValues": {":r": {"S": "a"}},
    }
    assert numbers(call("_query", **query)) == [1, 3]
    call("_delete_item", Key=item(1))
    assert numbers(call("_query", **query)) == [3]


def test_items_expire_by_an_index(streams):
    put(1, ends={"N": "100"})
    put(2, ends={"N": "200"})
    put(3, ends={"S": "never"})
    put(4)
    dynamodb._ttl_settings[NAME] = {"TimeToLiveStatus": "ENABLED", "AttributeName": "ends"}
    dynamodb._expire_items(150.0)
    assert numbers() == [2, 3, 4]
    put(5, ends={"N": "150"})
    plan = streams.ledger.read("EXPLAIN QUERY PLAN SELECT id FROM items WHERE tab = 1 AND expires_s <= 1")
    assert "items_expires" in plan[0][-1]
    dynamodb._expire_items(200.0)
    assert numbers() == [3, 4]
    assert call("_describe_table")["Table"]["ItemCount"] == 2
    del dynamodb._ttl_settings[NAME]
    put(6, ends={"N": "1"})
    dynamodb._expire_items(10**10)
    assert numbers() == [3, 4, 6]


def test_nothing_expires_soon_after_a_start(monkeypatch):
    began_s, passes = 1e9, []
    monkeypatch.setattr(kept_emulator.time, "time", lambda: began_s)
    expire = kept_emulator.not_at_first(passes.append)
    # The last one is after a clock that was ahead at the start.
    times = [began_s, began_s + kept_emulator.FIRST_S - 1, began_s + kept_emulator.FIRST_S, began_s - 1]
    for now_s in times:
        expire(now_s)
    assert passes == times[2:]


def test_many_items_expire_a_few_at_a_time(streams, monkeypatch):
    monkeypatch.setattr(items, "_EXPIRED_ROWS", 3)
    put(*range(10), ends={"N": "1"})
    put(10, ends={"N": "9"})
    dynamodb._ttl_settings[NAME] = {"TimeToLiveStatus": "ENABLED", "AttributeName": "ends"}
    kept_at_commits = []
    commit = streams.ledger.commit
    monkeypatch.setattr(streams.ledger, "commit", lambda: kept_at_commits.append(len(numbers())) or commit())
    dynamodb._expire_items(5.0)
    del dynamodb._ttl_settings[NAME]
    assert kept_at_commits[-4:] == [8, 5, 2, 1]


def test_a_stream_is_trimmed_up_to_what_its_mappings_finished(streams, monkeypatch):
    put(*range(5))
    arn = dynamodb._tables[NAME]["LatestStreamArn"]
    monkeypatch.setattr(lambda_svc, "_iter_all_esms", lambda: iter([(ACCOUNT, REGION, {"UUID": "one"})]))
    streams.mark("one", arn, 2)
    streams.mark("deleted", arn, 0)
    created_s = dynamodb.stream_live_records(NAME)[0]["dynamodb"]["ApproximateCreationDateTime"]
    streams.trim(created_s + 1)
    assert len(dynamodb.stream_live_records(NAME)) == 5
    streams.trim(created_s + 24 * 3600 + 10)
    assert dynamodb.stream_start_position(NAME) == 2
    # The newest stays: the next position is known from it.
    streams.mark("one", arn, 5)
    streams.trim(created_s + 24 * 3600 + 10)
    assert (dynamodb.stream_start_position(NAME), dynamodb.stream_end_position(NAME)) == (4, 5)
    put(9)
    assert [one["dynamodb"]["Keys"]["t"]["N"] for one in dynamodb.stream_records_since(NAME, 5, 10)] == ["9"]


def test_a_deleted_table_leaves_nothing(streams):
    put(1, 2)
    call("_delete_table")
    for table in ("tables", "items", "streams", "records"):
        assert streams.ledger.read(f"SELECT count(*) FROM {table}") == [(0,)]
    series_table.create(NAME, **STREAM)
    assert numbers() == []


def test_a_put_does_the_same_work_whatever_the_table_has(streams):
    put(1)
    streams.ledger.commit()
    statements = []
    with streams.ledger.reading() as connection:
        connection.set_trace_callback(statements.append)
        put(2)
        streams.ledger.commit()
        connection.set_trace_callback(None)
    assert [text.split()[0] for text in statements if text.split()[0] != "SELECT"] == [
        "BEGIN", "SAVEPOINT", "INSERT", "INSERT", "RELEASE", "COMMIT",
    ]  # fmt: skip
    assert not [text for text in statements if "count(" in text or "DISTINCT" in text]
