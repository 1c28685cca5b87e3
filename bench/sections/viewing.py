"""The live lane on demand: what a car sends while nobody looks, how soon it is awake, and both ways to a
viewer side by side."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace

from bench.report import Section, spread, text
from bench.sections import Declared
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.cloud import IOT, PUBNUB
from iort_contract.limits import LIVE_BROKER_EVERY_S, LIVE_MAX_RATE_HZ
from iort_contract.messages.live import VIEW_LEASE_MS, Lease, LiveSample, decode_live, decode_live_update
from iort_contract.topics import LIVE
from iort_station.fleet import viewing
from iort_station.fleet.broker import Broker
from iort_station.fleet.roles import Role
from iort_station.page.page import load_keys
from iort_station.page.pubnub import Listener
from testkit.car import AgentProcess
from testkit.target import Say, Target
from testkit.waiting import until

IDLE_S, WATCHED_S, WAKES = 60, 20, 20
_WARM_UP_S = 3.0
_FULL_MS = round(1000 / LIVE_MAX_RATE_HZ)
_IDLE_MS = round(1000 * LIVE_BROKER_EVERY_S)
_WAYS = {IOT: "AWS IoT, MQTT 5 over WebSocket", PUBNUB: "PubNub, by the live rule and Lambda 1"}
# Values in ms by way.
Delays = dict[str, list[float]]


@dataclass(frozen=True)
class Heard:
    """A live message at a viewer, and its arrival: monotonic, and by the wall clock."""

    at: float
    here_us: int
    live: LiveSample


class Viewers:
    """What a viewer hears of one robot by either way."""

    def __init__(self) -> None:
        self.heard: dict[str, list[Heard]] = {IOT: [], PUBNUB: []}

    def take(self, way: str, live: LiveSample) -> None:
        """Keep a message that has just come."""
        self.heard[way].append(Heard(time.monotonic(), time.time_ns() // 1000, live))

    def since(self, way: str, at: float, next_ms: int) -> list[Heard]:
        """The messages of a rate that came after a moment."""
        return [heard for heard in list(self.heard[way]) if heard.at > at and heard.live.next_ms == next_ms]


def run(target: Target, say: Say) -> Section:
    """Drive one car at 50 Hz, with the agent's own settings."""
    source = {"type": "sim", "stream": VESC_STREAM, "rate_hz": 50, "pose": {"rate_hz": 0}}
    robot = target.robot("bench-viewing", sources=[source])
    with _listening(target, robot.robot) as viewers, AgentProcess(robot):
        until(lambda: viewers.heard[IOT], "the first live message")
        threading.Event().wait(_WARM_UP_S)
        say(f"nobody looks for {IDLE_S} s")
        before = len(viewers.heard[IOT])
        threading.Event().wait(IDLE_S)
        idle = len(viewers.heard[IOT]) - before
        wakes = {way: _wakes(target, robot.robot, viewers, way, say) for way in _WAYS}
        say(f"both ways side by side for {WATCHED_S} s")
        delays = _side_by_side(target, robot.robot, viewers)
    return report(idle, wakes, delays)


@contextmanager
def _listening(target: Target, robot: str) -> Iterator[Viewers]:
    viewers, cloud = Viewers(), target.cloud
    with (
        Broker(
            cloud,
            Role(cloud),
            filters=[f"{LIVE}/{cloud.namespace}/{robot}/{VESC_STREAM}"],
            on_message=lambda _, message: viewers.take(IOT, decode_live(message)),
        ),
        Listener(
            robot=robot,
            namespace=cloud.namespace,
            on_update=lambda update, *_: viewers.take(PUBNUB, decode_live_update(update).live),
            **load_keys(cloud).reading(),
        ),
    ):
        yield viewers


def _wakes(target: Target, robot: str, viewers: Viewers, way: str, say: Say) -> list[float]:
    """The milliseconds from the request that publishes a lease to the first message at the full rate."""
    lease = Lease("0badcafe", LIVE_MAX_RATE_HZ, VIEW_LEASE_MS, broker=way == IOT)
    took_ms = []
    for wake in range(WAKES):
        say(f"wake {wake + 1} of {WAKES}, by {way}")
        began = time.monotonic()
        viewing.view(target.cloud, [robot], lease)
        first, *_ = until(lambda: viewers.since(way, began, _FULL_MS), "a message at the full rate")  # noqa: B023 - within the loop
        took_ms.append((first.at - began) * 1000)
        ended = time.monotonic()
        viewing.view(target.cloud, [robot], replace(lease, lease_ms=0))
        until(lambda: viewers.since(IOT, ended, _IDLE_MS), "the car to sleep again")  # noqa: B023 - as above
    return took_ms


def _side_by_side(target: Target, robot: str, viewers: Viewers) -> Delays:
    """The delays from the sample to the viewer, of the same messages by both ways, by one clock."""
    with viewing.Viewer(target.cloud, [robot], broker=True):
        threading.Event().wait(_WARM_UP_S)
        began = time.monotonic()
        threading.Event().wait(WATCHED_S)
        return {
            way: [(heard.here_us - heard.live.t_us) / 1000 for heard in viewers.since(way, began, _FULL_MS)]
            for way in _WAYS
        }


def report(idle: int, wakes: Delays, delays: Delays) -> Section:
    """Make the section of the messages while nobody looks, the wakes and the delays."""
    section = Section("viewing", "Live while somebody looks")
    section.table(
        "Both ways to one viewer at 10 Hz",
        ["way", "from a lease to the first message", "from the sample"],
        [[name, text([wakes[way]], digits=0), text([delays[way]], digits=1)] for way, name in _WAYS.items()],
    )
    section.ratio("live messages while nobody looks / always", idle / (IDLE_S * LIVE_MAX_RATE_HZ), 0.02)
    for way in _WAYS:
        p95 = spread([wakes[way]]).p95
        name = f"awake by {way}, p95"
        section.ratio(name, p95, 1000.0, unit="ms", tolerance=2.5, by_machine=True)
    section.notes.append(
        f"{idle} live messages of a car at 50 Hz came to a subscriber at the broker in {IDLE_S} s in which "
        "nobody looked. A lease is published by the operator's HTTPS request, which counts from its begin."
    )
    section.raw = {
        "idle_messages": idle,
        "wake_ms": {way: asdict(spread([values])) for way, values in wakes.items()},
        "delay_ms": {way: asdict(spread([values])) for way, values in delays.items()},
    }
    return section


SECTION = Declared("the live lane while nobody looks, and awake", run, dollars=0.002)
