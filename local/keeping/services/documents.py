"""The state of ministack's services as documents: one for each thing, queue, stack, parameter, ...

ministack can tell each service's state and take it back (`get_state`, `load_persisted_state`). It copies the
whole state deeply for that, which takes too long for every call; here it is read in place.
"""

from __future__ import annotations

import ast
import copy
import hashlib
import json
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from types import ModuleType
from typing import Any

from ministack.core import persistence
from ministack.core.responses import AccountRegionScopedDict, AccountScopedDict
from typing_extensions import Self

State = dict[str, Any]
_BY_REGION, _BY_ACCOUNT, _PLAIN, _VALUE = "region", "account", "plain", "value"
_SCOPED: dict[str, type[Any]] = {_BY_REGION: AccountRegionScopedDict, _BY_ACCOUNT: AccountScopedDict}
# Shorter binary values are part of their document.
_SHORT_BYTES = 1024
# Another thread may change a document while it is encoded.
_TRIES = 5


@dataclass(frozen=True)
class Document:
    """One entry of one store of a service."""

    store: str
    kind: str
    key: str
    text: str

    @classmethod
    def of(cls, store: str, kind: str, key: object, value: Any, keep_bytes: Callable[[bytes], str]) -> Self:
        """The document of an entry."""
        return cls(store, kind, repr(key), encode(value, keep_bytes))

    @property
    def digest(self) -> bytes:
        """Tells whether the text has changed."""
        return hashlib.blake2b(self.text.encode(), digest_size=16).digest()


class _InPlace(threading.local):
    """Whether this thread reads the state in place."""

    active = False


_in_place = _InPlace()


class _Copy:
    """The module `copy` as a service sees it: it copies nothing while this thread reads in place."""

    def __getattr__(self, name: str) -> Any:
        return getattr(copy, name)

    @staticmethod
    def deepcopy(value: Any, memo: Any = None) -> Any:
        return value if _in_place.active else copy.deepcopy(value, memo)


def read(module: ModuleType) -> State:
    """The state of a service as ministack saves it, in place: it must not be changed."""
    if vars(module).get("copy") is copy:
        vars(module)["copy"] = _Copy()
    _in_place.active = True
    try:
        return module.get_state() or {}
    finally:
        _in_place.active = False


def split(state: Mapping[str, Any], keep_bytes: Callable[[bytes], str]) -> Iterator[Document]:
    """The documents of a state; ``keep_bytes`` stores long binary values and returns their name."""
    for store, content in state.items():
        if isinstance(content, AccountRegionScopedDict):
            kind, entries = _BY_REGION, content._data
        elif isinstance(content, AccountScopedDict):
            kind, entries = _BY_ACCOUNT, content._data
        elif isinstance(content, dict):
            kind, entries = _PLAIN, content
        else:
            yield Document(store, _VALUE, "", encode(content, keep_bytes))
            continue
        for key, value in list(entries.items()):
            yield Document.of(store, kind, key, value, keep_bytes)


def join(rows: Iterator[tuple[str, str, str, str]], read_bytes: Callable[[str], bytes]) -> State:
    """The state of documents, as (store, kind, key, text)."""
    state: State = {}
    for store, kind, key, text in rows:
        value = decode(text, read_bytes)
        if kind == _VALUE:
            state[store] = value
        elif kind == _PLAIN:
            state.setdefault(store, {})[ast.literal_eval(key)] = value
        else:
            state.setdefault(store, _SCOPED[kind]())._data[ast.literal_eval(key)] = value
    return state


def encode(value: Any, keep_bytes: Callable[[bytes], str]) -> str:
    """JSON with ministack's own marks for other types; raises `TypeError` for a type without one."""

    def other(found: Any) -> Any:
        if isinstance(found, bytes) and len(found) > _SHORT_BYTES:
            return {"__kept__": keep_bytes(found)}
        if isinstance(found, datetime):
            return {"__datetime__": found.isoformat()}
        if isinstance(found, (set, frozenset)):
            return {"__set__": sorted(found)}
        return persistence._json_default(found)

    for _ in range(_TRIES - 1):
        with suppress(RuntimeError):
            return json.dumps(value, default=other)
    return json.dumps(value, default=other)


def decode(text: str, read_bytes: Callable[[str], bytes]) -> Any:
    """What `encode` has encoded."""

    def other(found: dict[str, Any]) -> Any:
        if "__kept__" in found:
            return read_bytes(found["__kept__"])
        if "__datetime__" in found:
            return datetime.fromisoformat(found["__datetime__"])
        if "__set__" in found:
            return set(found["__set__"])
        return persistence._json_object_hook(found)

    return json.loads(text, object_hook=other)
