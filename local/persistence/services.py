"""Keeps the state of ministack's services in the ledger: stacks, roles, functions, things, parameters, ...

A call that may change a service writes its documents before it is answered (gate.py); a failed write is the
call's answer. A deployment is kept when it is complete, so that no stack is half made after a restart. What
changes without a call, such as an alarm's state, is written within seconds.

Elsewhere: items and streams of tables (items.py, streams.py), messages (queues.py), objects (objects.py).
Points of metrics and lines of logs are not kept."""

from __future__ import annotations

import hashlib
import logging
import sys
import threading
from collections.abc import Awaitable, Callable
from functools import wraps
from typing import Any

from ministack import app
from ministack.core.responses import get_account_id, get_region
from ministack.services import cloudformation, iot

from local.persistence import documents
from local.persistence.documents import Document
from local.persistence.ledger import Ledger, LedgerError

_log = logging.getLogger(__name__)
Response = tuple[int, dict[str, str], bytes]
Handler = Callable[[str, str, dict[str, str], bytes, dict[str, list[str]]], Awaitable[Response]]

_TICK_S = 5.0
_SCHEMA = """
CREATE TABLE IF NOT EXISTS documents (
    service TEXT, store TEXT, key TEXT, kind TEXT, digest BLOB, text TEXT, UNIQUE (service, store, key));
CREATE TABLE IF NOT EXISTS blobs (name TEXT PRIMARY KEY, bytes BLOB)
"""
_INSERT = """
INSERT INTO documents (service, store, key, kind, digest, text) VALUES (?, ?, ?, ?, ?, ?)
ON CONFLICT DO UPDATE SET kind = excluded.kind, digest = excluded.digest, text = excluded.text
"""
_DELETE = "DELETE FROM documents WHERE service = ? AND store = ? AND key = ?"
_NO_DOCUMENTS = ("dynamodb_streams", "iot_data")


