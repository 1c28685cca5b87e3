"""Keeps S3's objects as files, in ministack's own layout.

ministack logs a failed write and answers that the object is stored. Here the call fails, and the object is
what it was.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

from ministack.services import s3

from local.keeping.ledger import Ledger, LedgerError

_SIDECAR, _UNFINISHED = ".meta.json", ".tmp"
_FAILED = "Failed to "


def install(ledger: Ledger) -> None:
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
