"""The kept emulator: its services have their state in the ledger, and go on after a restart."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import wraps

from ministack import app
from ministack.services import dynamodb

from local.keeping import objects, queues
from local.keeping.invocations import Invocations, Queue
from local.keeping.ledger import Ledger
from local.keeping.services.keeper import Services

# As long as the archive takes for what became due while the machine was off; its plan comes every hour.
FIRST_S = 2 * 3600.0


def install(ledger: Ledger, queue: Queue) -> None:
    """Keep all but items and streams; call it after the gaps are closed and before the emulator starts."""
    objects.install(ledger)
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