class Services:
    """The documents of every loaded service."""

    def __init__(self, ledger: Ledger) -> None:
        self._ledger = ledger
        self._lock = threading.Lock()
        self._deploying = False
        self._interrupted: list[documents.Key] = []
        ledger.define(_SCHEMA)
        ledger.on_undo.append(self._undone)

    def install(self) -> None:
        """Load the state when the emulator starts, and write it from then on."""
        app.PERSIST_STATE = True
        app._load_persisted_state = self.load
        app.save_all = lambda _states: self._save_later()
        for name, handler in app.SERVICE_HANDLERS.items():
            app.SERVICE_HANDLERS[name] = self._kept(app.SERVICE_REGISTRY[name]["module"], handler)
        iot.update_thing_shadow = self._keeping_shadow(iot.update_thing_shadow)
        iot.delete_thing_shadow = self._keeping_shadow(iot.delete_thing_shadow)
        iot._fleet_provisioning_reply = self._keeping_things(iot._fleet_provisioning_reply)
        iot._retained = Retained(self)

    def load(self) -> None:
        """Give every service its state back."""
        services = {row[0] for row in self._ledger.read("SELECT DISTINCT service FROM documents")}
        # The functions last: their streams and queues are read at once.
        for service in sorted(services, key=lambda name: (name == "lambda_svc", name)):
            rows = self._ledger.read(
                "SELECT store, kind, key, text FROM documents WHERE service = ? ORDER BY rowid", (service,)
            )
            state = documents.join(iter(rows), self._bytes)
            if service == "stepfunctions":
                self._interrupted = documents.running(state)
            documents.load(app._get_module(service), state)
        self._drop_blobs()
        threading.Thread(target=self._tick, daemon=True, name="keeping").start()

    def _undone(self) -> None:
        # A deployment may be among what is not written any more.
        self._deploying = True

    def go_on(self) -> None:
        """Begin anew what was interrupted."""
        documents.begin_anew(self._interrupted)

    def save(self, service: str) -> None:
        """Write the documents of a service that have changed. Raises `LedgerError`."""
        with self._lock:
            self._save(service)

    def save_all(self) -> None:
        """Write what has changed in any service, unless a deployment is under way."""
        if _deploying():
            return
        with self._lock:
            services = _services()
            if not self._deploying:
                # Its documents are large, and change with a deployment only.
                services.discard("cloudformation")
            for service in sorted(services):
                self._save(service)
            self._deploying = False

    def put(self, service: str, document: Document) -> None:
        """Write one document."""
        with self._ledger.write() as connection:
            connection.execute(_INSERT, _row(service, document))

    def remove(self, service: str, store: str, key: object) -> None:
        """Delete one document."""
        with self._ledger.write() as connection:
            connection.execute(_DELETE, (service, store, repr(key)))

    def _save(self, service: str) -> None:
        rows = self._ledger.read("SELECT store, key, digest FROM documents WHERE service = ?", (service,))
        saved = {(store, key): digest for store, key, digest in rows}
        state = documents.read_states(sys.modules[_name(service)])
        with self._ledger.write() as connection:
            for one in documents.split(state, self._keep_bytes):
                if saved.pop((one.store, one.key), None) != one.digest:
                    connection.execute(_INSERT, _row(service, one))
            connection.executemany(_DELETE, [(service, store, key) for store, key in saved])

    def _keep_bytes(self, content: bytes) -> str:
        name = hashlib.sha256(content).hexdigest()
        if not self._ledger.read("SELECT 1 FROM blobs WHERE name = ?", (name,)):
            with self._ledger.write() as connection:
                connection.execute("INSERT INTO blobs VALUES (?, ?)", (name, content))
        return name

    def _bytes(self, name: str) -> bytes:
        [(content,)] = self._ledger.read("SELECT bytes FROM blobs WHERE name = ?", (name,))
        return bytes(content)

    def _drop_blobs(self) -> None:
        """Delete the code of functions that a deployment has replaced."""
        with self._ledger.write() as connection:
            connection.execute(
                "DELETE FROM blobs WHERE NOT EXISTS (SELECT 1 FROM documents WHERE instr(text, name) > 0)"
            )

    def _kept(self, service: str, handler: Handler) -> Handler:
        @wraps(handler)
        async def handle(
            method: str, path: str, headers: dict[str, str], body: bytes, query: dict[str, list[str]]
        ) -> Response:
            answer = await handler(method, path, headers, body, query)
            if service == "cloudformation":
                self._deploying = self._deploying or documents.may_change(method, path, headers, body, query)
                if self._deploying:
                    self.save_all()
            elif (
                service not in _NO_DOCUMENTS
                and not (service == "s3" and documents.is_object(path))
                and documents.may_change(method, path, headers, body, query)
            ):
                self.save(service)
            return answer

        return handle

    def _keeping_shadow(self, change: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(change)
        def kept(thing: str, shadow: str, *rest: Any) -> Any:
            answer = change(thing, shadow, *rest)
            if (value := iot._shadows.get((thing, shadow))) is not None:
                key = (get_account_id(), get_region(), (thing, shadow))
                self.put("iot", Document.of("shadows", "region", key, value, self._keep_bytes))
            return answer

        return kept

    def _keeping_things(self, provision: Callable[..., Awaitable[Any]]) -> Callable[..., Awaitable[Any]]:
        @wraps(provision)
        async def kept(*arguments: Any) -> Any:
            answer = await provision(*arguments)
            self.save("iot")
            return answer

        return kept

    def _tick(self) -> None:
        pause = threading.Event()
        while not pause.wait(_TICK_S):
            self._save_later()

    def _save_later(self) -> None:
        try:
            documents.forget_old()
            self.save_all()
            self._ledger.commit()
        except LedgerError as error:
            _log.warning("changes that no call made are written later: %s", error)
        except Exception:  # noqa: BLE001 - the thread has to write later changes
            _log.exception("changes that no call made are not written")


class Retained(dict[str, Any]):
    """The broker's retained messages, by topic."""

    def __init__(self, services: Services) -> None:
        super().__init__()
        self._services = services

    def __setitem__(self, topic: str, message: Any) -> None:
        super().__setitem__(topic, message)
        document = documents.retained(message)
        self._services.put("iot", Document.of("retained", "plain", topic, document, lambda _: ""))

    def __delitem__(self, topic: str) -> None:
        super().__delitem__(topic)
        self._services.remove("iot", "retained", topic)

    def pop(self, topic: str, *default: Any) -> Any:
        """Also a message that is not there is removed."""
        self._services.remove("iot", "retained", topic)
        return super().pop(topic, *default)


def _row(service: str, one: Document) -> tuple[str, str, str, str, bytes, str]:
    return service, one.store, one.key, one.kind, one.digest, one.text


def _name(service: str) -> str:
    return f"ministack.services.{service}"


def _services() -> set[str]:
    """The names of the loaded modules that may have state."""
    loaded = {name for name in app._state_map.values() if hasattr(sys.modules.get(_name(name)), "get_state")}
    return loaded.difference(_NO_DOCUMENTS)


def _deploying() -> bool:
    """Whether CloudFormation works on a stack. A stack under review has only been planned."""
    states_ = {stack.get("StackStatus", "") for stack in cloudformation._stacks.all_values()}
    return any(one.endswith("_IN_PROGRESS") for one in states_ - {"REVIEW_IN_PROGRESS"})
