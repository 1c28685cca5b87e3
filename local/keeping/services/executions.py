"""Executions of state machines: those that the emulator's end interrupted, and those that ended long ago.

AWS has no such end, and forgets an execution after 90 days. ministack marks interrupted ones as failed after
a restart, and forgets none; here they begin anew, as after a retry.
"""

from __future__ import annotations

import contextvars
import threading
import time
from collections.abc import Sequence
from datetime import datetime
from typing import Any

from ministack.core.responses import request_scope
from ministack.services import stepfunctions

from local.keeping.services.documents import State

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
