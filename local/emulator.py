"""The emulator's process: ministack with its gaps closed. Configured by ministack's own environment."""

from __future__ import annotations

import os

from ministack import app

from local import gaps, metrics


def main() -> None:
    """Serve until SIGTERM or SIGINT."""
    gaps.install()
    metrics.install()
    metrics.start(os.environ["MINISTACK_REGION"])
    # Under USE_SSL it would also take port 443 of the machine, where it may.
    app._port_is_bindable = lambda _host, _port: False
    app.main()


if __name__ == "__main__":
    main()
