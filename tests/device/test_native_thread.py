"""The network's thread keeps Python's thread state: a callback finds what an earlier one stored."""

from __future__ import annotations

import queue
import socket
import threading
from typing import Any, Callable

import pytest
from awscrt import io, mqtt5

from iort_agent.mqtt.client import keep_state


def _callbacks_find_their_state(at_the_first: Callable[[], None]) -> bool:
    """Return whether a callback in the thread of AWS' client finds what an earlier one stored."""
    left = threading.local()
    found: queue.SimpleQueue[bool] = queue.SimpleQueue()

    def on_refused(_: Any) -> None:
        known = hasattr(left, "mark")
        if not known:
            at_the_first()
        left.mark = True
        found.put(known)

    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        # Bound but not listening: every connection is refused at once.
        group = io.EventLoopGroup(1)
        client = mqtt5.Client(
            mqtt5.ClientOptions(
                host_name="127.0.0.1",
                port=closed.getsockname()[1],
                bootstrap=io.ClientBootstrap(group, io.DefaultHostResolver(group)),
                min_reconnect_delay_ms=1,
                max_reconnect_delay_ms=1,
                on_lifecycle_event_connection_failure_fn=on_refused,
            )
        )
        client.start()
        try:
            assert not found.get(timeout=60)
            return found.get(timeout=60)
        finally:
            client.stop()


@pytest.mark.parametrize(("at_the_first", "kept"), [(keep_state, True), (lambda: None, False)])
def test_a_kept_thread_keeps_its_state_for_the_next_callback(
    at_the_first: Callable[[], None], *, kept: bool
) -> None:
    assert _callbacks_find_their_state(at_the_first) is kept
