"""The gateway takes its own port only.

AWS: does not apply; the embedded cloud must not take a port of the machine that nobody gave it.
ministack: with USE_SSL also listens on port 443 where the process may.
Test: tests/local/gaps/test_listener_gap.py::test_every_listener_of_the_emulator_is_on_loopback
Patch: none; ministack takes port 443 on purpose, so upstream would have to agree on a switch first
"""

from __future__ import annotations

import inspect

from ministack import app


def install() -> None:
    """Close the gap in this process."""
    app._port_is_bindable = lambda _host, _port: False


def is_open() -> bool:
    """Look at the source: the port is taken in the middle of `main`, which serves for ever."""
    return "_port_is_bindable(bind_host, 443)" in inspect.getsource(app.main)
