"""A table's items, in the ledger instead of in memory."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, MutableMapping
from contextvars import ContextVar
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from typing import Any, NamedTuple

from ministack.services import dynamodb

from local.persistence.ledger import Ledger

# Sort keys as texts that SQLite orders as DynamoDB orders the keys.

# DynamoDB's numbers have exponents from -130 to 125.
_MIDDLE = 200
_NINES = str.maketrans("0123456789", "9876543210")


def place_of(kind: str, text: str) -> str:
    """A sort key's place: a number's by its value, a text's by its characters."""
    if kind != "N":
        return text
    if text.isdecimal() and text.isascii() and text[0] != "0":
        return f"2{len(text) - 1 + _MIDDLE}{text.rstrip('0')}"
    try:
        sign, digits, exponent = Decimal(text).as_tuple()
    except InvalidOperation:
        # No item has such a key.
        return text
    if not any(digits) or not isinstance(exponent, int):
        return "1"
    adjusted = exponent + len(digits) - 1
    coefficient = "".join(map(str, digits)).rstrip("0")
    if sign:
        # The larger the digits, the smaller the number; and so is one with more digits.
        return f"0{_MIDDLE * 2 - adjusted}{coefficient.translate(_NINES)}~"
    return f"2{adjusted + _MIDDLE}{coefficient}"


Item = dict[str, Any]
Table = dict[str, Any]

# A machine that was off for a month has millions of expired items.
_EXPIRED_ROWS = 500
# No partition has an empty key.
_SCANNED = ""
# Steps from partition to partition, where DISTINCT would read every key.
_PARTITIONS = """
WITH RECURSIVE one (pk) AS (
    SELECT min(pk) FROM items WHERE tab = ?1
    UNION ALL
    SELECT (SELECT min(pk) FROM items WHERE tab = ?1 AND pk > one.pk) FROM one WHERE one.pk IS NOT NULL)
SELECT pk FROM one WHERE pk IS NOT NULL
"""
# DynamoDB reads at most this for a page.
PAGE_BYTES = 1024 * 1024


class Bound(NamedTuple):
    """An end of a range of places; an ``open`` end is not in the range."""

    at: str
    open: bool = False


class Wanted(NamedTuple):
    """A range of sort keys, the direction, and the maximum number of items."""

    low: Bound | None
    high: Bound | None
    forward: bool
    most: int | None


