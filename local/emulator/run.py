"""The emulator's process: ministack with its fixes, configured by ministack's own environment.

The file `IORT_LEDGER` keeps its state, as safely as `IORT_LEDGER_SYNC` says (off, normal or full). Without
them the state ends with the process.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Awaitable, Callable
from functools import partial
from pathlib import Path
from tempfile import mkdtemp
from typing import NoReturn, cast

from ministack import app
from ministack.services import iot

from local.emulator import fixes
from local.emulator.fixes import alarms
from local.emulator.fixes.invocations import AsyncInvocations
from local.persistence import install, streams
from local.persistence.gate import Gate
from local.persistence.ledger import Ledger, LedgerError, Sync


def main() -> None:
    """Serve until SIGTERM or SIGINT."""
    path = os.environ.get("IORT_LEDGER")
    sync = cast(Sync, os.environ.get("IORT_LEDGER_SYNC", "normal") if path else "off")
    try:
        ledger = Ledger(Path(path or f"{mkdtemp()}/ledger.db"), sync=sync)
    except LedgerError as error:
        sys.exit(f"{error}; `iort restore` brings a backup back")
    # Nothing may be acknowledged any more.
    ledger.on_broken = partial(_end, status=os.EX_IOERR)
    # Before the fixes, which read streams.
    streams.install(ledger)
    fixes.install()
    if path:
        install.install(ledger, AsyncInvocations().queue)
        install.number_connections()
    Gate(ledger).install()
    iot.mtls_start = _listening(iot.mtls_start)
    alarms.start(os.environ["MINISTACK_REGION"])
    app.main()


def _listening(start: Callable[[], Awaitable[None]]) -> Callable[[], Awaitable[None]]:
    """Start the broker, or end: ministack would run on without one."""

    async def started() -> None:
        await start()
        if not iot.mtls_is_listening():
            _end(f"the broker cannot listen on port {os.environ['IOT_MTLS_PORT']}", os.EX_UNAVAILABLE)

    return started


def _end(words: object, status: int) -> NoReturn:
    """End at once. `make up` starts the emulator again."""
    print(words, file=sys.stderr, flush=True)  # noqa: T201 - the process' last words
    os._exit(status)


if __name__ == "__main__":
    main()
