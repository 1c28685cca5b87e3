"""AWS' client mended: its thread keeps Python's state, and its socket sends at once. And what the kernel
tells of networks."""

from __future__ import annotations

import os
import queue
import socket
import subprocess
import sys
import threading
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Callable, Iterator

import pytest
from awscrt import io, mqtt5

from iort_agent.mqtt.client import keep_state, send_at_once
from testkit.namespaces import Machine, NoNamespacesError, machines
from testkit.waiting import GUARD_S, until


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


LISTENER = """
import sys
from iort_agent.mqtt.client import Network

network = Network()
while True:
    print(network.came(), flush=True)
    if not sys.stdin.readline():
        break
network.close()
"""


@contextmanager
def listening(machine: Machine) -> Iterator[Callable[[], bool]]:
    """A process on a machine hears its kernel: asks it whether a network came since it was asked last."""
    command = machine.command(sys.executable, "-c", LISTENER)
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        answers = process.stdout
        assert answers.readline() == "False\n", "what was there before has not come"

        def came() -> bool:
            print(file=process.stdin, flush=True)
            return {"True\n": True, "False\n": False}[answers.readline()]

        yield came


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[Machine]:
    """A machine of its own, with a kernel's network that we may change."""
    with ExitStack() as stack:
        try:
            (machine,) = stack.enter_context(machines(tmp_path, "robot"))
        except NoNamespacesError as error:
            pytest.skip(str(error))
        yield machine


def test_the_kernel_tells_of_addresses_and_routes_that_come_and_of_nothing_else(robot: Machine) -> None:
    with listening(robot) as came:
        for what, new in (
            (("address", "add", "10.77.0.1/32", "dev", "lo"), True),
            (("address", "delete", "10.77.0.1/32", "dev", "lo"), False),
            (("route", "add", "10.78.0.0/24", "dev", "lo"), True),
            (("route", "delete", "10.78.0.0/24", "dev", "lo"), False),
            (("link", "set", "lo", "mtu", "9000"), False),
        ):
            robot.run("ip", *what)
            assert came() is new, what
            assert not came(), "once"
        # The kernel looks for others that have it before it tells.
        robot.run("ip", "address", "add", "fd77::1/128", "dev", "lo")
        until(came)


def test_more_notices_than_the_kernel_keeps_are_a_network_that_may_have_come(
    robot: Machine, tmp_path: Path
) -> None:
    """Each alone tells of a route that goes."""
    routes, batch = range(4000), tmp_path / "routes"
    with listening(robot) as came:
        for verb, new in (("add", True), ("delete", True)):
            batch.write_text("".join(f"route {verb} 10.78.{i >> 8}.{i & 255}/32 dev lo\n" for i in routes))
            robot.run("ip", "-batch", str(batch))
            assert came() is new
            until(lambda: not came())
