"""The live lane on demand: what a car sends while nobody looks, how soon it is awake, and both ways to a
viewer side by side."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace

from bench.report import Section, Spread, spread, text
from bench.sections import Declared
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.cloud import IOT, PUBNUB
from iort_contract.limits import LIVE_BROKER_EVERY_S, LIVE_MAX_RATE_HZ
from iort_contract.messages.live import VIEW_LEASE_MS, Lease, LiveSample, decode_live, decode_live_update
from iort_contract.topics import LIVE
from iort_station.cost import model
from iort_station.cost.usage import Usage
from iort_station.fleet import viewing
from iort_station.fleet.broker import Broker
from iort_station.fleet.roles import Role
from iort_station.page.page import load_keys
from iort_station.page.pubnub import Listener
from testkit.car import AgentProcess
from testkit.target import Say, Target
from testkit.waiting import until

ROBOT = "bench-viewing"
IDLE_S, WATCHED_S, WAKES = 60, 20, 20
_WARM_UP_S = 3.0
_FULL_MS = round(1000 / LIVE_MAX_RATE_HZ)
_IDLE_MS = round(1000 * LIVE_BROKER_EVERY_S)
_WAYS = {IOT: "AWS IoT, MQTT 5 over WebSocket", PUBNUB: "PubNub, by the live rule and Lambda 1"}
# An unwatched robot-hour on AWS, without archive and analysis, as the thesis is compared.
_TARGET_DOLLARS = 0.014


@dataclass(frozen=True)
class Heard:
    """A live message at a viewer, and its arrival: monotonic, and by the wall clock."""

    at: float
    here_us: int
    live: LiveSample

    @property
    def delay_ms(self) -> float:
        """From the sample to the viewer, by this machine's one clock."""
        return (self.here_us - self.live.t_us) / 1000


class Viewers:
    """What a viewer hears of one robot by either way."""

    def __init__(self) -> None:
        self.heard: dict[str, list[Heard]] = {IOT: [], PUBNUB: []}

    def take(self, way: str, live: LiveSample) -> None:
        """Keep a message that has just come."""
        self.heard[way].append(Heard(time.monotonic(), time.time_ns() // 1000, live))

    def since(self, way: str, at: float, next_ms: int) -> list[Heard]:
        """The messages of a rate that came after a moment."""
        return [one for one in list(self.heard[way]) if one.at > at and one.live.next_ms == next_ms]


def run(target: Target, say: Say) -> Section:
    """Drive one car at 50 Hz, with the agent's own settings."""
    section = Section("viewing", "Live while somebody looks")
    source = {"type": "sim", "stream": VESC_STREAM, "rate_hz": 50, "pose": {"rate_hz": 0}}
    robot = target.robot(ROBOT, sources=[source])
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
    report(section, idle, wakes, delays)
    return section


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
    found = []
    for wake in range(WAKES):
        say(f"wake {wake + 1} of {WAKES}, by {way}")
        began = time.monotonic()
        viewing.view(target.cloud, [robot], lease)
        until(lambda: viewers.since(way, began, _FULL_MS), "a message at the full rate")  # noqa: B023 - within the loop
        found.append((viewers.since(way, began, _FULL_MS)[0].at - began) * 1000)
        ended = time.monotonic()
        viewing.view(target.cloud, [robot], replace(lease, lease_ms=0))
        until(lambda: viewers.since(IOT, ended, _IDLE_MS), "the car to sleep again")  # noqa: B023 - as above
    return found


def _side_by_side(target: Target, robot: str, viewers: Viewers) -> dict[str, list[float]]:
    """The delays of the same messages by both ways: all pass the broker, and the live rule takes them too."""
    with viewing.Viewer(target.cloud, [robot], broker=True):
        threading.Event().wait(_WARM_UP_S)
        began = time.monotonic()
        threading.Event().wait(WATCHED_S)
        return {way: [one.delay_ms for one in viewers.since(way, began, _FULL_MS)] for way in _WAYS}


def report(
    section: Section, idle: int, wakes: dict[str, list[float]], delays: dict[str, list[float]]
) -> None:
    """Fill the section."""
    alike = Usage(archive_days=0, drive_minutes=0.0)
    alone = replace(alike, watched_hours=0.0)
    usages = {way: replace(alike, live_transport=way) for way in _WAYS}
    costs = {way: model.total(model.bill(usage)) for way, usage in usages.items()}
    pubnub = {way: model.total(model.pubnub_bill(usage)) for way, usage in usages.items()}
    unwatched = model.total(model.bill(alone))
    an_hour = idle * 3600 / IDLE_S
    section.table(
        f"Nobody looks, one stream at 50 Hz; counted by a subscriber at the broker for {IDLE_S} s",
        ["", "measured or computed", "live.when: always"],
        [
            ["live messages", f"{idle}", f"{IDLE_S * LIVE_MAX_RATE_HZ:.0f}"],
            ["live messages an hour", f"{an_hour:,.0f}", f"{3600 * LIVE_MAX_RATE_HZ:,.0f}"],
            [
                "AWS, dollars a robot-hour without archive and analysis",
                f"{unwatched:.4f}",
                f"{model.total(model.bill(replace(alike, watched_hours=None))):.4f}",
            ],
            [
                "PubNub by transactions, dollars a robot-hour",
                f"{model.total(model.pubnub_bill(alone)):.4f}",
                f"{pubnub[PUBNUB]:.4f}",
            ],
        ],
    )
    section.table(
        "Both ways to one viewer at 10 Hz",
        [
            "way",
            "from a lease to the first message, median",
            "from the sample, median",
            "AWS, $/h",
            "PubNub, $/h",
        ],
        [
            [
                name,
                text([wakes[way]], digits=0),
                text([delays[way]], digits=1),
                f"{costs[way]:.4f}",
                f"{pubnub[way]:.4f}",
            ]
            for way, name in _WAYS.items()
        ],
    )
    section.ratio(
        "unwatched robot-hour on AWS", round(unwatched, 4), _TARGET_DOLLARS, unit="$", tolerance=1.01
    )
    section.ratio(
        "live messages while nobody looks / always", round(an_hour / 3600 / LIVE_MAX_RATE_HZ, 4), 0.02
    )
    for way in _WAYS:
        woken = spread([wakes[way]])
        p95 = round(woken.p95) if woken else None
        section.ratio(f"awake by {way}, p95", p95, 1000.0, unit="ms", tolerance=2.5, by_machine=True)
    section.notes.append(
        "The costs are the model's, the messages and delays are measured. A lease is published by the "
        "operator's HTTPS request, which counts from its begin."
    )
    section.raw = {
        "idle_messages": idle,
        "idle_s": IDLE_S,
        "wake_ms": {way: _numbers(values) for way, values in wakes.items()},
        "delay_ms": {way: _numbers(values) for way, values in delays.items()},
        "dollars": {"unwatched": unwatched, **costs},
        "pubnub_dollars": pubnub,
    }


def _numbers(values: list[float]) -> dict[str, float] | None:
    found: Spread | None = spread([values])
    return asdict(found) if found else None


SECTION = Declared("the live lane while nobody looks, and awake", run)
