"""DynamoDB in memory, with the calls of functions/shared/tables.py, fast enough for hypothesis."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from decimal import Decimal
from typing import Any

from boto3.dynamodb.types import TypeSerializer
from botocore.exceptions import ClientError

from functions.shared.tables import Tables
from iort_contract.archive import HOUR
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.checks import json_object
from iort_contract.codec import flat_second
from iort_contract.dynamodb import plain
from iort_contract.messages.batch import Batch, encode_batch
from iort_contract.tables import BATCH, EXPIRES_S, RECEIVED_MS, ROBOT, SECOND, TOPIC
from iort_contract.topics import RECORD, build_topic

serialize = TypeSerializer().serialize

TELEMETRY, SUMMARY, ROBOTS, QUARANTINE, ARCHIVE = "telemetry", "summary", "robots", "quarantine", "archive"
FINDINGS, FILES = "findings", "files"
# The arguments of Tables, as Lambda 2 gets them.
NAMES = {"telemetry": TELEMETRY, "summary": SUMMARY, "robots": ROBOTS}
KEYS = {TELEMETRY: (TOPIC, BATCH), SUMMARY: (TOPIC, SECOND), ROBOTS: (ROBOT,), ARCHIVE: (TOPIC, HOUR)}
TOPIC_OF_CAR = build_topic(RECORD, "car", VESC_STREAM)
# In 2096: what has expired is neither read nor moved.
EXPIRES = 4_000_000_000


class FakeDynamoDB:
    """Implements the client's calls. A page holds ``page_items`` items, where AWS' pages hold 1 MB; the
    first ``unprocessed`` attempts of every write accept only the first item.
    """

    def __init__(self, *, page_items: int = 2, unprocessed: int = 0) -> None:
        self.page_items, self.unprocessed = page_items, unprocessed
        self.items: dict[str, dict[tuple[Any, ...], dict[str, Any]]] = {name: {} for name in KEYS}
        self.calls: Counter[str] = Counter()
        self.read = 0

    def put(self, table: str, item: dict[str, Any]) -> None:
        self.items[table][_key(table, item)] = item

    def get_paginator(self, operation: str) -> _Scans:
        assert operation == "scan"
        return _Scans(self)

    def query(self, **query: Any) -> dict[str, Any]:
        assert query["ConsistentRead"]
        names, values = query["ExpressionAttributeNames"], query["ExpressionAttributeValues"]
        assert names["#topic"] == TOPIC
        table, topic = query["TableName"], values[":topic"]["S"]
        found = sorted(key for key in self.items[table] if key[0] == topic)
        if query["KeyConditionExpression"] != "#topic = :topic":
            assert query["KeyConditionExpression"] == "#topic = :topic AND #key BETWEEN :first AND :last"
            assert names["#key"] == KEYS[table][1]
            first, last = _comparable(values[":first"]), _comparable(values[":last"])
            assert first <= last, "BETWEEN refuses an upper bound below the lower one"
            found = [key for key in found if first <= key[1] <= last]
        if not query.get("ScanIndexForward", True):
            found.reverse()
        if "ExclusiveStartKey" in query:
            after = _key(table, query["ExclusiveStartKey"])
            forward = query.get("ScanIndexForward", True)
            found = [key for key in found if (key > after if forward else key < after)]
        size = query.get("Limit", self.page_items)
        page = [self.items[table][key] for key in found[:size]]
        self.calls["query"] += 1
        self.read += len(page)
        answer = {"Items": _projected(page, query), "Count": len(page)}
        # DynamoDB stops at a limit without reading the next item.
        if len(found) > size or (page and len(page) == query.get("Limit")):
            answer["LastEvaluatedKey"] = {name: page[-1][name] for name in KEYS[table]}
        return answer

    def scan(self, **scan: Any) -> dict[str, Any]:
        """Return a topic's items in one page, in another order than a query."""
        self.calls["scan"] += 1
        values, table = scan["ExpressionAttributeValues"], scan["TableName"]
        assert "FilterExpression" in scan
        first, last = _comparable(values[":first"]), _comparable(values[":last"])
        topic = values[":topic"]["S"]
        found = [key for key in self.items[table] if key[0] == topic and first <= key[1] <= last][::-1]
        if "ExclusiveStartKey" in scan:
            found = found[1 + found.index(_key(table, scan["ExclusiveStartKey"])) :]
        return {"Items": _projected([self.items[table][key] for key in found], scan)}

    def get_item(self, *, TableName: str, Key: dict[str, Any], **how: Any) -> dict[str, Any]:
        self.calls["get_item"] += 1
        item = self.items[TableName].get(_key(TableName, Key))
        return {"Item": _projected([item], how)[0]} if item else {}

    def update_item(self, *, TableName: str, Key: dict[str, Any], **how: Any) -> dict[str, Any]:
        """Add to a string set of an existing item."""
        self.calls["update_item"] += 1
        names, values = how["ExpressionAttributeNames"], how["ExpressionAttributeValues"]
        assert how["UpdateExpression"] == "ADD #streams :stream"
        assert how["ConditionExpression"] == (
            "attribute_exists(#robot) AND (attribute_not_exists(#streams) OR size(#streams) < :most)"
        )
        item = self.items[TableName].get(_key(TableName, Key))
        most = int(values[":most"]["N"])
        if item is None or len(item.get(names["#streams"], {"SS": []})["SS"]) >= most:
            raise ClientError({"Error": {"Code": "ConditionalCheckFailedException"}}, "UpdateItem")
        there = item.get(names["#streams"], {"SS": []})["SS"]
        item[names["#streams"]] = {"SS": sorted({*there, *values[":stream"]["SS"]})}
        return {}

    def batch_write_item(self, *, RequestItems: dict[str, Any]) -> dict[str, Any]:
        self.calls["batch_write_item"] += 1
        ((table, requests),) = RequestItems.items()
        items = [request["PutRequest"]["Item"] for request in requests]
        keys = [tuple(str(item[name]) for name in KEYS[table]) for item in items]
        assert 1 <= len(items) <= 25, "BatchWriteItem takes 1 to 25 items"
        assert len(set(keys)) == len(keys), "BatchWriteItem refuses two writes of one item"
        taken = items if self.calls["batch_write_item"] > self.unprocessed else items[:1]
        for item in taken:
            self.put(table, item)
        left = requests[len(taken) :]
        return {"UnprocessedItems": {table: left} if left else {}}


