"""Fairness: how one robot at the limit of its connection delays another's live lane, and how its most
expensive batches delay another's summaries.

Only on the embedded cloud: on AWS other sections would share Lambda 1 with what is refused here.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable

from bench.errors import BenchError
from bench.floors.raw_mqtt import RawClient
from bench.load.agent_process import AgentProcess
from bench.load.worst_case import worst_batches
from bench.report.result import Ratio, Section, Table
from bench.report.spread import Spread, spread
from bench.target import Say, Target
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.messages.live import LiveSample, encode_live
from iort_contract.tables import SECOND
from iort_contract.topics import LIVE, build_topic, record_topic
from iort_station.data.batches import summary_table, topic_of

# AWS IoT accepts this many publishes a second from a connection.
RATE_HZ = 100
STRETCH_S = 8
_REPEATS = 2
_MOST = 2.0
_WARM_UP_S = 30.0
# Worst-case batches a second: what a robot may well send, and the most that it can send.
WORST_HZ = (15, 100)
WORST_S = 20
_LOOK_S = 0.05
_BEGUN_S = 10.0

Message = Callable[[int], bytes]


def bad(number: int) -> bytes:
    """Return a message that is no JSON."""
    return b"no JSON %d" % number


def good(number: int) -> bytes:
    """Return a live message with the current time."""
    now_us = time.time_ns() // 1000
    return encode_live(LiveSample("0badcafe", number, now_us, now_us, {"speed": number}))


_ALONE = "nothing"
KINDS: dict[str, Message | None] = {_ALONE: None, "bad messages": bad, "good messages": good}


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
        AgentProcess(car),
        RawClient(other.folder) as client,
    ):
        began = time.monotonic()
        while not listener.heard:
            if time.monotonic() - began > _WARM_UP_S:
                raise BenchError("no live update was heard")
            threading.Event().wait(0.1)
        # Warm up once with each kind: the first message creates clients and environments.
        for message in KINDS.values():
            _stretch(client, topic, message, 2)
        for _ in range(_REPEATS):
            for kind, message in KINDS.items():
                say(f"the other robot sends {kind}")
                heard = len(listener.heard)
                _stretch(client, topic, message, STRETCH_S)
                found[kind].append([one.delay_ms for one in listener.heard[heard:]])
    say("summaries")
    summaries: dict[str, list[list[float]]] = {kind: [] for kind in (_ALONE, *map(_worst, WORST_HZ))}
    with AgentProcess(car), RawClient(other.folder) as client:
        for _ in range(_REPEATS):
            for rate_hz in (0, *WORST_HZ):
                kind = _worst(rate_hz) if rate_hz else _ALONE
                say(f"the other robot sends {kind}")
                summaries[kind].append(_summary_delays(target, car.robot, client, other.robot, rate_hz))
                _forget(target)
    report(section, found)
    report_summaries(section, summaries)
    return section


def _worst(rate_hz: int) -> str:
    return f"{rate_hz} worst-case batches a second"


def _summary_delays(target: Target, car: str, client: RawClient, other: str, rate_hz: int) -> list[float]:
    """Return how long after its end each second of the car is in the summary table, in ms.

    Meanwhile the other robot sends ``rate_hz`` worst-case batches a second.
    """
    topic = record_topic(other, VESC_STREAM, target.cloud.namespace)
    messages = worst_batches(rate_hz * WORST_S, first_us=time.time_ns() // 10**9 * 10**6)
    table, of_car = summary_table(target.cloud), topic_of(target.cloud, car, VESC_STREAM)
    seen: dict[int, float] = {}
    over = threading.Event()

    def watch() -> None:
        while not over.wait(_LOOK_S):
            page = next(table.pages(of_car, attributes=(SECOND,), newest_first=True, page_items=WORST_S))
            now_s = time.time()
            for item in page.items:
                second = int(item[SECOND]["N"])
                # The one after it has come too, or a second may not be over.
                seen.setdefault(second, (now_s - second - 1) * 1000)

    began_s = time.time()
    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        if rate_hz:
            _paced(client, topic, messages, rate_hz)
        else:
            over.wait(WORST_S)
        # Wait for the summaries of the last seconds too.
        deadline = time.monotonic() + _WARM_UP_S
        while int(began_s) + WORST_S not in seen and time.monotonic() < deadline:
            over.wait(_LOOK_S)
    finally:
        over.set()
        watcher.join()
    return [delay for second, delay in sorted(seen.items()) if began_s < second <= began_s + WORST_S]


def _forget(target: Target) -> None:
    """Throw away what was put off, and let what is begun end: it would take its part of this machine from the
    next stretch."""
    queue = target.cloud.output("processing", "PutOffQueue")
    target.cloud.client("sqs").purge_queue(QueueUrl=queue)
    threading.Event().wait(_BEGUN_S)


def _stretch(client: RawClient, topic: str, message: Message | None, seconds: int) -> None:
    if message is None:
        threading.Event().wait(seconds)
    else:
        _paced(client, topic, map(message, range(seconds * RATE_HZ)), RATE_HZ)


def _paced(client: RawClient, topic: str, messages: Iterable[bytes], rate_hz: int) -> None:
    began, waiting = time.monotonic(), threading.Event()
    for number, message in enumerate(messages):
        client.publish(topic, message)
        waiting.wait(max(0.0, began + (number + 1) / rate_hz - time.monotonic()))


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
    alone = spreads[_ALONE]
    for kind, one in spreads.items():
        if one and alone and one is not alone:
            name = f"a car's p95 beside a robot of {RATE_HZ} {kind} a second / alone"
            section.ratios.append(Ratio(name, round(one.p95 / alone.p95, 2), _MOST, tolerance=4.0))
            name = f"updates of the car beside {RATE_HZ} {kind} a second / alone"
            section.ratios.append(Ratio(name, round(one.n / alone.n, 2), 0.9, at_least=True))
    section.raw = dict(found)


def report_summaries(section: Section, found: dict[str, list[list[float]]]) -> None:
    """The table and the ratios of how late summaries are in ms, a list a stretch, by what the other sent."""
    spreads: dict[str, Spread | None] = {kind: spread(delays) for kind, delays in found.items()}
    section.tables.append(
        Table(
            "From the end of a car's second to its summary",
            ["the other robot sends", "seconds", "median (p95, p99; range of the medians)"],
            [[kind, str(one.n), one.text()] if one else [kind, "0", "-"] for kind, one in spreads.items()],
        )
    )
    alone = spreads[_ALONE]
    for kind, one in spreads.items():
        if one and alone and one is not alone:
            name = f"p95 of a car's summaries beside a robot of {kind} / alone"
            section.ratios.append(Ratio(name, round(one.p95 / alone.p95, 2), _MOST, tolerance=2.0))
            name = f"seconds summarised of the car beside {kind} / alone"
            section.ratios.append(Ratio(name, round(one.n / alone.n, 2), 0.9, at_least=True))
    section.raw = {**section.raw, **{f"summaries, {kind}": delays for kind, delays in found.items()}}
