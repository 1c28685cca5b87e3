"""The state of ministack's services as documents: one for each thing, queue, stack, parameter, ...

ministack can tell each service's state and take it back (`get_state`, `load_persisted_state`). It copies the
whole state deeply for that, which takes too long for every call; here it is read in place."""

from __future__ import annotations

import ast
import base64
import contextvars
import copy
import hashlib
import json
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from types import ModuleType
from typing import Any
from urllib.parse import parse_qs

from ministack.core import persistence
from ministack.core.responses import AccountRegionScopedDict, AccountScopedDict, request_scope
from ministack.services import cloudwatch_logs, dynamodb, iot, lambda_svc, scheduler, sqs, stepfunctions, sts
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


# What of each service's state is kept, where that differs from what ministack itself would save.

# By module and store. The points of metrics and the results of log queries are lost.
_LEFT_OUT = {
    "cloudwatch": ("metrics", "alarm_history"),
    "cloudwatch_logs": ("log_records", "queries"),
    "iot": ("mqtt_broker",),
}


def read_states(module: ModuleType) -> State:
    """The state of a service, in place: it must not be changed."""
    name = module.__name__.rpartition(".")[2]
    own = _READ.get(name)
    state = own() if own else read(module)
    return {store: content for store, content in state.items() if store not in _LEFT_OUT.get(name, ())}


def load(module: ModuleType, state: State) -> None:
    """Give a service its state back."""
    own = _LOAD.get(module.__name__.rpartition(".")[2])
    if own:
        own(state)
    module.load_persisted_state(state)


def retained(message: Any) -> dict[str, Any]:
    """A retained message of the broker, as ministack saves it."""
    return {
        "topic": message.topic,
        "payload": base64.b64encode(message.payload).decode(),
        "qos": message.qos,
        "properties": base64.b64encode(message.properties).decode(),
        "ts": message.ts,
    }


def _functions() -> State:
    # ministack would write their code into files here.
    return {
        "functions": lambda_svc._functions,
        "layers": lambda_svc._layers,
        "esms": lambda_svc._esms,
        "function_urls": lambda_svc._function_urls,
    }


def _logs() -> State:
    state = read(cloudwatch_logs)
    return state | {"log_groups": _without(state["log_groups"], "streams")}


def _tables() -> State:
    # items.py has the items, and counts them.
    left_out = "items", "ItemCount", "TableSizeBytes", dynamodb._INDEX_MEMBERS
    return read(dynamodb) | {"tables": _without(dynamodb._tables, *left_out)}


def _queues() -> State:
    state = read(sqs)
    return state | {"queues": _without(state["queues"], "messages")}


def _things() -> State:
    kept = {topic: retained(message) for topic, message in list(iot._retained.items())}
    return read(iot) | {"retained": kept}


def _schedules() -> State:
    return read(scheduler) | {"last_fired": scheduler._schedule_last_fired}


def _sessions() -> State:
    return {"sessions": sts._sessions}


def _without(store: AccountRegionScopedDict, *names: str) -> AccountRegionScopedDict:
    """The store's entries without some of their keys."""
    shortened = AccountRegionScopedDict()
    for key, entry in store.all_items():
        shortened._data[key] = {each: value for each, value in entry.items() if each not in names}
    return shortened


def _load_logs(state: State) -> None:
    for group in state["log_groups"].all_values():
        group["streams"] = {}


def _load_queues(state: State) -> None:
    for queue in state["queues"].all_values():
        queue["messages"] = []


def _load_things(state: State) -> None:
    messages = list(state.pop("retained", {}).values())
    state["mqtt_broker"] = {"region_scoped": True, "retained": messages}


def _load_schedules(state: State) -> None:
    scheduler._schedule_last_fired.update(state.pop("last_fired", {}))


def _load_sessions(state: State) -> None:
    sts._sessions.update(state.pop("sessions", {}))


