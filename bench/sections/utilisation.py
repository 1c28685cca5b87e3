"""Table 6.5: the time and processor time of the functions and of the robot's node.

On AWS durations come from Lambda's REPORT lines. The embedded cloud gives every function a whole core,
whatever its memory size: there the operating system measures the processor time. Beside the functions run
their floors (`bench.floors`), with the same events in turns. Cold starts are a section of their own."""

from __future__ import annotations

import base64
import inspect
import json
import re
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from itertools import count
from statistics import median
from typing import Any

from bench import thesis
from bench.floors import live as live_floor
from bench.floors import summarize as summarize_floor
from bench.load import stored_drive
from bench.load.counting import process
from bench.report import NOT_MEASURED, Section, ratio, text
from bench.sections import Declared
from iort_agent.sources.sim import Sensors
from iort_agent.sources.sim.vehicle import Vehicle, VehicleConfig
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.cloud import pubnub_parameter
from iort_contract.codec import DICTIONARY
from iort_contract.messages.envelope import rule_event
from iort_contract.messages.live import LiveSample, encode_live
from iort_contract.tables import BATCH, TOPIC
from iort_contract.topics import LIVE, RECORD, build_topic
from testkit import machine
from testkit.car import RATE_HZ
from testkit.target import Say, Target, configure, temporary_function
from testkit.waiting import InstrumentError

ROBOT = "bench-functions"
ROUNDS, CALLS, BATCHES = 3, 60, 100
_LIVE, _ONE, _EMPTY = "Lambda 1 (live)", "Lambda 2, an event of 1 batch", "empty function"
_BACKLOG, _FLOOR = f"Lambda 2, an event of {BATCHES} batches", "floor of "
# The most that a function may take of its floor's processor time, without the empty function's.
_MOST = 3.0
_THESIS = {_LIVE: thesis.LAMBDA_1, _ONE: thesis.LAMBDA_2}
# What an invocation costs by itself.
_NOTHING = "def handler(event, context):\n    return None\n"
_REPORT = re.compile(r"^REPORT .*?\tDuration: ([\d.]+) ms.*", re.MULTILINE)
# Time enough that a robot's share of Lambda 2 is whole again.
_ARRIVES_EVERY_S = 10
# Makes the event of an invocation, by its number in the round.
Event = Callable[[int], dict[str, Any]]


@dataclass
class Measured:
    """A function's durations on AWS in ms, a list a round; and on the embedded cloud its processor time an
    invocation, in ms for each round."""

    duration_ms: list[list[float]] = field(default_factory=list)
    cpu_ms: list[float] = field(default_factory=list)


def measure(target: Target, function: str, event: Event, calls: int, measured: Measured) -> None:
    """Invoke the function ``calls`` times, one after the other, and add the round to ``measured``."""
    before = _cpu(target)
    durations_ms = [invoke(target, function, event(i)) for i in range(calls)]
    if target.embedded is not None:
        measured.cpu_ms.append(machine.spent_ms(before, _cpu(target)) / calls)
    measured.duration_ms.append([duration for duration in durations_ms if duration is not None])


def _cpu(target: Target) -> dict[int, int]:
    pids = machine.descendants(target.embedded.emulator.pid) if target.embedded else []
    return machine.threads_ns(pids)


def invoke(target: Target, function: str, event: dict[str, Any]) -> float | None:
    """Run the function once; return its duration, which AWS' answer has. Raises `InstrumentError`."""
    answer = target.cloud.client("lambda").invoke(
        FunctionName=function, Payload=json.dumps(event).encode(), LogType="Tail"
    )
    if "FunctionError" in answer:
        raise InstrumentError(f"{function}: {answer['Payload'].read()[:400]!r}")
    return duration_ms(base64.b64decode(answer.get("LogResult", "")).decode(errors="replace"))


def duration_ms(log: str) -> float | None:
    """Return the duration in the REPORT line of an invocation's log, if there is one."""
    match = _REPORT.search(log)
    return None if match is None else float(match[1])


@contextmanager
def reporting(target: Target, function: str) -> Iterator[None]:
    """Have AWS write REPORT lines; the stacks leave them out (`function_logs`)."""
    client = target.cloud.client("lambda")
    was = client.get_function_configuration(FunctionName=function).get("LoggingConfig", {})
    if target.embedded is not None or was.get("LogFormat") != "JSON":
        yield
        return
    try:
        configure(client, function, LoggingConfig={"LogFormat": "Text", "LogGroup": was["LogGroup"]})
        yield
    finally:
        configure(client, function, LoggingConfig=was)


def stream_event(items: Sequence[dict[str, Any]], number: int = 0) -> dict[str, Any]:
    """Stored batches as the telemetry table's stream brings them. The events of a drive arrive one after the
    other, by their ``number``, so that no robot is over its share."""
    records = [
        {
            "eventID": f"bench-{i}",
            "eventName": "INSERT",
            "eventSource": "aws:dynamodb",
            "dynamodb": {
                "ApproximateCreationDateTime": int(time.time()) + number * _ARRIVES_EVERY_S,
                "Keys": {name: item[name] for name in (TOPIC, BATCH)},
                "NewImage": item,
                "SequenceNumber": f"{i + 1:021}",
                "StreamViewType": "NEW_IMAGE",
            },
        }
        for i, item in enumerate(items)
    ]
    return {"Records": records}


