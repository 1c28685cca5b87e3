"""Ports for the servers of tests that must know theirs before they listen."""

from __future__ import annotations

import itertools
import os
import socket

# Below those that Linux gives to connections (32768 on), and a range for each worker of pytest-xdist, so
# that nobody takes one between here and its server's start.
_FIRST, _EACH = 12_000, 1_000
_WORKER = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[len("gw") :])
_offsets = itertools.count(os.getpid())


def free_port() -> int:
    """A port of loopback on which nobody listens, and that no other test was given lately."""
    while True:
        port = _FIRST + _WORKER * _EACH + next(_offsets) % _EACH
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port
