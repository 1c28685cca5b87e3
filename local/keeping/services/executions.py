"""Executions of state machines that the emulator's end interrupted.

AWS has no such end. ministack marks them as failed after a restart; here they begin anew, as after a retry.
"""

from __future__ import annotations

import contextvars
import threading
from collections.abc import Sequence
from typing import Any

from ministack.core.responses import request_scope
from ministack.services import stepfunctions

from local.keeping.services.documents import State

Key = tuple[str, str, str]


def running(state: State) -> list[Key]:
    """The account, the region and the name of each execution that a kept state has as running."""
    executions = state.get("executions")
    if executions is None:
        return []
    return [key for key, one in executions.all_items() if one["status"] == "RUNNING"]


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