class Items(MutableMapping[str, "Bucket"]):
    """A table's items by partition. As in ministack's own dictionary, a new partition is made when it is
    asked for."""

    def __init__(
        self, ledger: Ledger, encode: Callable[[Item], str], table: Table, number: int, ttl: str | None
    ) -> None:
        self.ledger, self.encode = ledger, encode
        self.table, self.number, self.ttl = table, number, ttl
        sort = table.get("sk_name")
        self.kind: str = dynamodb._get_attr_type(table, sort) if sort else ""

    def __getitem__(self, partition: str) -> Any:
        if partition == _SCANNED and (shown := self.scanned):
            return dict(enumerate(shown.items))
        return Bucket(self, partition)

    def get(self, partition: str, _default: Any = None) -> Bucket:
        """The partition."""
        return Bucket(self, partition)

    def setdefault(self, partition: str, _default: Any = None) -> Bucket:
        """The partition."""
        return Bucket(self, partition)

    def __setitem__(self, partition: str, bucket: Mapping[str, Item]) -> None:
        with self.ledger.write():
            del self[partition]
            self[partition].update(bucket)

    def __delitem__(self, partition: str) -> None:
        with self.ledger.write() as connection:
            connection.execute("DELETE FROM items WHERE tab = ? AND pk = ?", (self.number, partition))

    def __contains__(self, partition: object) -> bool:
        return bool(self[str(partition)])

    def __iter__(self) -> Iterator[str]:
        if self.scanned is not None:
            return iter([_SCANNED])
        return iter([partition for (partition,) in self.ledger.read(_PARTITIONS, (self.number,))])

    def __len__(self) -> int:
        return len(list(iter(self)))

    def count(self) -> int:
        """The number of items."""
        ((count,),) = self.ledger.read("SELECT count(*) FROM items WHERE tab = ?", (self.number,))
        return int(count)

    def texts(self, cursor: tuple[str, str] | None, most: int | None) -> list[tuple[int, str]]:
        """Sizes and JSON texts of the items after a partition and a sort key, in the order of their keys."""
        after = "" if cursor is None else " AND (pk, sk) > (?, ?)"
        place = () if cursor is None else (cursor[0], place_of(self.kind, cursor[1]))
        return self.page(f"1{after} ORDER BY pk, sk", place, most)

    def page(self, where: str, arguments: Iterable[Any], most: int | None) -> list[tuple[int, str]]:
        """Sizes and JSON texts: as many as a page may have, and one more."""
        sql = f"SELECT size, item FROM items WHERE tab = ? AND {where} LIMIT ?"  # noqa: S608 - our own words
        found, left = [], PAGE_BYTES
        with self.ledger.reading() as connection:
            for size, text in connection.execute(
                sql, (self.number, *arguments, -1 if most is None else most)
            ):
                found.append((size, text))
                left -= size
                if left < 0:
                    break
        return found

    @property
    def scanned(self) -> Shown | None:
        """What the running Scan of this table may see."""
        shown = SHOWN.get()
        return shown if shown is not None and shown.of == (self.number, _SCANNED) else None

    def __deepcopy__(self, _memo: Any) -> dict[str, Any]:
        """Nothing: ministack copies tables to save them, and the ledger has the items already."""
        return {}

    def clear(self) -> None:
        """Delete all items."""
        with self.ledger.write() as connection:
            connection.execute("DELETE FROM items WHERE tab = ?", (self.number,))

    def delete(self) -> str:
        """Delete all items, and the table; returns its name."""
        with self.ledger.write() as connection:
            self.clear()
            ((name,),) = connection.execute("DELETE FROM tables WHERE id = ? RETURNING name", (self.number,))
        return str(name)

    def expire_by(self, attribute: str | None) -> None:
        """Find the items' time to live in another attribute."""
        if attribute == self.ttl:
            return
        with self.ledger.write() as connection:
            connection.execute("UPDATE tables SET ttl = ? WHERE id = ?", (attribute, self.number))
            path = None if attribute is None else f"$.{json.dumps(attribute)}.N"
            connection.execute(
                "UPDATE items SET expires_s = CAST(json_extract(item, ?) AS REAL) WHERE tab = ?",
                (path, self.number),
            )
        self.ttl = attribute

    def expire(self, now_s: float) -> bool:
        """Delete some of the items whose time to live has passed; returns whether there may be more."""
        with self.ledger.write() as connection:
            done = connection.execute(
                "DELETE FROM items WHERE id IN"
                " (SELECT id FROM items WHERE tab = ? AND expires_s <= ? LIMIT ?)",
                (self.number, now_s, _EXPIRED_ROWS),
            )
        if done.rowcount:
            self.table.pop(dynamodb._INDEX_MEMBERS, None)
            self.table["ItemCount"] = max(0, self.table["ItemCount"] - done.rowcount)
        return done.rowcount == _EXPIRED_ROWS

    def expires_s(self, item: Item) -> float | None:
        """When the item's time to live passes."""
        value = item.get(self.ttl) if self.ttl else None
        try:
            return float(value["N"]) if value else None
        except (KeyError, TypeError, ValueError):
            return None


