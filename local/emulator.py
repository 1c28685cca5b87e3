"""The emulator's process: ministack with its gaps closed, configured by ministack's own environment."""

from __future__ import annotations

import os
from pathlib import Path
from typing import cast

from ministack import app

from local import gaps
from local.gaps.metrics import alarm_timer
from local.keeping import kept
from local.keeping.ledger import Ledger, Sync


def main() -> None:
    """Serve until SIGTERM or SIGINT."""
    gaps.install()
    if path := os.environ.get("IORT_LEDGER"):
        kept.install(Ledger(Path(path), sync=cast(Sync, os.environ.get("IORT_LEDGER_SYNC", "normal"))))
    alarm_timer.start(os.environ["MINISTACK_REGION"])
    app.main()


if __name__ == "__main__":
    main()
