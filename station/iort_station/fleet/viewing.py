"""Looks at robots' live lanes: publishes the leases that keep them awake."""

from __future__ import annotations

import secrets
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor

from botocore.exceptions import BotoCoreError, ClientError
from typing_extensions import Self

from iort_contract.limits import LIVE_MAX_RATE_HZ
from iort_contract.messages.live import VIEW_LEASE_MS, VIEW_RENEW_S, Lease, encode_lease, lease_topic
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.fleet import registry
from iort_station.supervision import keep

_AT_ONCE = 8
# Without a network a request takes a minute to fail. The robots forget the viewer in less.
_GOODBYE_S = 3.0


def view(cloud: Cloud, robots: Iterable[str], lease: Lease) -> int:
    """Publish a viewer's lease to each of the robots, and return how many they are. Raises
    `StationError`."""
    payload, data = encode_lease(lease), cloud.client("iot-data")
    topics = [lease_topic(robot, cloud.namespace) for robot in robots]
    if not topics:
        return 0
    try:
        with ThreadPoolExecutor(min(_AT_ONCE, len(topics))) as pool:
            list(pool.map(lambda topic: data.publish(topic=topic, qos=0, payload=payload), topics))
    except (BotoCoreError, ClientError) as error:
        raise StationError(f"the cars' live lanes cannot be woken: {error}") from error
    return len(topics)


def online(cloud: Cloud) -> list[str]:
    """The robots of the fleet that are connected."""
    return [robot for robot, presence in registry.presence(cloud).items() if presence["online"]]


class Viewer:
    """Holds a lease of each robot within a ``with`` block, in a thread of its own.

    ``robots`` are names, or a function that is asked at each renewal. ``broker`` says that the viewer listens
    at the broker, not at PubNub. It renews ``every_s``, which also wakes a robot that has just come, and
    whenever somebody calls `renew`.
    `problem` says why the last renewal failed, for who may look but not wake.
    """

    def __init__(
        self,
        cloud: Cloud,
        robots: Iterable[str] | Callable[[], Iterable[str]],
        *,
        rate_hz: float = LIVE_MAX_RATE_HZ,
        broker: bool = False,
        every_s: float = VIEW_RENEW_S,
    ) -> None:
        self._cloud = cloud
        self._robots = robots if callable(robots) else lambda names=tuple(robots): names
        self._lease = Lease(secrets.token_hex(8), rate_hz, VIEW_LEASE_MS, broker)
        self._every_s = every_s
        self._held: set[str] = set()
        self._renewing = threading.Lock()
        self._end = threading.Event()
        self._thread = threading.Thread(
            target=lambda: keep("viewer", self._run, self._end), name="viewer", daemon=True
        )
        self.problem = ""

    def __enter__(self) -> Self:
        self.renew()
        self._thread.start()
        return self

    def __exit__(self, *_error: object) -> None:
        self._end.set()
        goodbye = threading.Thread(target=self._leave, name="viewer's end", daemon=True)
        goodbye.start()
        goodbye.join(_GOODBYE_S)

    def _leave(self) -> None:
        self._thread.join()
        if not self.problem:
            self._publish(self._held, 0)

    def _run(self) -> None:
        while not self._end.wait(self._every_s):
            self.renew()

    def renew(self) -> None:
        """Renew the leases now, and end those of robots that are no longer looked at."""
        with self._renewing:
            try:
                robots = set(self._robots())
            except (StationError, BotoCoreError, ClientError) as error:
                self.problem = str(error)
                return
            self._publish(self._held - robots, 0)
            self._held = robots
            self._publish(robots, VIEW_LEASE_MS)

    def _publish(self, robots: set[str], lease_ms: int) -> None:
        lease = Lease(self._lease.viewer, self._lease.rate_hz, lease_ms, self._lease.broker)
        try:
            view(self._cloud, sorted(robots), lease)
            self.problem = ""
        except StationError as error:
            self.problem = str(error)
