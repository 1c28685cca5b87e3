"""Queues that lose nothing: one thread at a time puts a message in, takes some out or sorts them.

ministack keeps a queue's messages in a list. Whoever removes some (a receive that sweeps expired messages
and dead letters, a delete) makes a new list of the others and puts it in the old one's place; whoever sends
appends to the list that is there, in another thread and without the lock that two of the removers hold. A
message that is appended between the two is in the old list, and nowhere else. Here all of them hold that
lock; what was one step for a caller, sweep and receive, stays as it was.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

from ministack.services import lambda_svc, sqs

_Call = TypeVar("_Call", bound=Callable[..., Any])
# What in sqs.py changes a queue's list or a message's state by itself. A receive waits between its steps
# for messages to come, so that its steps are named and not itself.
STEPS = (
    "_act_send_message",
    "_act_send_message_batch",
    "_act_delete_message",
    "_act_delete_message_batch",
    "_act_change_visibility",
    "_act_change_visibility_batch",
    "_act_purge_queue",
    "_expire_retained",
    "_dlq_sweep",
    "_collect_msgs",
)
# What in lambda_svc.py appends to a queue without a step of sqs.py.
DESTINATIONS = ("_route_async_failure", "_send_ddb_stream_failure_record")


def install() -> None:
    """Close the gap in this process, before the emulator starts."""
    # The steps call one another, and ministack's own lock cannot be taken twice.
    lock = sqs._queues_lock = threading.RLock()
    for module, names in ((sqs, STEPS), (lambda_svc, DESTINATIONS)):
        for name in names:
            _replace(module, name, locked(getattr(module, name), lock))


def _replace(module: Any, name: str, by: Callable[..., Any]) -> None:
    was = getattr(module, name)
    setattr(module, name, by)
    # Requests find the function in a table by their action.
    handlers = sqs._HANDLERS
    handlers.update({action: by for action, function in handlers.items() if function is was})


def locked(function: _Call, lock: Any) -> _Call:
    """The function, which nobody else under the same lock runs beside."""

    @wraps(function)
    def alone(*arguments: Any, **named: Any) -> Any:
        with lock:
            return function(*arguments, **named)

    return alone  # type: ignore[return-value]  # of the same signature
