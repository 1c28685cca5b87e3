"""A partition of a table that knows the order of its items."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from decimal import Decimal
from typing import Any, NamedTuple

Item = dict[str, Any]


# A sort key in DynamoDB's order: a number by its value, a text by its characters.
Place = Any


def place_of(kind: str, text: str) -> Place:
    """A sort key of this type, from its text."""
    return Decimal(text) if kind == "N" else text


class Bound(NamedTuple):
    """An end of a range of sort keys; an ``open`` end is not in the range."""

    at: Place
    open: bool = False


class Wanted(NamedTuple):
    """A range of sort keys, the direction, and the maximum number of items."""

    low: Bound | None
    high: Bound | None
    forward: bool
    most: int | None


class Partition(dict[str, Item]):
    """The items of one partition by the text of their sort key.

    It keeps them in order as long as they come in order. Within a Query `values` gives what it asks for.
    """

    def __init__(self, kind: str, items: Mapping[str, Item] | None = None) -> None:
        super().__init__(items or {})
        self.kind = kind
        self._order: list[Place] | None = None
        self._texts: list[str] = []

    def __setitem__(self, text: str, item: Item) -> None:
        if text not in self and self._order is not None:
            place = place_of(self.kind, text)
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
        """Remove an item, as a dictionary does."""
        self._order = None
        return super().pop(text, *default)

    def __reduce__(self) -> tuple[Any, ...]:
        # The emulator copies tables to keep and to restore them.
        return Partition, (self.kind, dict(self))

    def values(self) -> Iterable[Item]:  # type: ignore[override]  # a list, where a dict has a view
        """All items, or those that the running Query asks for."""
        shown = SHOWN.get()
        return super().values() if shown is None or shown.partition is not self else shown.items

    def between(self, wanted: Wanted) -> Sequence[Item]:
        """The items in the range, in order."""
        if self._order is None:
            pairs = sorted((place_of(self.kind, text), text) for text in self)
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
class Shown:
    """The part of a partition that the running Query may see."""

    partition: Partition
    items: Sequence[Item]
    cursor: Mapping[str, Any] | None
    # The key condition is the same for all items, so that it is evaluated once.
    evaluated: bool = False


SHOWN: ContextVar[Shown | None] = ContextVar("shown", default=None)
