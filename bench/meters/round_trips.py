"""Measures round trips over every path and of the floor at the same time, each on its own connection."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack

from typing_extensions import Self

from bench.floors.raw_mqtt import RawClient
from iort_contract.messages.live import encode_ping
from iort_contract.topics import BROKER, PING, build_topic
from iort_station.fleet.robots import Bundle
from testkit.car import ENVELOPE, Connected
from testkit.waiting import InstrumentError

RAW = "raw client"
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
            raise InstrumentError(f"nothing was measured over {', '.join(missing)}")
        return found

    def _raw(self, _: str, rate_hz: float, size: int, begins: float, seconds: float) -> list[float]:
        payload = encode_ping(1, time.time_ns() // 1000, "x" * max(0, size - ENVELOPE))
        values: list[float] = []
        due, pause = begins, threading.Event()
        # One at a time: if a round trip takes longer than the period, the next ping leaves when it ends.
        while due < begins + seconds:
            pause.wait(max(0.0, due - time.perf_counter()))
            values.append(self.raw.round_trip(self._topic, payload) * 1000)
            due = max(due + 1 / rate_hz, time.perf_counter())
        return values
