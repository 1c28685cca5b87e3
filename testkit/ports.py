"""Ports for test servers that must know theirs before they listen."""

from __future__ import annotations

import itertools
import os
import socket

# Below Linux' range for outgoing connections (from 32768), with a range for each worker of pytest-xdist, so
# that no other process takes a port before its server starts.
_FIRST, _EACH = 12_000, 1_000
_WORKER = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[len("gw") :])
_offsets = itertools.count(os.getpid())


def free_port() -> int:
    """Return a free port of loopback that no other test was given recently."""
    while True:
        port = _FIRST + _WORKER * _EACH + next(_offsets) % _EACH
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port
