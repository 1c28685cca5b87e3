"""The embedded cloud's tables, as fast as a fleet needs them. Nothing that they answer is changed.

ministack sorts a whole partition for every Query and parses the key condition again for each of its items,
so a drive of five minutes made every read of it slower. Here a partition knows its order, and a Query is
shown the items that its key condition and its limit leave. It also takes every number of an item apart
several times; here only one that is not plain digits.
"""

from __future__ import annotations

import re
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from functools import lru_cache, wraps
from typing import Any, NamedTuple

from ministack.services import dynamodb

Item = dict[str, Any]
# Texts of numbers and expressions that are remembered.
_REMEMBERED = 16_384
# A number as DynamoDB gives it back, and short enough for any limit: nothing is to be changed or refused.
_PLAIN = re.compile(r"-?(?:0|[1-9][0-9]*)(?:\.[0-9]*[1-9])?")
_PLAIN_DIGITS = 30
_LOW, _HIGH = {"EQ", "GE", "GT"}, {"EQ", "LE", "LT"}


def install() -> None:
    """Close the gap in this process, before the emulator starts."""
    dynamodb._condition_syntax_error = lru_cache(_REMEMBERED)(dynamodb._condition_syntax_error)
    dynamodb._number_size_bytes = lru_cache(_REMEMBERED)(dynamodb._number_size_bytes)
    dynamodb._ddb_canonicalize_number = _plainly(dynamodb._ddb_canonicalize_number, lambda text: text)
    dynamodb._number_error = _plainly(dynamodb._number_error, lambda _: None)
    dynamodb._set_item = _ordering(dynamodb._set_item)
    dynamodb._query = narrowing(dynamodb._query)
    dynamodb._evaluate_condition = _evaluating(dynamodb._evaluate_condition)


# Of a sort key, as DynamoDB orders it: a number by its value, a text by its characters.
Place = Any


def _place(kind: str, text: str) -> Place:
    return Decimal(text) if kind == "N" else text


class Bound(NamedTuple):
    """An end of a range of sort keys; ``open``, it is not in the range itself."""

    at: Place
    open: bool = False


class Wanted(NamedTuple):
    """A range of sort keys, and how many of them from which end."""

    low: Bound | None
    high: Bound | None
    forward: bool
    most: int | None


class Partition(dict[str, Item]):
    """The items of one partition by the text of their sort key, which is of this kind; `between` knows its
    order."""

    def __init__(self, kind: str, items: Mapping[str, Item] | None = None) -> None:
        super().__init__(items or {})
        self.kind = kind
        self._order: list[Place] | None = None
        self._texts: list[str] = []

    def __setitem__(self, text: str, item: Item) -> None:
        if text not in self and self._order is not None:
            place = _place(self.kind, text)
            if not self._order or place > self._order[-1]:
                self._order.append(place)
                self._texts.append(text)
            else:
                self._order = None
        super().__setitem__(text, item)

    def __delitem__(self, text: str) -> None:
        self._order = None
        super().__delitem__(text)

    def pop(self, text: str, *default: Any) -> Any:
        """As a dictionary's."""
        self._order = None
        return super().pop(text, *default)

    def __reduce__(self) -> tuple[Any, ...]:
        # The emulator copies tables to keep and to restore them.
        return Partition, (self.kind, dict(self))

    def values(self) -> Iterable[Item]:  # type: ignore[override]  # a list, where a dict has a view
        """All items, or those that the Query that is running asks for."""
        shown = _shown.get()
        return super().values() if shown is None or shown.partition is not self else shown.items

    def between(self, wanted: Wanted) -> Sequence[Item]:
        """The items that are wanted, in order."""
        if self._order is None:
            pairs = sorted((_place(self.kind, text), text) for text in self)
            self._order, self._texts = [place for place, _ in pairs], [text for _, text in pairs]
        first, end = 0, len(self._order)
        if wanted.low is not None:
            first = (bisect_right if wanted.low.open else bisect_left)(self._order, wanted.low.at)
        if wanted.high is not None:
            end = (bisect_left if wanted.high.open else bisect_right)(self._order, wanted.high.at)
        if wanted.most is not None and wanted.forward:
            end = min(end, first + wanted.most)
        elif wanted.most is not None:
            first = max(first, end - wanted.most)
        return [self[text] for text in self._texts[first:end]]


