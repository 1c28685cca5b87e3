"""The fixture of the probes: two robots with raw connections, and a function that identifies itself."""

from __future__ import annotations

import json
import time
import uuid
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

from typing_extensions import Self

from bench.floors.raw_mqtt import RawClient
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.messages.batch import Batch, encode_batch
from iort_contract.messages.live import LiveSample, encode_live, encode_ping
from iort_contract.topics import LIVE, PING, PONG, build_topic, record_topic
from iort_station.operations import audit
from testkit.target import Target, temporary_function
from testkit.waiting import InstrumentError, reached

WAIT_S = 30.0
_WHO = """
import os, time, uuid
INSTANCE = uuid.uuid4().hex
def handler(event, context):
    time.sleep(event["seconds"])
    return {"instance": INSTANCE, "memory_mb": os.environ.get("AWS_LAMBDA_FUNCTION_MEMORY_SIZE")}
"""


class AbilityMissingError(InstrumentError):
    """The service lacks the ability; the text says what the probe saw."""


def equal(found: Any, expected: Any) -> None:
    """Raise `AbilityMissingError` unless ``found`` equals ``expected``."""
    if found != expected:
        raise AbilityMissingError(f"must be {expected!r:.80}, got {found!r:.80}")


def until(true: Callable[[], object], what: str, seconds: float = WAIT_S) -> None:
    """Wait until ``true`` says so. Raises `AbilityMissingError` after ``seconds``."""
    if not reached(true, within_s=seconds):
        raise AbilityMissingError(f"waited {seconds:.0f} s for {what}")


class ProbeFixture:
    """Robots and a function that exist from `__enter__` to `__exit__`.

    ``a`` and ``b`` are the names of the robots, ``function`` is the name of the function.
    """

    def __init__(self, target: Target) -> None:
        self.target, self._exit = target, ExitStack()
        self.cloud, self.namespace = target.cloud, target.cloud.namespace
        self._drives = self._seq = 0

    def __enter__(self) -> Self:
        self._bundles = [self.target.robot(f"bench-ability-{i}") for i in range(2)]
        self.a, self.b = (bundle.robot for bundle in self._bundles)
        self.function = self._exit.enter_context(
            temporary_function(self.target, "who", _WHO, memory_mb=128, timeout_s=10)
        )
        return self

    def __exit__(self, *_: object) -> None:
        self._exit.close()

    def client(self, index: int) -> RawClient:
        """Return a connection of the first robot (0) or the second (1)."""
        return RawClient(self._bundles[index].folder)

    def topic(self, lane: str, robot: str, name: str) -> str:
        return build_topic(lane, robot, name, self.namespace)

    def pong(self, path: str) -> dict[str, Any]:
        """Return the answer of the path to a ping of the first robot."""
        with self.client(0) as client:
            client.subscribe(self.topic(PONG, self.a, path))
            number = time.time_ns() % 1_000_000
            client.publish(self.topic(PING, self.a, path), encode_ping(number, time.time_ns() // 1000))
            answer: dict[str, Any] = json.loads(client.receive()[1])
        equal(answer["id"], number)
        return answer

    def drive(self) -> list[Batch]:
        """Publish a drive of three seconds as the first robot; return its batches after they are stored."""
        # Each drive has its own seconds, which the one before has not filled.
        self._drives += 1
        first_s = int(time.time()) - 60 * self._drives
        boot = uuid.uuid4().hex[:8]
        batches = [
            Batch(boot, i, [(first_s + i) * 1_000_000 + k * 20_000 for k in range(50)], {"speed": [i] * 50})
            for i in range(3)
        ]
        with self.client(0) as client:
            for batch in batches:
                client.publish(record_topic(self.a, VESC_STREAM, self.namespace), encode_batch(batch))
            client.ping()
            until(lambda: sum(b.boot == boot for b in self.stored()) == 3, "the rule to store the batches")
        return batches

    def stored(self) -> list[Batch]:
        """Return the first robot's batches in the telemetry table."""
        return list(audit.batches(self.cloud, self.a, VESC_STREAM))

    def live_until(self, client: RawClient, true: Callable[[], object], what: str) -> None:
        """Publish live samples until ``true``; the first may be stale before a cold function starts."""

        def heard() -> object:
            self._seq += 1
            now_us = time.time_ns() // 1000
            live = encode_live(LiveSample("0badcafe", self._seq, now_us, now_us, {"speed": 1}))
            client.publish(self.topic(LIVE, self.a, VESC_STREAM), live)
            return true()

        until(heard, what)

    def who(self, seconds: float) -> dict[str, Any]:
        """Return ``instance`` and ``memory_mb`` from the function, which takes ``seconds`` to answer."""
        payload = json.dumps({"seconds": seconds}).encode()
        answer = self.cloud.client("lambda").invoke(FunctionName=self.function, Payload=payload)
        found: dict[str, Any] = json.loads(answer["Payload"].read())
        return found
