"""Fairness: how one robot at the limit of its connection delays another's live lane, and how its most
expensive batches delay another's summaries.

Only on the embedded cloud: on AWS the messages refused would count against the account's alarms.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable

from bench.floors.raw_mqtt import RawClient
from bench.report import Section, spread
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
_ALONE = "nothing"
# Values in ms by what the other robot sent, a list a stretch.
Delays = dict[str, list[list[float]]]


def bad(number: int) -> bytes:
    """Return a message that is no JSON."""
    return b"no JSON %d" % number


def good(number: int) -> bytes:
    """Return a live message with the current time."""
    now_us = time.time_ns() // 1000
    return encode_live(LiveSample("0badcafe", number, now_us, now_us, {"speed": number}))


KINDS: dict[str, Callable[[int], bytes] | None] = {
    _ALONE: None,
    f"{RATE_HZ} bad messages a second": bad,
    f"{RATE_HZ} good messages a second": good,
}
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
    updates: Delays = {kind: [] for kind in KINDS}
    summaries: Delays = {kind: [] for kind in WORST}
    with target.listener(car.robot) as listener, AgentProcess(car), RawClient(other.folder) as client:

        def stretch(message: Callable[[int], bytes] | None, seconds: int) -> None:
            if message is None:
                threading.Event().wait(seconds)
            else:
                _paced(client, topic, map(message, range(seconds * RATE_HZ)), RATE_HZ)

        until(lambda: listener.heard, "the first live update")
        # Warm up once with each kind: the first message creates clients and environments.
        for message in KINDS.values():
            stretch(message, 2)
        for _ in range(_REPEATS):
            for kind, message in KINDS.items():
                say(f"the other robot sends {kind}")
                heard = len(listener.heard)
                stretch(message, STRETCH_S)
                updates[kind].append([update.delay_ms for update in listener.heard[heard:]])
    say("summaries")
    with AgentProcess(car), RawClient(other.folder) as client:
        for _ in range(_REPEATS):
            for kind, rate_hz in WORST.items():
                say(f"the other robot sends {kind}")
                summaries[kind].append(_summary_delays(target, car.robot, client, other.robot, rate_hz))
                # What was put off would slow the next stretch, and so would what is in work.
                queue = target.cloud.output("processing", "PutOffQueue")
                target.cloud.client("sqs").purge_queue(QueueUrl=queue)
                threading.Event().wait(_BEGUN_S)
    report(section, updates, "From a car to a PubNub subscriber", "a car's p95", "updates of the car", 4.0)
    report(
        section,
        summaries,
        "From the end of a car's second to its summary",
        "p95 of a car's summaries",
        "seconds summarised of the car",
        2.0,
    )
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


def _paced(client: RawClient, topic: str, messages: Iterable[bytes], rate_hz: int) -> None:
    began, waiting = time.monotonic(), threading.Event()
    for number, message in enumerate(messages):
        client.publish(topic, message)
        waiting.wait(max(0.0, began + (number + 1) / rate_hz - time.monotonic()))


def report(  # noqa: PLR0917 - two calls
    section: Section, delays: Delays, title: str, late: str, counted: str, tolerance: float
) -> None:
    """Add a table, and for each kind a ratio of delays and one of counts to those of a car alone."""
    spreads = {kind: spread(values) for kind, values in delays.items()}
    rows = [[kind, str(one.n), one.text(2)] for kind, one in spreads.items()]
    section.table(title, ["another robot sends", "n", "median (p95)"], rows)
    alone = spreads.pop(_ALONE)
    for kind, one in spreads.items():
        if one.p95 and alone.p95:
            name = f"{late} beside a robot of {kind} / alone"
            section.ratio(name, one.p95 / alone.p95, _MOST, tolerance=tolerance)
            section.ratio(f"{counted} beside {kind} / alone", one.n / alone.n, 0.9, at_least=True)
    section.raw[title] = delays


SECTION = Declared("one robot at the limit beside another", run)
