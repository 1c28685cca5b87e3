"""What of each service's state is kept, where that differs from what ministack itself would save."""

from __future__ import annotations

import base64
from collections.abc import Callable
from types import ModuleType
from typing import Any

from ministack.core.responses import AccountRegionScopedDict
from ministack.services import cloudwatch_logs, dynamodb, iot, lambda_svc, scheduler, sqs, sts

from local.keeping.services import documents
from local.keeping.services.documents import State

# By module and store. The points of metrics and the results of log queries are lost.
_LEFT_OUT = {
    "cloudwatch": ("metrics", "alarm_history"),
    "cloudwatch_logs": ("log_records", "queries"),
    "iot": ("mqtt_broker",),
}


def read(module: ModuleType) -> State:
    """The state of a service, in place: it must not be changed."""
    name = module.__name__.rpartition(".")[2]
    own = _READ.get(name)
    state = own() if own else documents.read(module)
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
    state = documents.read(cloudwatch_logs)
    return state | {"log_groups": _without(state["log_groups"], "streams")}


def _tables() -> State:
    # items.py has the items, and counts them.
    left_out = "items", "ItemCount", "TableSizeBytes", dynamodb._INDEX_MEMBERS
    return documents.read(dynamodb) | {"tables": _without(dynamodb._tables, *left_out)}


def _queues() -> State:
    state = documents.read(sqs)
    return state | {"queues": _without(state["queues"], "messages")}


def _things() -> State:
    kept = {topic: retained(message) for topic, message in list(iot._retained.items())}
    return documents.read(iot) | {"retained": kept}


def _schedules() -> State:
    return documents.read(scheduler) | {"last_fired": scheduler._schedule_last_fired}


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
