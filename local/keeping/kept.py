"""The kept emulator: its services have their state in the ledger, and go on after a restart."""

from __future__ import annotations

from ministack import app

from local.keeping import objects, queues
from local.keeping.invocations import Events, Invocations
from local.keeping.ledger import Ledger
from local.keeping.services.keeper import Services


def install(ledger: Ledger, events: Events) -> None:
    """Keep all but items and streams; call it after the gaps are closed and before the emulator starts."""
    objects.install(ledger)
    queues.install(ledger)
    services, invocations = Services(ledger), Invocations(ledger, events)
    services.install()
    invocations.install()
    ready = app._run_ready_scripts

    async def go_on() -> None:
        await ready()
        # Functions call the emulator.
        await app._wait_for_port(int(app._resolve_port()))
        invocations.go_on()
        services.go_on()

    app._run_ready_scripts = go_on
