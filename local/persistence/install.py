"""The kept emulator: its services have their state in the ledger, and go on after a restart."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import wraps
from typing import Any

from ministack import app
from ministack.services import dynamodb, iot

from local.persistence import queues, tables
from local.persistence.ledger import Ledger
from local.persistence.queues import Invocations, Queue
from local.persistence.services import Services

# As long as the archive takes for what became due while the machine was off; its plan comes every hour.
FIRST_S = 2 * 3600.0


def install(ledger: Ledger, queue: Queue) -> None:
    """Keep all but items and streams; call it after the fixes and before the emulator starts."""
    tables.install_objects(ledger)
    queues.install(ledger)
    services, invocations = Services(ledger), Invocations(ledger, queue)
    services.install()
    invocations.install()
    dynamodb._expire_items = not_at_first(dynamodb._expire_items)
    ready = app._run_ready_scripts

    async def go_on() -> None:
        await ready()
        # Functions call the emulator.
        await app._wait_for_port(int(app._resolve_port()))
        invocations.go_on()
        services.go_on()

    app._run_ready_scripts = go_on


def not_at_first(expire: Callable[[float], None]) -> Callable[[float], None]:
    """Let items expire, but not soon after the start: the machine may have been off for months, and its clock
    may be wrong still. AWS takes days, too."""
    began_s = time.time()

    @wraps(expire)
    def expire_later(now_s: float) -> None:
        if not 0 <= now_s - began_s < FIRST_S:
            expire(now_s)

    return expire_later


# Connections are numbered upwards over restarts of the broker: a lower number is an old event's.


class _Numbers(dict[Any, int]):
    """The next number of each client; the first one is the second of the start."""

    def __init__(self, first: int) -> None:
        super().__init__()
        self._first = first

    def get(self, key: Any, _default: Any = None) -> int:
        return super().get(key, self._first)


def number_connections() -> None:
    """Do so in this process. No client connects once a second from then on."""
    iot._presence_versions = _Numbers(int(time.time()))
