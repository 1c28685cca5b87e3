"""Fairness: how one robot at the limit of its connection delays another's live lane, and how its most
expensive batches delay another's summaries.

Only on the embedded cloud: on AWS other sections would share Lambda 1 with what is refused here.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable

from bench.floors.raw_mqtt import RawClient
from bench.report import NOT_MEASURED, Section, spread
from bench.sections import Declared
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.messages.live import LiveSample, encode_live
from iort_contract.tables import SECOND
from iort_contract.topics import LIVE, build_topic, record_topic
from iort_station.data.recorded import summary_table, topic_of
from testkit.car import AgentProcess
from testkit.target import Say, Target
from testkit.waiting import reached, until
from testkit.worst_case import worst_batches

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
# Values in ms by what the other robot sent, a list a stretch.
Delays = dict[str, list[list[float]]]


def bad(number: int) -> bytes:
    """Return a message that is no JSON."""
    return b"no JSON %d" % number


def good(number: int) -> bytes:
    """Return a live message with the current time."""
    now_us = time.time_ns() // 1000
    return encode_live(LiveSample("0badcafe", number, now_us, now_us, {"speed": number}))


_ALONE = "nothing"
KINDS: dict[str, Message | None] = {_ALONE: None, "bad messages": bad, "good messages": good}
WORST = {_ALONE: 0, **{f"{rate_hz} worst-case batches a second": rate_hz for rate_hz in WORST_HZ}}


def run(target: Target, say: Say) -> Section:
    """Drive one car, its live lane at 10 Hz, while another robot sends nothing, bad, or good messages."""
    section = Section("fairness", "Fairness: one robot at the limit of its connection")
    if target.embedded is None:
        section.notes.append("Not run on AWS: the messages refused would count against your alarms.")
        return section
    car = target.robot(
        "bench-fair",
        sources=[{"type": "sim", "stream": VESC_STREAM, "rate_hz": 50, "pose": {"rate_hz": 0}}],
        metrics={"every_s": 1},
        live={"when": "always"},
    )
    other = target.robot("bench-hostile")
    topic = build_topic(LIVE, other.robot, VESC_STREAM, target.cloud.namespace)
    found: Delays = {kind: [] for kind in KINDS}
    with target.listener(car.robot) as listener, AgentProcess(car), RawClient(other.folder) as client:
        until(lambda: listener.heard, "the first live update")
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
    summaries: Delays = {kind: [] for kind in WORST}
    with AgentProcess(car), RawClient(other.folder) as client:
        for _ in range(_REPEATS):
            for kind, rate_hz in WORST.items():
                say(f"the other robot sends {kind}")
                summaries[kind].append(_summary_delays(target, car.robot, client, other.robot, rate_hz))
                _forget(target)
    report(section, found)
    report_summaries(section, summaries)
    return section


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
        reached(lambda: int(began_s) + WORST_S in seen, within_s=_WARM_UP_S, poll_s=_LOOK_S)
    finally:
        over.set()
        watcher.join()
    return [delay for second, delay in sorted(seen.items()) if began_s < second <= began_s + WORST_S]


def _forget(target: Target) -> None:
    """Delete the batches that were put off, and wait for those in work: they would slow the next stretch."""
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


def report(section: Section, found: Delays) -> None:
    """Add how late the car's updates were."""
    title = f"From a car to a PubNub subscriber, while another robot publishes {RATE_HZ} messages a second"
    names = (
        f"a car's p95 beside a robot of {RATE_HZ} {{}} a second",
        f"updates of the car beside {RATE_HZ} {{}} a second",
    )
    _add(section, found, (title, "updates"), names, tolerance=4.0)
    section.raw = dict(found)


def report_summaries(section: Section, found: Delays) -> None:
    """Add how late the car's summaries were."""
    names = "p95 of a car's summaries beside a robot of {}", "seconds summarised of the car beside {}"
    _add(section, found, ("From the end of a car's second to its summary", "seconds"), names, tolerance=2.0)
    section.raw = {**section.raw, **{f"summaries, {kind}": delays for kind, delays in found.items()}}


def _add(
    section: Section, found: Delays, table: tuple[str, str], names: tuple[str, str], *, tolerance: float
) -> None:
    """Add a table, and for each kind a ratio of delays and one of counts to those of a car alone."""
    spreads = {kind: spread(delays) for kind, delays in found.items()}
    title, counted = table
    section.table(
        title,
        ["the other robot sends", counted, "median (p95, p99; range of the medians)"],
        [
            [kind, *((str(one.n), one.text()) if one else ("0", NOT_MEASURED))]
            for kind, one in spreads.items()
        ],
    )
    alone = spreads[_ALONE]
    for kind, one in spreads.items():
        if one and alone and one is not alone:
            late, count = (f"{name.format(kind)} / alone" for name in names)
            section.ratio(late, round(one.p95 / alone.p95, 2), _MOST, tolerance=tolerance)
            section.ratio(count, round(one.n / alone.n, 2), 0.9, at_least=True)


SECTION = Declared("one robot at the limit beside another", run)
