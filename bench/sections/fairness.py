"""Fairness: what one robot at the limit of its connection costs the live lane of another.

Only on the embedded cloud: on AWS other sections would share Lambda 1 with what is refused here.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from bench.driving import Driving
from bench.errors import BenchError
from bench.raw_mqtt import RawClient
from bench.result import Ratio, Section, Table
from bench.spread import Spread, spread
from bench.target import Say, Target
from contract import LIVE, VESC_STREAM, LiveSample, build_topic, encode_live

# AWS IoT takes so many publishes a second from a connection.
RATE_HZ = 100
STRETCH_S = 8
_REPEATS = 2
_MOST = 2.0
_WARM_UP_S = 30.0

Message = Callable[[int], bytes]


def bad(number: int) -> bytes:
    """What no robot of ours sends."""
    return b"no JSON %d" % number


def good(number: int) -> bytes:
    """A live message of now."""
    now_us = time.time_ns() // 1000
    return encode_live(LiveSample("0badcafe", number, now_us, now_us, {"speed": number}))


KINDS: dict[str, Message | None] = {"nothing": None, "bad messages": bad, "good messages": good}


def run(target: Target, say: Say) -> Section:
    """Drive one car, its live lane at 10 Hz, while another robot sends nothing, bad, or good messages."""
    section = Section("fairness", "Fairness: one robot at the limit of its connection")
    if target.embedded is None:
        section.notes.append("Not run on AWS: the messages refused would count against your alarms.")
        return section
    car = target.robot(
        "bench-fair", sources=[{"type": "sim", "stream": VESC_STREAM, "rate_hz": 50}], metrics={"every_s": 1}
    )
    other = target.robot("bench-hostile")
    topic = build_topic(LIVE, other.robot, VESC_STREAM, target.cloud.namespace)
    found: dict[str, list[list[float]]] = {kind: [] for kind in KINDS}
    with (
        target.listener(car.robot) as listener,
        Driving(car),
        RawClient(other.folder) as client,
    ):
        began = time.monotonic()
        while not listener.heard:
            if time.monotonic() - began > _WARM_UP_S:
                raise BenchError("no live update was heard")
            threading.Event().wait(0.1)
        # Once each beforehand: clients are made and environments started only the first time.
        for message in KINDS.values():
            _stretch(client, topic, message, 2)
        for _ in range(_REPEATS):
            for kind, message in KINDS.items():
                say(f"the other robot sends {kind}")
                heard = len(listener.heard)
                _stretch(client, topic, message, STRETCH_S)
                found[kind].append([one.delay_ms for one in listener.heard[heard:]])
    report(section, found)
    return section


def _stretch(client: RawClient, topic: str, message: Message | None, seconds: int) -> None:
    began, waiting = time.monotonic(), threading.Event()
    for number in range(seconds * RATE_HZ):
        if message is not None:
            client.publish(topic, message(number))
        waiting.wait(max(0.0, began + (number + 1) / RATE_HZ - time.monotonic()))


def report(section: Section, found: dict[str, list[list[float]]]) -> None:
    """The table and the ratios of the delays in ms, a list a stretch, by what the other robot sent."""
    spreads: dict[str, Spread | None] = {kind: spread(delays) for kind, delays in found.items()}
    section.tables.append(
        Table(
            f"From a car to a PubNub subscriber, while another robot publishes {RATE_HZ} messages a second",
            ["the other robot sends", "updates", "median (p95, p99; range of the medians)"],
            [[kind, str(one.n), one.text()] if one else [kind, "0", "-"] for kind, one in spreads.items()],
        )
    )
    alone = spreads["nothing"]
    for kind, one in spreads.items():
        if one and alone and one is not alone:
            name = f"a car's p95 beside a robot of {RATE_HZ} {kind} a second / alone"
            section.ratios.append(Ratio(name, round(one.p95 / alone.p95, 2), _MOST, tolerance=4.0))
            name = f"updates of the car beside {RATE_HZ} {kind} a second / alone"
            section.ratios.append(Ratio(name, round(one.n / alone.n, 2), 0.9, at_least=True))
    section.raw = dict(found)
