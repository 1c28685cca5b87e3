"""The items of DynamoDB's tables, in the ledger instead of in memory."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, MutableMapping
from contextvars import ContextVar
from dataclasses import dataclass
from functools import wraps
from typing import Any, NamedTuple

from ministack.services import dynamodb

from local.keeping.ledger import Ledger
from local.keeping.places import place_of

Item = dict[str, Any]
Table = dict[str, Any]

_SCHEMA = """
CREATE TABLE IF NOT EXISTS tables (id INTEGER PRIMARY KEY, name TEXT UNIQUE NOT NULL, ttl TEXT);
CREATE TABLE IF NOT EXISTS items (
    id INTEGER PRIMARY KEY, tab INTEGER NOT NULL, pk TEXT NOT NULL, sk TEXT NOT NULL,
    text TEXT, expires_s REAL, size INTEGER NOT NULL, item TEXT NOT NULL);
CREATE UNIQUE INDEX IF NOT EXISTS items_key ON items (tab, pk, sk);
CREATE INDEX IF NOT EXISTS items_expires ON items (tab, expires_s) WHERE expires_s IS NOT NULL
"""
# What changes items. Each of its calls is one change of the ledger, with its records of the stream.
_WRITES = (
    "_put_item",
    "_update_item",
    "_delete_item",
    "_batch_write_item",
    "_transact_write_items",
    "_execute_statement",
    "_batch_execute_statement",
    "_execute_transaction",
)
# DynamoDB reads at most this for a page.
_PAGE_BYTES = 1024 * 1024
_encode = json.JSONEncoder(separators=(",", ":")).encode


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


class Tables:
    """All tables whose items are in the ledger."""

    def __init__(self, ledger: Ledger) -> None:
        self.ledger = ledger
        self._items: dict[str, Items] = {}
        self._written: tuple[Item, str] | None = None
        ledger.define(_SCHEMA)
        ledger.on_undo.append(self._undone)

    def install(self) -> None:
        """Let ministack keep its items here."""
        dynamodb._set_item = self._adopting(dynamodb._set_item)
        dynamodb._items_replaced = self._replacing(dynamodb._items_replaced)
        dynamodb.load_persisted_state = self._loading(dynamodb.load_persisted_state)
        dynamodb.drop_stream_records = self._dropping(dynamodb.drop_stream_records)
        dynamodb._expire_items = self.expire
        for name in _WRITES:
            setattr(dynamodb, name, together(self.ledger, getattr(dynamodb, name)))

    def adopt(self, table: Table) -> Items:
        """The table's items; those that it still has in memory are moved into the ledger."""
        held = table.get("items") or {}
        if isinstance(held, Items):
            return held
        name = f"{table['TableArn']} {table.get('TableId', '')}"
        with self.ledger.write() as connection:
            connection.execute("INSERT OR IGNORE INTO tables (name) VALUES (?)", (name,))
            ((number, ttl),) = connection.execute("SELECT id, ttl FROM tables WHERE name = ?", (name,))
            items = table["items"] = self._items[name] = Items(self, table, number, ttl)
            self._learn_ttl(items)
            for partition, bucket in held.items():
                for key, item in bucket.items():
                    items[partition][key] = item
        return items

    def encode(self, item: Item) -> str:
        """The item's JSON text; the last one is remembered, because its record of the stream follows."""
        if self._written is None or self._written[0] is not item:
            self._written = (item, _encode(item))
        return self._written[1]

    def expire(self, now_s: float) -> None:
        """Delete the items whose time to live has passed."""
        for items in list(self._items.values()):
            with self.ledger.write():
                self._learn_ttl(items)
                items.expire(now_s)
        self.ledger.commit()

    def _learn_ttl(self, items: Items) -> None:
        _, _, _, region, account, _ = items.table["TableArn"].split(":", 5)
        setting = dynamodb._ttl_settings.get_scoped(account, region, items.table["TableName"]) or {}
        enabled = setting.get("TimeToLiveStatus") == "ENABLED"
        items.expire_by(setting.get("AttributeName") if enabled else None)

    def _adopting(self, set_item: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(set_item)
        def keep(table: Table, *arguments: Any) -> Any:
            self.adopt(table)
            return set_item(table, *arguments)

        return keep

    def _replacing(self, replaced: Callable[..., Any]) -> Callable[..., Any]:
        """A transaction is undone, and a table restored, with a dictionary of all items."""

        @wraps(replaced)
        def adopt(table: Table) -> None:
            held = table["items"]
            if not isinstance(held, Items):
                with self.ledger.write():
                    table["items"] = {}
                    self.adopt(table).clear()
                    table["items"].update(held)
            replaced(table)

        return adopt

    def _loading(self, load: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(load)
        def loaded(data: Any) -> None:
            load(data)
            for table in dynamodb._tables.all_values():
                self.adopt(table)
                dynamodb._update_counts(table)

        return loaded

    def _dropping(self, drop: Callable[..., Any]) -> Callable[..., Any]:
        """The stream of a deleted table is dropped when the table is already forgotten."""

        @wraps(drop)
        def dropped(name: str, table: Table | None = None) -> None:
            drop(name, table)
            if table and dynamodb._tables.get(name) is not table and isinstance(table["items"], Items):
                del self._items[table["items"].delete()]

        return dropped

    def _undone(self) -> None:
        """What ministack counts and indexes itself is made anew."""
        self._written = None
        known = {name for (name,) in self.ledger.read("SELECT name FROM tables")}
        for name, items in list(self._items.items()):
            if name not in known:
                # Its first item was undone. The next one makes it known again.
                items.table["items"] = {}
                del self._items[name]
            items.table.pop(dynamodb._INDEX_MEMBERS, None)
            dynamodb._update_counts(items.table)


def together(ledger: Ledger, function: Callable[..., Any]) -> Callable[..., Any]:
    """The function as one change of the ledger."""

    @wraps(function)
    def change(*arguments: Any, **named: Any) -> Any:
        with ledger.write():
            return function(*arguments, **named)

    return change


class Items(MutableMapping[str, "Bucket"]):
    """A table's items by partition. As in ministack's own dictionary, a new partition is made when it is
    asked for."""

    def __init__(self, tables: Tables, table: Table, number: int, ttl: str | None) -> None:
        self.tables, self.table, self.number, self.ttl = tables, table, number, ttl
        self.ledger = tables.ledger
        sort = table.get("sk_name")
        self.kind: str = dynamodb._get_attr_type(table, sort) if sort else ""

    def __getitem__(self, partition: str) -> Bucket:
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
        rows = self.ledger.read("SELECT DISTINCT pk FROM items WHERE tab = ? ORDER BY pk", (self.number,))
        return iter([partition for (partition,) in rows])

    def __len__(self) -> int:
        ((count,),) = self.ledger.read("SELECT count(DISTINCT pk) FROM items WHERE tab = ?", (self.number,))
        return int(count)

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
            path = None if attribute is None else f"$.{_encode(attribute)}.N"
            connection.execute(
                "UPDATE items SET expires_s = CAST(json_extract(item, ?) AS REAL) WHERE tab = ?",
                (path, self.number),
            )
        self.ttl = attribute

    def expire(self, now_s: float) -> None:
        """Delete the items whose time to live has passed."""
        with self.ledger.write() as connection:
            done = connection.execute(
                "DELETE FROM items WHERE tab = ? AND expires_s <= ?", (self.number, now_s)
            )
        if done.rowcount:
            self.table.pop(dynamodb._INDEX_MEMBERS, None)
            self.table["ItemCount"] = max(0, self.table["ItemCount"] - done.rowcount)

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
            self.items_of.tables.encode(item),
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
        if shown is None or shown.partition != self._at(""):
            return [item for _, item in self.items()]
        return shown.items

    def show(self, wanted: Wanted, cursor: Mapping[str, Any] | None) -> Shown:
        """The items in the range in the order asked for: as many as a page may have, and one more."""
        sql, arguments = "", [self.items_of.number, self.partition]
        for bound, operator in ((wanted.low, ">"), (wanted.high, "<")):
            if bound is not None:
                sql += f" AND sk {operator}{'' if bound.open else '='} ?"
                arguments.append(bound.at)
        order = "" if wanted.forward else " DESC"
        sql = f"SELECT size, item FROM items WHERE tab = ? AND pk = ?{sql} ORDER BY sk{order} LIMIT ?"  # noqa: S608 - only operators are filled in
        texts, left = [], _PAGE_BYTES
        with self._ledger.reading() as connection:
            for size, text in connection.execute(
                sql, [*arguments, -1 if wanted.most is None else wanted.most]
            ):
                texts.append(text)
                left -= size
                if left < 0:
                    break
        return Shown(self._at(""), [json.loads(text) for text in texts], cursor)


@dataclass
class Shown:
    """The items that the running Query may see."""

    partition: tuple[int, str, str]
    items: list[Item]
    cursor: Mapping[str, Any] | None
    # The key condition is the same for all items, so that it is evaluated once.
    evaluated: bool = False


SHOWN: ContextVar[Shown | None] = ContextVar("shown", default=None)
