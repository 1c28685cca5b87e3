"""The telemetry and summary tables in DynamoDB: every key condition on them, and every batch write.

The caller hands in a boto3 DynamoDB client. Items stay as DynamoDB sends them: ``{"n": {"N": "50"}}``.
`plain` turns them into Python values. `quick` makes a client read them several times as fast.
"""

from __future__ import annotations

import json
import time
from decimal import Decimal
from itertools import islice
from typing import Any, Callable, Dict, Iterable, Iterator, Mapping, NamedTuple, Sequence, TypeVar

from iort_contract.checks import integer, shown
from iort_contract.limits import MAX_BATCH_SPAN_US, ContractError
from iort_contract.messages.batch import batches_between
from iort_contract.tables import BATCH, SECOND, TOPIC

Item = Dict[str, Any]
# BatchWriteItem takes at most this many items a call.
WRITE_ITEMS = 25
_WRITE_ATTEMPTS = 8
# The contract allows no time beyond these.
_FIRST_S, _LAST_S = -(2**53), 2**53
_Client = TypeVar("_Client")


class TableError(Exception):
    """DynamoDB did not take all items; the caller may try again."""


class Page(NamedTuple):
    """One answer of DynamoDB: at most 1 MB of items, and the key to continue after; None on the last page."""

    items: list[Item]
    after: Item | None


class Keys(NamedTuple):
    """A range of sort keys, both ends inclusive, as DynamoDB's attribute values."""

    first: Mapping[str, str]
    last: Mapping[str, str]
    empty: bool


def quick(client: _Client) -> _Client:
    """The same boto3 client; it reads a page in one pass of JSON.

    botocore looks up the shape of every value, which took a fifth of Lambda 2's processor time. Items are
    DynamoDB's JSON on both sides of it, but for bytes: with these botocore does the work. By its events
    (boto3, "Extensibility guide"); a version without them would only be slower.
    """
    events = client.meta.events  # type: ignore[attr-defined]  # any client of boto3
    for operation in ("Query", "Scan"):
        events.register_first(f"before-parse.dynamodb.{operation}", _read_page, f"iort-{operation}")
    return client


def _read_page(response_dict: dict[str, Any], customized_response_dict: dict[str, Any], **_: Any) -> None:
    body = response_dict["body"]
    if response_dict["status_code"] == 200 and b'"B"' not in body and b'"BS"' not in body:
        customized_response_dict.update(json.loads(body))
        response_dict["body"] = b"{}"


def starting_between(first_us: int | None, last_us: int | None) -> Keys:
    """The keys of batches that start between two times, both inclusive; None is open."""
    first, last = batches_between(first_us, last_us)
    return Keys({"S": first}, {"S": last}, first > last)


# The keys of all batches.
ALL = starting_between(None, None)


def with_samples_between(start_us: int | None, end_us: int | None) -> Keys:
    """The keys of batches that may hold samples from ``start_us`` to ``end_us`` (exclusive); None is open."""
    # A batch may start almost one batch length before its last sample.
    first_us = None if start_us is None else start_us - MAX_BATCH_SPAN_US + 1
    return starting_between(first_us, None if end_us is None else end_us - 1)


def seconds_between(first_s: int | None, last_s: int | None) -> Keys:
    """The keys of the summary's seconds between two, both inclusive; None is open."""
    first, last = _FIRST_S if first_s is None else first_s, _LAST_S if last_s is None else last_s
    return Keys({"N": str(first)}, {"N": str(last)}, first > last)


