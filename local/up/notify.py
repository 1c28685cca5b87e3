"""systemd's notifications: whoever waits for the service knows when it is ready (sd_notify(3))."""

from __future__ import annotations

import os
import socket


def tell(state: str) -> None:
    """Tell systemd a state, such as READY=1; without systemd nothing happens."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        # An @ stands for the abstract namespace.
        systemd.connect(address.replace("@", "\0", 1) if address.startswith("@") else address)
        systemd.sendall(state.encode())
