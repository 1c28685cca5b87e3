"""Measures round trips over every path and of the floor at the same time, each on its own connection."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from typing import Any

from typing_extensions import Self

from bench.errors import BenchError
from bench.floors.raw_mqtt import RawClient
from iort_agent.common.threads import SystemClock
from iort_agent.config import load_config
from iort_agent.lanes import PingConfig
from iort_agent.lanes.pings import Pings
from iort_agent.mqtt.aws import IotCore
from iort_agent.mqtt.dispatch import Dispatcher
from iort_agent.mqtt.rate_limiter import RateLimiter
from iort_agent.mqtt.uplink import Link
from iort_contract.catalog.streams import RTT_FIELDS
from iort_contract.limits import Value
from iort_contract.messages.live import encode_ping
from iort_contract.topics import BROKER, PING, PONG, build_topic
from iort_station.fleet.robots import Bundle

RAW = "raw client"
# Bytes of a ping besides its padding, approximately.
_ENVELOPE = 60
_CONNECT_S = 30.0
# Time to subscribe again before the first ping.
_SET_UP_S = 0.3


class RoundTrips:
    """One uplink of the agent for each path, and the raw client, connected from `__enter__` to `__exit__`.

    ``port`` is the port of a proxy before the broker, if there is one.
    """

    def __init__(
        self, bundles: Mapping[str, Bundle], floor: Bundle, namespace: str, port: int | None = None
    ) -> None:
        self._uplinks = {path: Connected(bundle, port) for path, bundle in bundles.items()}
        self.raw = RawClient(floor.folder, port)
        self._topic = build_topic(PING, floor.robot, BROKER, namespace)
        self._exit = ExitStack()

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            for uplink in self._uplinks.values():
                stack.enter_context(uplink)
            stack.enter_context(self.raw)
            self.raw.subscribe(self._topic)
            self._exit = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._exit.close()

    @property
    def lost(self) -> int:
        """Pings that did not come back."""
        return sum(uplink.lost for uplink in self._uplinks.values())

    def measure(self, *, size: int, rate_hz: int, lasts_s: float) -> dict[str, list[float]]:
        """Return the round trips in ms over each path and of the floor, measured for ``lasts_s`` seconds."""
        names = (*self._uplinks, RAW)
        began = time.perf_counter() + _SET_UP_S
        with ThreadPoolExecutor(len(names)) as pool:
            # Each has its own part of the period, so that none waits for another's message.
            begins = {name: began + i / len(names) / rate_hz for i, name in enumerate(names)}
            running = {}
            for name in names:
                measure = self._raw if name == RAW else self._uplinks[name].measure
                running[name] = pool.submit(measure, name, rate_hz, size, begins[name], lasts_s)
            found = {name: trips.result() for name, trips in running.items()}
        if missing := [name for name, trips in found.items() if not trips]:
            raise BenchError(f"nothing was measured over {', '.join(missing)}")
        return found

    def _raw(self, _: str, rate_hz: float, size: int, begins: float, seconds: float) -> list[float]:
        payload = encode_ping(1, time.time_ns() // 1000, "x" * max(0, size - _ENVELOPE))
        values: list[float] = []
        due, pause = begins, threading.Event()
        # One at a time: if a round trip takes longer than the period, the next ping leaves when it ends.
        while due < begins + seconds:
            pause.wait(max(0.0, due - time.perf_counter()))
            values.append(self.raw.round_trip(self._topic, payload) * 1000)
            due = max(due + 1 / rate_hz, time.perf_counter())
        return values


class Connected:
    """The agent's uplink of a bundle, connected from `__enter__` to `__exit__`, to ``port`` if given."""

    def __init__(self, bundle: Bundle, port: int | None = None) -> None:
        self.config = load_config(bundle.config)
        self.clock = SystemClock()
        self.lost = 0
        self.uplink = IotCore(
            endpoint=self.config.endpoint,
            port=port or self.config.port,
            client_id=self.config.robot,
            certificate=self.config.certificate,
            private_key=self.config.private_key,
            root_ca=self.config.root_ca,
            clock=self.clock,
            dispatcher=Dispatcher(),
        )

    def __enter__(self) -> Self:
        connected = threading.Event()
        self.uplink.on_connection(lambda up: connected.set() if up else None)
        self.uplink.start()
        if not connected.wait(_CONNECT_S):
            raise BenchError(f"{self.config.robot} was not connected within {_CONNECT_S:.0f} s")
        return self

    def __exit__(self, *_: object) -> None:
        self.uplink.stop(5.0)

    def link(self) -> Link:
        """The robot's link, without the agent's limit of its rate."""
        limiter = RateLimiter(self.clock, publishes_per_s=1e6, bytes_per_s=1e9)
        return Link(self.config.robot, self.config.namespace, self.uplink, self.clock, limiter)

    def measure(self, path: str, rate_hz: float, size: int, begins: float, seconds: float) -> list[float]:
        """Round trips over a path from then on, in milliseconds, by the agent's own pings."""
        trips: list[float] = []

        def emit(_stream: str, _t_us: int, values: Any) -> None:
            value: Value = values[RTT_FIELDS[path]]
            if isinstance(value, (int, float)):
                trips.append(float(value))

        pings = Pings(
            self.link(),
            PingConfig(rate_hz, (path,), max(0, size - _ENVELOPE)),
            emit=emit,
            on_stamp=lambda _sent, _received, _stamp_ms: None,
        )
        stop = threading.Event()
        lane = PING if path == BROKER else PONG
        answers = build_topic(lane, self.config.robot, path, self.config.namespace)
        while not self.uplink.subscribed(answers):
            stop.wait(0.02)
        stop.wait(max(0.0, begins - time.perf_counter()))
        runner = threading.Thread(target=pings.run, args=(stop,), daemon=True)
        runner.start()
        stop.wait(seconds)
        stop.set()
        pings.wake()
        runner.join()
        pings.close(5.0)
        self.lost += pings.report()[path].lost
        return trips
