"""The emulator's process: ministack with its gaps closed, configured by ministack's own environment.

The file `IORT_LEDGER` keeps its state, as safely as `IORT_LEDGER_SYNC` says (off, normal or full). Without
them the state ends with the process.
"""

from __future__ import annotations

import os
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import cast

from ministack import app

from local import gaps
from local.gaps.metrics import alarm_timer
from local.keeping import streams
from local.keeping.ledger import Ledger, Sync


def main() -> None:
    """Serve until SIGTERM or SIGINT."""
    with TemporaryDirectory() as folder:
        path = os.environ.get("IORT_LEDGER")
        ledger = Ledger(
            Path(path or f"{folder}/ledger.db"),
            sync=cast(Sync, os.environ.get("IORT_LEDGER_SYNC", "normal" if path else "off")),
        )
        # Before the gaps: they read what is kept.
        streams.install(ledger)
        gaps.install()
        alarm_timer.start(os.environ["MINISTACK_REGION"])
        app.main()


if __name__ == "__main__":
    main()