class TopicTable:
    """A table whose items have a topic, or another ``partition_key``, and a sort key. Reads are strongly
    consistent."""

    def __init__(self, client: Any, name: str, sort_key: str, partition_key: str = TOPIC) -> None:
        self._client, self.name = client, name
        self._sort_key, self._partition_key = sort_key, partition_key

    def pages(
        self,
        topic: str,
        keys: Keys | None = None,
        *,
        attributes: Sequence[str] = (),
        page_items: int | None = None,
        newest_first: bool = False,
        after: Mapping[str, Any] | None = None,
        scan: bool = False,
    ) -> Iterator[Page]:
        """Pages of a topic's items in the order of their keys; each page is read on demand.

        ``attributes`` are the ones to read; empty means all. ``page_items`` is the most items of a page.
        ``after`` continues after an earlier page. ``scan`` reads the whole table, in no order, and has
        DynamoDB drop the items of other topics.
        """
        if keys is not None and keys.empty:
            return
        names: dict[str, str] = {"#topic": self._partition_key}
        values: dict[str, Mapping[str, str]] = {":topic": {"S": topic}}
        condition = "#topic = :topic"
        if keys is not None:
            condition += " AND #key BETWEEN :first AND :last"
            names["#key"] = self._sort_key
            values.update({":first": keys.first, ":last": keys.last})
        request: dict[str, Any] = {
            "TableName": self.name,
            "ConsistentRead": True,
            "FilterExpression" if scan else "KeyConditionExpression": condition,
            "ExpressionAttributeNames": names,
            "ExpressionAttributeValues": values,
            **_projection(attributes, names),
        }
        if page_items is not None:
            request["Limit"] = page_items
        if newest_first:
            request["ScanIndexForward"] = False
        read = self._client.scan if scan else self._client.query
        if after is not None:
            request["ExclusiveStartKey"] = after
        while True:
            answer = read(**request)
            page = Page(answer["Items"], answer.get("LastEvaluatedKey"))
            yield page
            if page.after is None:
                return
            request["ExclusiveStartKey"] = page.after

    def first(self, topic: str, *, newest: bool = False, attributes: Sequence[str] = ()) -> Item | None:
        """The topic's oldest item, or its newest; None if the topic has none."""
        page = next(self.pages(topic, newest_first=newest, attributes=attributes, page_items=1))
        return page.items[0] if page.items else None

    def put(self, items: Iterable[Mapping[str, Any]]) -> None:
        """Write items; raises `TableError` if DynamoDB leaves some unwritten."""
        requests = ({"PutRequest": {"Item": item}} for item in items)
        while chunk := list(islice(requests, WRITE_ITEMS)):
            self._write(chunk)

    def _write(self, requests: Sequence[Mapping[str, Any]]) -> None:
        for attempt in range(_WRITE_ATTEMPTS):
            answer = self._client.batch_write_item(RequestItems={self.name: requests})
            requests = answer.get("UnprocessedItems", {}).get(self.name, [])
            if not requests:
                return
            # DynamoDB asks for exponential backoff before unprocessed items are sent again.
            time.sleep(0.02 * 2**attempt)
        raise TableError(f"{len(requests)} items of {self.name} not written after {_WRITE_ATTEMPTS} attempts")


class TelemetryTable(TopicTable):
    """The stored batches, by topic and batch id."""

    def __init__(self, client: Any, name: str) -> None:
        super().__init__(client, name, BATCH)

    def get(self, topic: str, batch: str, attributes: Sequence[str] = ()) -> Item | None:
        """A batch by its id; None if it is not stored, or has expired."""
        names: dict[str, str] = {}
        request: dict[str, Any] = _projection(attributes, names)
        if names:
            request["ExpressionAttributeNames"] = names
        key = {TOPIC: {"S": topic}, BATCH: {"S": batch}}
        answer = self._client.get_item(TableName=self.name, Key=key, ConsistentRead=True, **request)
        item: Item | None = answer.get("Item")
        return item


class SummaryTable(TopicTable):
    """The seconds that Lambda 2 has written, by topic and second."""

    def __init__(self, client: Any, name: str) -> None:
        super().__init__(client, name, SECOND)


def _projection(attributes: Sequence[str], names: dict[str, str]) -> dict[str, str]:
    """The request's entry that reads only ``attributes``; their placeholders are added to ``names``."""
    if not attributes:
        return {}
    # A placeholder each, since "samples" and others are reserved words.
    names.update({f"#a{i}": name for i, name in enumerate(attributes)})
    return {"ProjectionExpression": ", ".join(f"#a{i}" for i in range(len(attributes)))}


def plain(item: Mapping[str, Any]) -> dict[str, Any]:
    """An item as Python values. Numbers are Decimals of any length, which boto3's deserializer refuses."""
    return {name: deserialize(value) for name, value in item.items()}


def deserialize(attribute: Mapping[str, Any]) -> Any:
    """The value of an attribute such as ``{"N": "1.5"}``; raises `ContractError` for anything else."""
    try:
        ((kind, content),) = attribute.items()
        return _VALUES[kind](content)
    except (ArithmeticError, AttributeError, KeyError, RecursionError, TypeError, ValueError) as error:
        raise ContractError(f"attribute must be one of DynamoDB, got {shown(attribute)}") from error


def whole(item: Mapping[str, Any], name: str) -> int | None:
    """An item's attribute as an integer; None without it, and for anything else."""
    try:
        return integer(plain({name: item[name]}), name)
    except (ContractError, KeyError):
        return None


def _same(content: Any) -> Any:
    return content


def _text(content: Any) -> str:
    if not isinstance(content, str):
        raise TypeError
    return content


_VALUES: dict[str, Callable[[Any], Any]] = {
    "S": _text,
    "N": Decimal,
    "B": _same,
    "BOOL": _same,
    "NULL": lambda _: None,
    "M": plain,
    "L": lambda content: [deserialize(each) for each in content],
    "SS": set,
    "NS": lambda content: {Decimal(each) for each in content},
    "BS": set,
}