_READ: dict[str, Callable[[], State]] = {
    "cloudwatch_logs": _logs,
    "dynamodb": _tables,
    "iot": _things,
    "lambda_svc": _functions,
    "scheduler": _schedules,
    "sqs": _queues,
    "sts": _sessions,
}
_LOAD: dict[str, Callable[[State], None]] = {
    "cloudwatch_logs": _load_logs,
    "iot": _load_things,
    "scheduler": _load_schedules,
    "sqs": _load_queues,
    "sts": _load_sessions,
}


# Executions of state machines: those that the emulator's end interrupted, and those that ended long ago.
#
# AWS has no such end, and forgets an execution after 90 days. ministack marks interrupted ones as failed
# after a restart, and forgets none; here they begin anew, as after a retry.

Key = tuple[str, str, str]
# A distributed map has hundreds of children a night, which nobody asks for later.
_KEPT_S, _CHILD_KEPT_S = 90 * 86_400, 86_400


def running(state: State) -> list[Key]:
    """The account, the region and the name of each execution that a kept state has as running, but for a
    map's children: the map makes others."""
    executions = state.get("executions")
    if executions is None:
        return []
    return [
        key for key, one in executions.all_items() if one["status"] == "RUNNING" and not one.get("mapRunArn")
    ]


def begin_anew(keys: Sequence[Key]) -> None:
    """Run these executions from their first state."""
    for account, region, name in keys:
        one: dict[str, Any] = stepfunctions._executions.get_scoped(account, region, name)
        one |= {"status": "RUNNING", "stopDate": None, "events": one["events"][:1], "mockAttempts": {}}
        one.pop("error", None)
        one.pop("cause", None)
        with request_scope(account, region):
            context = contextvars.copy_context()
        threading.Thread(target=context.run, args=(stepfunctions._run_execution, name), daemon=True).start()


def forget_old() -> None:
    """Delete the executions that ended long ago."""
    for key, one in stepfunctions._executions.all_items():
        kept_s = _CHILD_KEPT_S if one.get("mapRunArn") else _KEPT_S
        if one.get("stopDate") and time.time() - _seconds(one["stopDate"]) > kept_s:
            stepfunctions._executions._data.pop(key, None)


def _seconds(text: str) -> float:
    return datetime.fromisoformat(text.replace("Z", "+00:00")).timestamp()


# Which calls to a service may change its documents.

# An action whose name begins like this changes nothing that has to be kept before it is answered.
_READS = (
    "Get",
    "List",
    "Describe",
    "Search",
    "Lookup",
    "Simulate",
    "Test",
    "Head",
    "BatchGet",
    "Query",
    "Scan",
)
# Frequent actions on what is in no document: metrics, logs, messages and items.
_DATA = (
    "PutMetricData",
    "PutLogEvents",
    "SendMessage",
    "ReceiveMessage",
    "DeleteMessage",
    "ChangeMessageVis",
    "PutItem",
    "UpdateItem",
    "DeleteItem",
    "BatchWriteItem",
    "Transact",
    "ExecuteStatement",
    "BatchExecute",
    "ExecuteTransaction",
)
_FORM = "application/x-www-form-urlencoded"


def may_change(
    method: str, path: str, headers: Mapping[str, str], body: bytes, query: Mapping[str, list[str]]
) -> bool:
    """Whether a call may change its service's documents, by the name of its action or else by its method."""
    if action := _action(path, headers, body, query):
        return not action.startswith((*_READS, *_DATA))
    return method not in ("GET", "HEAD", "OPTIONS") and not path.endswith("/invocations")


def is_object(path: str) -> bool:
    """Whether a path of S3 names an object, which is a file, rather than a bucket."""
    return "/" in path.strip("/")


def _action(path: str, headers: Mapping[str, str], body: bytes, query: Mapping[str, list[str]]) -> str:
    """The action's name in one of AWS' protocols; "" for REST."""
    if target := headers.get("x-amz-target"):
        return target.rpartition(".")[2]
    if path.startswith("/service/"):
        return path.rpartition("/")[2]
    form = query
    if headers.get("content-type", "").startswith(_FORM):
        form = {**query, **parse_qs(body.decode(errors="replace"))}
    return next(iter(form.get("Action", ())), "")