@dataclass
class _Shown:
    """What the Query that is running may see; its condition is looked at once, not for every item."""

    partition: Partition
    items: Sequence[Item]
    cursor: Mapping[str, Any] | None
    looked_at: bool = False


_shown: ContextVar[_Shown | None] = ContextVar("shown", default=None)


def _ordering(set_item: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(set_item)
    def keep(table: Mapping[str, Any], partition: Any, place: str, item: Item) -> Any:
        items = table["items"]
        if partition not in items and (kind := _sorted_by(table)):
            items[partition] = Partition(kind)
        return set_item(table, partition, place, item)

    return keep


def _plainly(look: Callable[[Any], Any], answer: Callable[[str], Any]) -> Callable[[Any], Any]:
    @wraps(look)
    def number(text: Any) -> Any:
        plain = isinstance(text, str) and len(text) <= _PLAIN_DIGITS and _PLAIN.fullmatch(text)
        return answer(text) if plain and text != "-0" else look(text)

    return number


def _sorted_by(table: Mapping[str, Any]) -> str:
    """The kind of the table's sort key, if it is one whose order is known here."""
    name = table.get("sk_name")
    kind = dynamodb._get_attr_type(table, name) if name else ""
    return kind if kind in {"N", "S"} else ""


def narrowing(query: Callable[..., Any]) -> Callable[..., Any]:
    """A Query that looks only at items that it may answer."""

    @wraps(query)
    def narrowed(data: Mapping[str, Any]) -> Any:
        found = _asked(data)
        if found is None:
            return query(data)
        partition, wanted = found
        token = _shown.set(_Shown(partition, partition.between(wanted), data.get("ExclusiveStartKey")))
        try:
            return query(data)
        finally:
            _shown.reset(token)

    return narrowed


def _evaluating(evaluate: Callable[..., bool]) -> Callable[..., bool]:
    @wraps(evaluate)
    def condition(expression: str, item: Item, *rest: Any, slot: str = "ConditionExpression") -> bool:
        shown = _shown.get()
        if shown is None or slot != "KeyConditionExpression":
            return evaluate(expression, item, *rest, slot=slot)
        if shown.looked_at:
            return True
        # Looked at first, where there is one: it may be wrong.
        shown.looked_at = item is not shown.cursor
        return evaluate(expression, item, *rest, slot=slot)

    return condition


def _asked(data: Mapping[str, Any]) -> tuple[Partition, Wanted] | None:
    """The partition and range of a Query by key; None where ministack must look at it as a whole."""
    table = dynamodb._tables.get(dynamodb._normalize_table_name(data.get("TableName")))
    condition = data.get("KeyConditionExpression")
    if not table or not isinstance(condition, str) or data.get("IndexName") or data.get("KeyConditions"):
        return None
    try:
        conditions = _conditions(condition, data)
        compared, (value,) = conditions[table["pk_name"]]
        partition = table["items"].get(dynamodb._extract_key_val(value))
        if compared != "EQ" or not isinstance(partition, Partition):
            return None
        kind = partition.kind
        low, high = _range(kind, *conditions.get(table["sk_name"], ("", ())))
        most, cursor = data.get("Limit"), data.get("ExclusiveStartKey")
        forward = data.get("ScanIndexForward", True) is not False
        if cursor and forward:
            low = Bound(_place(kind, cursor[table["sk_name"]][kind]), open=True)
        elif cursor:
            high = Bound(_place(kind, cursor[table["sk_name"]][kind]), open=True)
        return partition, Wanted(low, high, forward, None if most is None else int(most) + 1)
    except (KeyError, TypeError, ValueError, AttributeError, InvalidOperation):
        return None


def _range(
    kind: str, compared: str, values: Sequence[Mapping[str, Any]]
) -> tuple[Bound | None, Bound | None]:
    places = [_place(kind, value[kind]) for value in values]
    if compared == "BETWEEN":
        return Bound(places[0]), Bound(places[1])
    low = Bound(places[0], compared == "GT") if compared in _LOW else None
    high = Bound(places[0], compared == "LT") if compared in _HIGH else None
    return low, high


def _conditions(condition: str, data: Mapping[str, Any]) -> dict[str, tuple[str, list[Any]]]:
    """Operator and values by attribute; raises `ValueError` for conditions that are not of this form."""
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