def _key(table: str, item: dict[str, Any]) -> tuple[Any, ...]:
    return tuple(_comparable(item[name]) for name in KEYS[table])


def _comparable(value: dict[str, str]) -> Any:
    """Return a key attribute in DynamoDB's order: numbers by value, texts by bytes."""
    ((kind, content),) = value.items()
    return Decimal(content) if kind == "N" else content


def _projected(items: Sequence[dict[str, Any]], request: dict[str, Any]) -> list[dict[str, Any]]:
    """The items with the attributes that a request asks for; all of them without a projection."""
    if "ProjectionExpression" not in request:
        return list(items)
    names = request.get("ExpressionAttributeNames", {})
    wanted = [names.get(name, name) for name in request["ProjectionExpression"].split(", ")]
    return [{name: item[name] for name in wanted if name in item} for item in items]


class _Scans:
    """Every item of a table, in unspecified order."""

    def __init__(self, table: FakeDynamoDB) -> None:
        self._table = table

    def paginate(self, **scan: Any) -> Iterator[dict[str, Any]]:
        self._table.calls["scan"] += 1
        yield {"Items": list(self._table.items[scan["TableName"]].values())}


def tables(client: Any) -> Tables:
    """The tables by their usual names."""
    return Tables(client, **NAMES)


def item_of(batch: Batch, topic: str = TOPIC_OF_CAR, expires_s: int = EXPIRES) -> dict[str, Any]:
    """Return the telemetry item that the record rule makes of a batch."""
    return item_of_message(encode_batch(batch), topic, expires_s)


def item_of_message(message: bytes, topic: str = TOPIC_OF_CAR, expires_s: int = EXPIRES) -> dict[str, Any]:
    """Return the telemetry item that the record rule makes of a message."""
    envelope = json_object(message, "envelope")
    envelope.update({TOPIC: topic, RECEIVED_MS: 1_700_000_000_000, EXPIRES_S: expires_s})
    return {name: serialize(value) for name, value in envelope.items()}


def record_of(item: dict[str, Any], number: int = 1, kind: str = "INSERT") -> dict[str, Any]:
    """Return the stream record that the table makes of an item."""
    keys = {name: item[name] for name in KEYS[TELEMETRY]}
    change = {"Keys": keys, "SequenceNumber": f"{number:021}", "StreamViewType": "NEW_IMAGE"}
    if kind != "REMOVE":
        change["NewImage"] = item
    return {"eventID": f"e{number}", "eventName": kind, "eventSource": "aws:dynamodb", "dynamodb": change}


def summary_of(client: FakeDynamoDB, topic: str = TOPIC_OF_CAR) -> dict[int, dict[str, Any]]:
    """Return a topic's summary items by second, with the flat names of the readers."""
    stored = client.items[SUMMARY].items()
    return {int(key[1]): flat_second(plain(item)) for key, item in stored if key[0] == topic}
