"""Live samples for the bridge: a robot is woken by a lease while somebody subscribes to one of its topics.

The live lane carries the newest sample of a stream as fields, never a whole ROS message; so each stream is a
topic of JSON (`fields`). What a robot records whole can be played later with its original type (`stored`).
"""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from functools import partial
from typing import Any, Protocol

from typing_extensions import Self

from iort_contract.catalog.streams import CATALOG
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.cloud import IOT
from iort_contract.limits import ContractError
from iort_contract.messages.live import LiveUpdate, decode_live_update
from iort_station.bridge import fields
from iort_station.bridge.channels import Level, Message, Topic
from iort_station.bridge.stored import BOOKKEEPING
from iort_station.cloud import Cloud
from iort_station.data import inventory
from iort_station.errors import StationError
from iort_station.fleet import registry
from iort_station.fleet.viewing import Viewer
from iort_station.page.listening import listening
from iort_station.page.live import Listening
from iort_station.supervision import keep

_AT_ONCE = 8
_LEASES = "live"
# Topics of streams that only come live: a robot may name no more.
_MOST_TOPICS = 256


class Audience(Protocol):
    """Who sees what is live."""

    def add(self, topic: Topic) -> int:
        """Take a further topic; returns its number."""

    def wanted(self) -> frozenset[int]:
        """The topics that somebody subscribes to."""

    def send(self, message: Message) -> None:
        """Take a message."""

    def say(self, text: str, level: Level = "warning", *, name: str | None = None) -> None:
        """Take a line for people."""

    def unsay(self, name: str) -> None:
        """Take a line back."""


class Streams:
    """The streams of robots as topics, by their numbers: those that are recorded, and others as they come."""

    def __init__(self, cloud: Cloud, robots: Sequence[str]) -> None:
        self._several = len(robots) > 1
        # Threads share clients, and must not make one at the same time.
        for service in ("dynamodb", "s3"):
            cloud.client(service)
        for robot in robots:
            registry.get(cloud, robot)
        with ThreadPoolExecutor(_AT_ONCE) as pool:
            has = pool.map(partial(inventory.streams_of, cloud), robots)
            names = [
                (robot, stream)
                for robot, streams in zip(robots, has, strict=True)
                for stream in streams or [VESC_STREAM]
                if stream not in BOOKKEEPING
            ]
            blocks = pool.map(lambda name: inventory.newest_block(cloud, *name), names)
            kinds = [fields.kinds_of(block.columns) for block in blocks]
        self._robots = frozenset(robots)
        self.names = names
        self.topics = [
            self._topic(robot, stream, known or _catalogued(stream))
            for (robot, stream), known in zip(names, kinds, strict=True)
        ]

    def _topic(self, robot: str, stream: str, kinds: Mapping[str, str]) -> Topic:
        kind = inventory.assumed_kind(stream, kinds.keys())
        unit = partial(inventory.unit, stream, kind=kind)
        return fields.topic_of(stream, kinds, unit, f"/{robot}" if self._several else "")

    def begun(self, heard: LiveUpdate) -> Topic | None:
        """The topic of a stream that nobody has recorded yet; None if it is another robot's, or there are too
        many."""
        if heard.robot not in self._robots or heard.stream in BOOKKEEPING or len(self.names) >= _MOST_TOPICS:
            return None
        self.names.append((heard.robot, heard.stream))
        kinds = {name: fields.kind_of(value) for name, value in heard.live.sample.items()}
        return self._topic(heard.robot, heard.stream, kinds)


def _catalogued(stream: str) -> dict[str, str]:
    known = CATALOG[stream].fields if stream in CATALOG else ()
    return {field.name: "number" for field in known}


class Live:
    """Gives live samples to an audience within a ``with`` block, in a thread of its own. ``rate_hz`` is how
    often a robot is asked to send each stream; ``way`` is where to listen."""

    def __init__(
        self, cloud: Cloud, streams: Streams, audience: Audience, *, way: str, rate_hz: float, token: str = ""
    ) -> None:
        self._cloud, self._streams, self._audience = cloud, streams, audience
        self._way, self._token = way, token
        self._numbers = {name: number for number, name in enumerate(streams.names)}
        self._looked_at: frozenset[str] = frozenset()
        self._viewer = Viewer(cloud, lambda: self._looked_at, rate_hz=rate_hz, broker=way == IOT)
        self._changed, self._end = threading.Event(), threading.Event()
        self._listening: ExitStack = ExitStack()
        self._listener: Listening | None = None
        self._thread = threading.Thread(
            target=keep, args=("bridge's leases", self._run, self._end), name="bridge's leases", daemon=True
        )

    def __enter__(self) -> Self:
        self._viewer.__enter__()
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._end.set()
        self._changed.set()
        self._thread.join()
        self._listening.close()
        self._viewer.__exit__(*error)

    def rewanted(self, _topic: int) -> None:
        """Somebody subscribes to a topic, or does so no longer. Called in a thread of the sdk."""
        self._changed.set()

    def take(self, update: Any, _pubnub_us: int, _now_us: int) -> None:
        """Take an update; a malformed one is no sample, and the rules quarantine it."""
        try:
            heard = decode_live_update(update)
        except ContractError:
            return
        number = self._numbers.get((heard.robot, heard.stream))
        if number is None:
            topic = self._streams.begun(heard)
            if topic is None:
                return
            number = self._numbers[heard.robot, heard.stream] = self._audience.add(topic)
        if number in self._audience.wanted():
            self._audience.send(Message(heard.live.t_us * 1000, number, fields.encoded(heard.live.sample)))

    def _run(self) -> None:
        while True:
            self._changed.wait()
            self._changed.clear()
            if self._end.is_set():
                return
            wanted = self._audience.wanted()
            names = self._streams.names
            self._looked_at = frozenset(names[number][0] for number in wanted)
            try:
                self._listen(on=bool(wanted))
            except StationError as error:
                # Tried again with the next subscription.
                self._audience.say(f"nothing is heard live: {error}", "error", name=_LEASES)
                continue
            self._viewer.renew()
            if self._viewer.problem:
                self._audience.say(self._viewer.problem, name=_LEASES)
            else:
                self._audience.unsay(_LEASES)

    def _listen(self, *, on: bool) -> None:
        """Listen only while somebody subscribes. Raises `StationError`."""
        if on and self._listener is None:
            listener = listening(self._cloud, self._way, on_update=self.take, token=self._token)
            self._listener = self._listening.enter_context(listener)
        elif not on and self._listener is not None:
            self._listener = None
            self._listening.close()