def live_event(topic: str, number: int) -> dict[str, Any]:
    """A live message of a VESC, as the live rule sends it to Lambda 1."""
    now_us = time.time_ns() // 1000
    sample = Sensors(Vehicle(VehicleConfig(), seed=1), seed=1).vesc()
    message = encode_live(LiveSample("0badcafe", number, now_us - 1000, now_us, sample))
    return rule_event(message, topic, now_us // 1000)


def run(target: Target, say: Say) -> Section:
    """Invoke the functions in turns; then the node's cycle."""
    robot = target.name(ROBOT)
    say("storing a drive")
    batches = stored_drive.store(target, robot, stored_drive.simulated(BATCHES * RATE_HZ))
    arrivals, topic = count(), build_topic(LIVE, robot, VESC_STREAM, target.cloud.namespace)
    # The newest batch alone is what a driving car makes of the stream; all of them, a backlog.
    events: dict[str, Event] = {
        _LIVE: lambda number: live_event(topic, number),
        _ONE: lambda _: stream_event(batches[-1:], next(arrivals)),
        _BACKLOG: lambda _: stream_event(batches, next(arrivals)),
    }
    with ExitStack() as stack:
        names = _deploy(target, stack)
        events = {name: events.get(name.removeprefix(_FLOOR), lambda _: {}) for name in names}
        for function in sorted(set(names.values())):
            stack.enter_context(reporting(target, function))
        for name, event in events.items():
            invoke(target, names[name], event(0))
        measured = {name: Measured() for name in names}
        for turn in range(ROUNDS):
            for name, event in events.items():
                say(f"{name}, {turn + 1} of {ROUNDS}")
                calls = CALLS // 10 if _BACKLOG in name else CALLS
                measure(target, names[name], event, calls, measured[name])
    say("the node's cycle")
    with process("bench.ros.cycle", "5000") as objects:
        return report(measured, next(objects))


def report(measured: dict[str, Measured], cycle: dict[str, float]) -> Section:
    """Make the section of the functions and the node's cycle, in ms."""
    section, rows = Section("utilisation", "Utilisation (table 6.5)"), []
    for name, one in measured.items():
        cpu = f"{median(one.cpu_ms):.2f} ms" if one.cpu_ms else NOT_MEASURED
        rows.append([name, text(one.duration_ms), cpu, _THESIS.get(name, NOT_MEASURED)])
    node = f"{cycle['p50']:.4f} ms (p95 {cycle['p95']:.4f})"
    rows.append(["robot's node, a cycle", node, "", f"{thesis.NODE_CYCLE_MS} ms"])
    head = ["function", "duration, warm: median (p95)", "processor time", "thesis, 2018"]
    section.table("An invocation", head, rows)
    beyond = {
        name: [[ours - empty] for ours, empty in zip(one.cpu_ms, measured[_EMPTY].cpu_ms, strict=True)]
        for name, one in measured.items()
    }
    for name in (_LIVE, _ONE, _BACKLOG):
        times = ratio(beyond[name], beyond[_FLOOR + name])
        section.ratio(f"{name}: processor / its floor", times, _MOST, tolerance=1.6)
    cycles = cycle["p50"] / thesis.NODE_CYCLE_MS
    section.ratio("node's cycle / thesis' 2 ms", cycles, 0.05, tolerance=3, by_machine=True)
    section.raw = {"warm": {name: asdict(one) for name, one in measured.items()}, "cycle_ms": cycle}
    return section


def _deploy(target: Target, stack: ExitStack) -> dict[str, str]:
    """The functions by name, each with its floor after it, and the empty one; what is not ours stays until
    the stack ends."""
    cloud = target.cloud
    live, summarize = (cloud.output("processing", f"{name}Function") for name in ("Live", "Summarize"))
    topic = build_topic(RECORD, target.name(f"{ROBOT}-floor"), VESC_STREAM, cloud.namespace)

    def deployed(name: str, source: str, like: str, **variables: str) -> str:
        function = temporary_function(target, name, source, memory_mb=256, like=like, variables=variables)
        return stack.enter_context(function)

    live_source, summarize_source = map(inspect.getsource, (live_floor, summarize_floor))
    parameter, table = pubnub_parameter(cloud.namespace), cloud.output("storage", "SummaryTable")
    variables = {"DICTIONARY": DICTIONARY.decode(), "TABLE": table, "TOPIC": topic}
    floor = deployed("summarize_floor", summarize_source, "Summarize", **variables)
    return {
        _LIVE: live,
        _FLOOR + _LIVE: deployed("live_floor", live_source, "Live", PUBNUB_PARAMETER=parameter),
        _ONE: summarize,
        _FLOOR + _ONE: floor,
        _BACKLOG: summarize,
        _FLOOR + _BACKLOG: floor,
        _EMPTY: deployed("empty", _NOTHING, "Echo"),
    }


SECTION = Declared("functions and node, beside their floors", run, dollars=0.01)
