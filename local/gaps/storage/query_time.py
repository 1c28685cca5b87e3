"""The time of a Query.

AWS: stores a partition in the order of its sort key, so that a Query reads only what it returns
  (https://docs.aws.amazon.com/amazondynamodb/latest/developerguide/Query.html).
ministack: sorts the whole partition for every Query and parses the key condition again for each item. Each
  Query took longer with every minute of a drive. The answers are the same. The items are in the ledger
  (local/keeping/items.py), which reads a range of keys; whole items go into the answer as they are.
Test: tests/local/gaps/test_table_gap.py::test_a_query_reads_only_the_requested_keys
Patch: none; it needs another data structure for the items of a table
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from decimal import InvalidOperation
from functools import lru_cache, wraps
from typing import Any
from unittest.mock import Mock, patch

from ministack.core.responses import request_scope
from ministack.services import dynamodb

from local.keeping.items import PAGE_BYTES, SHOWN, Bound, Bucket, Item, Items, Wanted
from local.keeping.places import place_of

_REMEMBERED_CONDITIONS = 16_384
_OK, _NEXT = 200, "LastEvaluatedKey"
# With one of these an answer has not all items of the range as they are.
_PARTS = {"FilterExpression", "QueryFilter", "ProjectionExpression", "AttributesToGet", "Select"}
_LOW, _HIGH = {"EQ", "GE", "GT"}, {"EQ", "LE", "LT"}


def install() -> None:
    """Close the gap in this process."""
    dynamodb._condition_syntax_error = lru_cache(_REMEMBERED_CONDITIONS)(dynamodb._condition_syntax_error)
    dynamodb._query = narrowing(dynamodb._query)
    dynamodb._evaluate_condition = evaluating(dynamodb._evaluate_condition)


def is_open() -> bool:
    """Ask for one of ten items, and count how many are looked at."""
    name, key = "gaps-query-time", [("p", "HASH", "S"), ("t", "RANGE", "N")]
    with request_scope("000000000000", "eu-west-1"):
        dynamodb._create_table(
            {
                "TableName": name,
                "KeySchema": [{"AttributeName": n, "KeyType": k} for n, k, _ in key],
                "AttributeDefinitions": [{"AttributeName": n, "AttributeType": t} for n, _, t in key],
                "BillingMode": "PAY_PER_REQUEST",
            }
        )
        try:
            for n in range(10):
                dynamodb._put_item({"TableName": name, "Item": {"p": {"S": "p"}, "t": {"N": str(n)}}})
            condition = {"KeyConditionExpression": "p = :p", "ExpressionAttributeValues": {":p": {"S": "p"}}}
            evaluate = Mock(side_effect=dynamodb._evaluate_condition)
            with patch.object(dynamodb, "_evaluate_condition", evaluate):
                dynamodb._query({"TableName": name, "Limit": 1, **condition})
            return evaluate.call_count >= 10
        finally:
            dynamodb._delete_table({"TableName": name})


def narrowing(query: Callable[..., Any]) -> Callable[..., Any]:
    """A Query that looks only at items that it may return."""

    @wraps(query)
    def narrowed(data: Mapping[str, Any]) -> Any:
        found = asked(data)
        if found is None:
            return query(data)
        partition, wanted = found
        texts = partition.texts(wanted)
        # ministack checks the Query with one item at least.
        whole = not _PARTS & data.keys() and len(texts) > 1
        cursor = data.get("ExclusiveStartKey")
        token = SHOWN.set(partition.show([text for _, text in texts[: 1 if whole else None]], cursor))
        try:
            answer = query(data)
        finally:
            SHOWN.reset(token)
        return _whole(answer, partition, texts, data.get("Limit")) if whole and answer[0] == _OK else answer

    return narrowed


def _whole(
    answer: tuple[int, Any, bytes], partition: Bucket, texts: Sequence[tuple[int, str]], limit: Any
) -> tuple[int, Any, bytes]:
    """The answer to a Query with these items, instead of the one that it was checked with."""
    status, headers, body = answer
    size = 0
    page: list[str] = []
    for one, text in texts:
        if page and (size >= PAGE_BYTES or size + one > PAGE_BYTES or len(page) == limit):
            break
        page.append(text)
        size += one
    told = json.loads(body)
    del told["Items"]
    told.pop(_NEXT, None)
    told |= {"Count": len(page), "ScannedCount": len(page)}
    if len(page) < len(texts) or len(page) == limit or size >= PAGE_BYTES:
        table = partition.items_of.table
        told[_NEXT] = dynamodb._build_key(json.loads(page[-1]), table["pk_name"], table["sk_name"])
    rest = json.dumps(told, ensure_ascii=False)
    return status, headers, f'{{"Items": [{", ".join(page)}], {rest[1:]}'.encode()


def evaluating(evaluate: Callable[..., bool]) -> Callable[..., bool]:
    """An evaluation that looks at the key condition of a narrowed Query once."""

    @wraps(evaluate)
    def condition(expression: str, item: Item, *rest: Any, slot: str = "ConditionExpression") -> bool:
        shown = SHOWN.get()
        if shown is None or slot != "KeyConditionExpression":
            return evaluate(expression, item, *rest, slot=slot)
        if shown.evaluated:
            return True
        # A cursor is evaluated first, and may be wrong.
        shown.evaluated = item is not shown.cursor
        return evaluate(expression, item, *rest, slot=slot)

    return condition


def asked(data: Mapping[str, Any]) -> tuple[Bucket, Wanted] | None:
    """The partition and range of a Query; None if ministack has to look at all items."""
    table = dynamodb._tables.get(dynamodb._normalize_table_name(data.get("TableName")))
    condition = data.get("KeyConditionExpression")
    if not table or not isinstance(condition, str) or data.get("IndexName") or data.get("KeyConditions"):
        return None
    items = table["items"]
    if not isinstance(items, Items) or items.kind not in {"N", "S"}:
        return None
    try:
        conditions = _conditions(condition, data)
        compared, (value,) = conditions[table["pk_name"]]
        if compared != "EQ":
            return None
        partition, kind = items[dynamodb._extract_key_val(value)], items.kind
        low, high = _range(kind, *conditions.get(table["sk_name"], ("", ())))
        most, cursor = data.get("Limit"), data.get("ExclusiveStartKey")
        forward = data.get("ScanIndexForward", True) is not False
        if cursor and forward:
            low = Bound(place_of(kind, cursor[table["sk_name"]][kind]), open=True)
        elif cursor:
            high = Bound(place_of(kind, cursor[table["sk_name"]][kind]), open=True)
        return partition, Wanted(low, high, forward, None if most is None else int(most) + 1)
    except (KeyError, TypeError, ValueError, AttributeError, InvalidOperation):
        return None


def _range(
    kind: str, compared: str, values: Sequence[Mapping[str, Any]]
) -> tuple[Bound | None, Bound | None]:
    places = [place_of(kind, value[kind]) for value in values]
    if compared == "BETWEEN":
        return Bound(places[0]), Bound(places[1])
    low = Bound(places[0], compared == "GT") if compared in _LOW else None
    high = Bound(places[0], compared == "LT") if compared in _HIGH else None
    return low, high


def _conditions(condition: str, data: Mapping[str, Any]) -> dict[str, tuple[str, list[Any]]]:
    """Operator and values by attribute; raises `ValueError` for any other form of condition."""
    names, values = data.get("ExpressionAttributeNames") or {}, data["ExpressionAttributeValues"]
    found = {}
    for clause in dynamodb._key_condition_clauses(dynamodb._tokenize(condition)):
        kinds, texts = [kind for kind, _ in clause], [text for _, text in clause]
        name = names[texts[0]] if kinds[0] == "NAME_REF" else texts[0]
        if kinds[1:] == ["IDENT", "VALUE_REF", "IDENT", "VALUE_REF"] and texts[1].upper() == "BETWEEN":
            found[name] = ("BETWEEN", [values[texts[2]], values[texts[4]]])
        elif len(kinds) == 3 and kinds[1] in _LOW | _HIGH and kinds[2] == "VALUE_REF":
            found[name] = (kinds[1], [values[texts[2]]])
        else:
            raise ValueError(condition)
    return found
