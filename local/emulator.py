"""The emulator's process: ministack with its gaps closed, configured by ministack's own environment."""

from __future__ import annotations

import os

from ministack import app

from local import gaps
from local.gaps.metrics import alarm_timer


def main() -> None:
    """Serve until SIGTERM or SIGINT."""
    gaps.install()
    alarm_timer.start(os.environ["MINISTACK_REGION"])
    app.main()


if __name__ == "__main__":
    main()