class Bucket(MutableMapping[str, Item]):
    """The items of one partition by the text of their sort key, in its order.

    Within a Query `values` gives what it asks for.
    """

    def __init__(self, items: Items, partition: str) -> None:
        self.items_of, self.partition = items, partition
        self.kind = items.kind
        self._ledger = items.ledger

    def _at(self, key: str) -> tuple[int, str, str]:
        return self.items_of.number, self.partition, place_of(self.kind, key)

    def __getitem__(self, key: str) -> Item:
        rows = self._ledger.read("SELECT item FROM items WHERE tab = ? AND pk = ? AND sk = ?", self._at(key))
        if not rows:
            raise KeyError(key)
        found: Item = json.loads(rows[0][0])
        return found

    def get(self, key: str, default: Any = None) -> Any:
        """The item of this key."""
        rows = self._ledger.read("SELECT item FROM items WHERE tab = ? AND pk = ? AND sk = ?", self._at(key))
        return json.loads(rows[0][0]) if rows else default

    def __setitem__(self, key: str, item: Item) -> None:
        place = self._at(key)
        values = (
            None if place[2] == key else key,
            self.items_of.expires_s(item),
            dynamodb._item_size_bytes(item),
            self.items_of.encode(item),
        )
        with self._ledger.write() as connection:
            connection.execute(
                "INSERT INTO items (tab, pk, sk, text, expires_s, size, item) VALUES (?, ?, ?, ?, ?, ?, ?)"
                " ON CONFLICT (tab, pk, sk) DO UPDATE SET text = excluded.text,"
                " expires_s = excluded.expires_s, size = excluded.size, item = excluded.item",
                (*place, *values),
            )

    def __delitem__(self, key: str) -> None:
        with self._ledger.write() as connection:
            connection.execute("DELETE FROM items WHERE tab = ? AND pk = ? AND sk = ?", self._at(key))

    def __contains__(self, key: object) -> bool:
        return bool(
            self._ledger.read("SELECT 1 FROM items WHERE tab = ? AND pk = ? AND sk = ?", self._at(str(key)))
        )

    def __bool__(self) -> bool:
        return bool(
            self._ledger.read(
                "SELECT 1 FROM items WHERE tab = ? AND pk = ? LIMIT 1", (self.items_of.number, self.partition)
            )
        )

    def __iter__(self) -> Iterator[str]:
        rows = self._ledger.read(
            "SELECT coalesce(text, sk) FROM items WHERE tab = ? AND pk = ? ORDER BY sk",
            (self.items_of.number, self.partition),
        )
        return iter([key for (key,) in rows])

    def __len__(self) -> int:
        ((count,),) = self._ledger.read(
            "SELECT count(*) FROM items WHERE tab = ? AND pk = ?", (self.items_of.number, self.partition)
        )
        return int(count)

    def __deepcopy__(self, _memo: Any) -> dict[str, Item]:
        return dict(self.items())

    def items(self) -> Any:
        """All keys and items."""
        rows = self._ledger.read(
            "SELECT coalesce(text, sk), item FROM items WHERE tab = ? AND pk = ? ORDER BY sk",
            (self.items_of.number, self.partition),
        )
        return [(key, json.loads(item)) for key, item in rows]

    def values(self) -> Any:
        """All items, or those that the running Query asks for."""
        shown = SHOWN.get()
        if shown is None or shown.of != (self.items_of.number, self.partition):
            return [item for _, item in self.items()]
        return shown.items

    def texts(self, wanted: Wanted) -> list[tuple[int, str]]:
        """Sizes and JSON texts of the items in the range, in the order asked for."""
        sql, arguments = "pk = ?", [self.partition]
        for bound, operator in ((wanted.low, ">"), (wanted.high, "<")):
            if bound is not None:
                sql += f" AND sk {operator}{'' if bound.open else '='} ?"
                arguments.append(bound.at)
        return self.items_of.page(
            f"{sql} ORDER BY sk{'' if wanted.forward else ' DESC'}", arguments, wanted.most
        )


@dataclass
class Shown:
    """The items of a table's partition, or of the whole table, that the running Query or Scan may see."""

    of: tuple[int, str]
    items: list[Item]
    cursor: Mapping[str, Any] | None
    # The key condition is the same for all items, so that it is evaluated once.
    evaluated: bool = False


SHOWN: ContextVar[Shown | None] = ContextVar("shown", default=None)
