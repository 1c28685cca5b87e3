"""AWS' client mended: its thread keeps Python's state, and its socket sends at once."""

from __future__ import annotations

import os
import queue
import socket
import threading
from contextlib import ExitStack
from typing import Any, Callable

import pytest
from awscrt import io, mqtt5

from iort_agent.mqtt.client import keep_state, send_at_once
from testkit.waiting import GUARD_S


def _callbacks_find_their_state(at_the_first: Callable[[], None]) -> bool:
    """Return whether a callback in the thread of AWS' client finds what an earlier one stored."""
    left = threading.local()
    found: queue.SimpleQueue[bool] = queue.SimpleQueue()
    stopped = threading.Event()

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
                on_lifecycle_event_stopped_fn=lambda _: stopped.set(),
            )
        )
        client.start()
        try:
            assert not found.get(timeout=GUARD_S)
            return found.get(timeout=GUARD_S)
        finally:
            client.stop()
            assert stopped.wait(GUARD_S), "its thread would call back in later tests"


@pytest.mark.parametrize(("at_the_first", "kept"), [(keep_state, True), (lambda: None, False)])
def test_a_kept_thread_keeps_its_state_for_the_next_callback(
    at_the_first: Callable[[], None], *, kept: bool
) -> None:
    assert _callbacks_find_their_state(at_the_first) is kept


def nodelay(sock: socket.socket) -> bool:
    return bool(sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY))


def test_only_sockets_to_the_port_get_nodelay():
    with socket.create_server(("127.0.0.1", 0)) as broker, socket.create_server(("127.0.0.1", 0)) as other:
        port = broker.getsockname()[1]
        with ExitStack() as stack:
            uplink = stack.enter_context(socket.create_connection(("127.0.0.1", port)))
            stranger = stack.enter_context(socket.create_connection(("127.0.0.1", other.getsockname()[1])))
            unconnected = stack.enter_context(socket.socket())
            assert not nodelay(uplink)
            assert send_at_once(port) == 1
            assert nodelay(uplink)
            assert not nodelay(stranger)
            assert not nodelay(unconnected)
            # The duplicate is closed, but the socket stays open.
            uplink.sendall(b"x")


def test_other_sockets_stay_unchanged_under_a_default_timeout():
    # rospy sets a default timeout; its own server socket must stay blocking.
    with socket.create_server(("127.0.0.1", 0)) as broker, socket.create_server(("127.0.0.1", 0)) as other:
        port = broker.getsockname()[1]
        before = socket.getdefaulttimeout()
        with socket.create_connection(("127.0.0.1", port)):
            socket.setdefaulttimeout(60)
            try:
                assert send_at_once(port) == 1
            finally:
                socket.setdefaulttimeout(before)
            assert os.get_blocking(other.fileno())
            assert os.get_blocking(broker.fileno())
