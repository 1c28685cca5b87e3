"""Fixes of DynamoDB's reading: the time of a Query, of a Scan and of numbers."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from decimal import InvalidOperation
from functools import lru_cache, wraps
from typing import Any, NamedTuple

from ministack.services import dynamodb

from local.persistence.items import PAGE_BYTES, SHOWN, Bound, Bucket, Item, Items, Shown, Wanted, place_of

_REMEMBERED_CONDITIONS = 16_384
_OK, _NEXT = 200, "LastEvaluatedKey"
# ministack's sort key of a table without one.
_NO_SORT = "__no_sort__"
# With one of these an answer has not all items of the range as they are.
_PARTS = {
    "FilterExpression",
    "QueryFilter",
    "ScanFilter",
    "ProjectionExpression",
    "AttributesToGet",
    "Select",
}
_LOW, _HIGH = {"EQ", "GE", "GT"}, {"EQ", "LE", "LT"}


def close_query_time() -> None:
    """The time of a Query and of a Scan.

    AWS: stores a partition in the order of its sort key, so that a Query reads only what it returns
      (https://docs.aws.amazon.com/amazondynamodb/latest/developerguide/Query.html).
    ministack: sorts the whole partition for every Query and parses the key condition again for each item.
      Each Query took longer with every minute of a drive, as did each page of a Scan. The answers are the
      same, but a Scan's order, which AWS does not define. The items are in the ledger
      (local/persistence/items.py), which reads a range of keys; whole items go into the answer as they are.
    Test: tests/local/emulator/test_table_fixes.py::test_a_query_reads_only_the_requested_keys
    Patch: none; it needs another data structure for the items of a table
    """
    dynamodb._condition_syntax_error = lru_cache(_REMEMBERED_CONDITIONS)(dynamodb._condition_syntax_error)
    dynamodb._query = narrowing(dynamodb._query, asked)
    dynamodb._scan = narrowing(dynamodb._scan, scanned)
    dynamodb._apply_exclusive_start_key_scan = continuing(dynamodb._apply_exclusive_start_key_scan)
    dynamodb._evaluate_condition = evaluating(dynamodb._evaluate_condition)


class Found(NamedTuple):
    """Sizes and texts of the items that a call may return, and of which table and partition they are."""

    table: Mapping[str, Any]
    of: tuple[int, str]
    texts: Sequence[tuple[int, str]]


def narrowing(
    read: Callable[..., Any], found: Callable[[Mapping[str, Any]], Found | None]
) -> Callable[..., Any]:
    """A Query or Scan that looks only at items that it may return."""

    @wraps(read)
    def narrowed(data: Mapping[str, Any]) -> Any:
        wanted = found(data)
        if wanted is None:
            return read(data)
        # ministack checks the call with one item at least.
        whole = not _PARTS & data.keys() and len(wanted.texts) > 1
        items = [json.loads(text) for _, text in wanted.texts[: 1 if whole else None]]
        token = SHOWN.set(Shown(wanted.of, items, data.get("ExclusiveStartKey")))
        try:
            answer = read(data)
        finally:
            SHOWN.reset(token)
        return _whole(answer, wanted, data.get("Limit")) if whole and answer[0] == _OK else answer

    return narrowed


def _whole(answer: tuple[int, Any, bytes], wanted: Found, limit: Any) -> tuple[int, Any, bytes]:
    """The answer with these items, instead of the one that the call was checked with."""
    status, headers, body = answer
    size = 0
    page: list[str] = []
    for one, text in wanted.texts:
        if page and (size >= PAGE_BYTES or size + one > PAGE_BYTES or len(page) == limit):
            break
        page.append(text)
        size += one
    told = json.loads(body)
    del told["Items"]
    told.pop(_NEXT, None)
    told |= {"Count": len(page), "ScannedCount": len(page)}
    if len(page) < len(wanted.texts) or len(page) == limit or size >= PAGE_BYTES:
        keys = wanted.table["pk_name"], wanted.table["sk_name"]
        told[_NEXT] = dynamodb._build_key(json.loads(page[-1]), *keys)
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


def continuing(skip: Callable[..., Any]) -> Callable[..., Any]:
    """A Scan's cursor, which has skipped its items already."""

    @wraps(skip)
    def after(items: Any, *cursor: Any) -> Any:
        return skip(items, *cursor) if SHOWN.get() is None else items

    return after


def asked(data: Mapping[str, Any]) -> Found | None:
    """What a Query may return; None if ministack has to look at all items."""
    condition = data.get("KeyConditionExpression")
    items = _items(data)
    if items is None or not isinstance(condition, str) or data.get("KeyConditions"):
        return None
    table, kind = items.table, items.kind
    if kind not in {"N", "S"}:
        return None
    try:
        conditions = _conditions(condition, data)
        compared, (value,) = conditions[table["pk_name"]]
        if compared != "EQ":
            return None
        low, high = _range(kind, *conditions.get(table["sk_name"], ("", ())))
        cursor, forward = data.get("ExclusiveStartKey"), data.get("ScanIndexForward", True) is not False
        if cursor and forward:
            low = Bound(place_of(kind, cursor[table["sk_name"]][kind]), open=True)
        elif cursor:
            high = Bound(place_of(kind, cursor[table["sk_name"]][kind]), open=True)
        partition: Bucket = items[dynamodb._extract_key_val(value)]
        texts = partition.texts(Wanted(low, high, forward, _most(data)))
    except (KeyError, TypeError, ValueError, AttributeError, InvalidOperation):
        return None
    return Found(table, (items.number, partition.partition), texts)


def scanned(data: Mapping[str, Any]) -> Found | None:
    """What a Scan may return; None if ministack has to look at all items."""
    items = _items(data)
    if items is None or "Segment" in data or "TotalSegments" in data:
        return None
    table, cursor = items.table, data.get("ExclusiveStartKey")
    names = [name for name in (table["pk_name"], table["sk_name"]) if name]
    try:
        after = [dynamodb._extract_key_val(cursor[name]) for name in names] if cursor else []
        texts = items.texts(
            (after[0], after[-1] if len(after) > 1 else _NO_SORT) if after else None, _most(data)
        )
    except (KeyError, TypeError, ValueError, AttributeError):
        return None
    return Found(table, (items.number, ""), texts)


def _items(data: Mapping[str, Any]) -> Items | None:
    table = dynamodb._tables.get(dynamodb._normalize_table_name(data.get("TableName")))
    items = table["items"] if table and not data.get("IndexName") else None
    return items if isinstance(items, Items) else None


def _most(data: Mapping[str, Any]) -> int | None:
    return int(data["Limit"]) + 1 if data.get("Limit") is not None else None


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


_REMEMBERED_NUMBERS = 16_384
# A number in DynamoDB's own form, short enough for every limit: nothing has to be changed or refused.
_PLAIN = re.compile(r"-?(?:0|[1-9][0-9]*)(?:\.[0-9]*[1-9])?")
_PLAIN_DIGITS = 30


def close_number_checks() -> None:
    """The time that a number takes.

    AWS: does not apply; what it takes AWS to read a number does not show
      (https://docs.aws.amazon.com/amazondynamodb/latest/developerguide/HowItWorks.NamingRulesDataTypes.html).
    ministack: takes every number of an item apart several times. A batch has hundreds of them. Here plain
      digits pass at once, and the others are read as before.
    Test: tests/local/emulator/test_table_fixes.py::test_numbers_are_read_as_unpatched
    Patch: none; it is about speed only, so that upstream should measure it with its own load
    """
    dynamodb._number_size_bytes = lru_cache(_REMEMBERED_NUMBERS)(dynamodb._number_size_bytes)
    dynamodb._ddb_canonicalize_number = plainly(dynamodb._ddb_canonicalize_number, lambda text: text)
    dynamodb._number_error = plainly(dynamodb._number_error, lambda _: None)


def plainly(look: Callable[[Any], Any], answer: Callable[[str], Any]) -> Callable[[Any], Any]:
    """``look``, with the answer for plain digits given at once."""

    @wraps(look)
    def number(text: Any) -> Any:
        plain = isinstance(text, str) and len(text) <= _PLAIN_DIGITS and _PLAIN.fullmatch(text)
        return answer(text) if plain and text != "-0" else look(text)

    return number
