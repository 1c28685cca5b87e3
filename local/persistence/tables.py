"""Puts the items of every table of DynamoDB into the ledger, and keeps S3's objects as files beside it."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import time
from collections.abc import Callable
from functools import partial, wraps
from pathlib import Path
from typing import Any

from ministack.services import dynamodb, s3

from local.persistence.items import Item, Items, Table
from local.persistence.ledger import Ledger, LedgerError

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
_PAUSE_S = 0.01
_encode = json.JSONEncoder(separators=(",", ":")).encode


class Tables:
    """All tables whose items are in the ledger."""

    def __init__(self, ledger: Ledger) -> None:
        self.ledger = ledger
        self._items: dict[str, Items] = {}
        self._written: tuple[Item, str] | None = None
        self._miscounted = False
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
        held = table.get("items")
        if isinstance(held, Items):
            return held
        name = f"{table['TableArn']} {table.get('TableId', '')}"
        with self.ledger.write() as connection:
            connection.execute("INSERT OR IGNORE INTO tables (name) VALUES (?)", (name,))
            ((number, ttl),) = connection.execute("SELECT id, ttl FROM tables WHERE name = ?", (name,))
            items = table["items"] = self._items[name] = Items(self.ledger, self.encode, table, number, ttl)
            self._learn_ttl(items)
            for partition, bucket in (held or {}).items():
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
                if self._miscounted:
                    self._count(items.table)
            gently(self.ledger, partial(items.expire, now_s))
        self._miscounted = False

    @staticmethod
    def _count(table: Table) -> None:
        """AWS, too, counts items now and then."""
        table["ItemCount"] = table["items"].count()
        table["TableSizeBytes"] = table["ItemCount"] * 200

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
                self._count(table)

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
        self._miscounted = True


def gently(ledger: Ledger, delete: Callable[[], bool]) -> None:
    """Delete a little at a time until nothing is left to delete; others write in between."""
    while delete():
        ledger.commit()
        time.sleep(_PAUSE_S)
    ledger.commit()


def together(ledger: Ledger, function: Callable[..., Any]) -> Callable[..., Any]:
    """The function as one change of the ledger."""

    @wraps(function)
    def change(*arguments: Any, **named: Any) -> Any:
        with ledger.write():
            return function(*arguments, **named)

    return change


# Keeps S3's objects as files, in ministack's own layout.
#
# ministack logs a failed write and answers that the object is stored. Here the call fails, and the object is
# what it was.

_SIDECAR, _UNFINISHED = ".meta.json", ".tmp"
_FAILED = "Failed to "


def install_objects(ledger: Ledger) -> None:
    """Keep the objects from now on, as safely as the ledger keeps its rows."""
    s3.logger.addFilter(_raise)
    for unfinished in Path(s3.DATA_DIR).rglob(f"*{_UNFINISHED}"):
        unfinished.unlink()
    s3.S3_PERSIST = True
    s3._load_persisted_data()
    files = _Files(ledger)
    for (account, bucket), content in s3._buckets._data.items():
        for key, found in content["objects"].items():
            files.complete(account, bucket, key, found)
    s3._persist_object = files.persist
    for name in ("_put_object", "_copy_object", "_complete_multipart_upload"):
        setattr(s3, name, _restoring(getattr(s3, name)))


class _Files:
    """The files of objects: one with the bytes and one, the sidecar, that describes them."""

    def __init__(self, ledger: Ledger) -> None:
        self._ledger = ledger

    def persist(self, bucket: str, key: str, found: dict[str, Any]) -> None:
        """Write an object's files, both or none. Raises `OSError` or `LedgerError`."""
        self._ledger.check_room()
        path = Path(s3._object_disk_path(bucket, key))
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        sidecar = s3._object_meta_from_record(found) | s3._key_history_meta(bucket, key)
        written = {_sidecar(path): json.dumps(sidecar | {"key": key}).encode()}
        # An object whose bytes are in their file already has none in memory.
        if found.get("body") is not None:
            written = {path: found["body"]} | written
        self._write(written)
        found["body"] = None
        root = os.path.join(s3.DATA_DIR, s3.get_account_id(), bucket)  # noqa: PTH118 - as ministack
        s3._remove_key_files(s3._other_key_disk_path(root, key, str(path)))

    def complete(self, account: str, bucket: str, key: str, found: dict[str, Any]) -> None:
        """Describe the bytes anew if the emulator ended between the two files."""
        path = Path(s3._object_disk_path(bucket, key, account))
        sidecar = _sidecar(path)
        if not sidecar.exists() or sidecar.stat().st_mtime_ns >= path.stat().st_mtime_ns:
            return
        md5 = hashlib.md5(path.read_bytes(), usedforsecurity=False)
        found |= {"size": path.stat().st_size, "etag": f'"{md5.hexdigest()}"', "checksums": {}}
        described = json.loads(sidecar.read_bytes()) | s3._object_meta_from_record(found)
        self._write({sidecar: json.dumps(described).encode()})

    def _write(self, contents: dict[Path, bytes]) -> None:
        unfinished = {path: path.with_name(path.name + _UNFINISHED) for path in contents}
        try:
            for path, content in contents.items():
                unfinished[path].touch(mode=0o600)
                unfinished[path].write_bytes(content)
                self._sync(unfinished[path])
        except OSError:
            for temporary in unfinished.values():
                temporary.unlink(missing_ok=True)
            raise
        for path, temporary in unfinished.items():
            temporary.rename(path)
        # A new folder is in the one above it.
        root = Path(s3.DATA_DIR)
        for folder in {above for path in contents for above in path.parents if above.is_relative_to(root)}:
            self._sync(folder)

    def _sync(self, path: Path) -> None:
        """Wait for the disk, if a power cut must not lose anything."""
        if self._ledger.sync != "full":
            return
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _sidecar(path: Path) -> Path:
    return path.with_name(path.name + _SIDECAR)


def _restoring(write: Callable[..., Any]) -> Callable[..., Any]:
    """A write of an object that leaves the object as it was if it fails."""

    @wraps(write)
    def written(bucket: str, key: str, *rest: Any, **options: Any) -> Any:
        objects = (s3._buckets.get(bucket) or {"objects": {}})["objects"]
        before = objects.get(key)
        try:
            return write(bucket, key, *rest, **options)
        except (OSError, LedgerError):
            objects.pop(key, None)
            if before is not None:
                objects[key] = before
            raise

    return written


def _raise(record: logging.LogRecord) -> bool:
    """Raise what ministack would only log."""
    if isinstance(record.msg, str) and record.msg.startswith(_FAILED):
        raise OSError(record.getMessage())
    return True
