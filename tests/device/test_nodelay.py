"""Small messages leave without delay (TCP_NODELAY)."""

from __future__ import annotations

import os
import socket
from contextlib import ExitStack

from iort_agent.mqtt.client import send_at_once


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
