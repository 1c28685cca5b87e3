"""Table 6.5: the time and processor time of the functions and of the robot's node.

Durations come from Lambda's REPORT lines. The embedded cloud gives every function a whole core, whatever its
memory size. So there the operating system also measures processor time, which is projected to each memory
size. On AWS each size is set and measured.

Beside the functions run their floors (`bench.floors.functions`), with the same events in turns."""

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

from bench import plots, thesis
from bench.floors import live as live_floor
from bench.floors import summarize as summarize_floor
from bench.load import stored_drive
from bench.load.counting import process
from bench.report import NOT_MEASURED, Section, ratio, spread
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
from testkit.waiting import InstrumentError, reached

_LOGS_S = 60.0
_REPORT = re.compile(r"^REPORT .*?\tDuration: ([\d.]+) ms.*", re.MULTILINE)
_INIT = re.compile(r"Init Duration: ([\d.]+) ms")

# Makes the event of an invocation, by its number in the round.
Event = Callable[[int], dict[str, Any]]


@dataclass
class Measured:
    """The figures of one function in ms.

    ``duration_ms`` has a list for each round. ``cpu_ms`` has the processor time an invocation for each round,
    on the embedded cloud. ``init_ms`` has the start times of new environments.
    """

    duration_ms: list[list[float]] = field(default_factory=list)
    cpu_ms: list[float] = field(default_factory=list)
    init_ms: list[float] = field(default_factory=list)


def measure(target: Target, function: str, event: Event, calls: int, found: Measured) -> None:
    """Invoke the function ``calls`` times, one after the other, and add the round to ``found``.

    Raises `InstrumentError` where an invocation fails, or no REPORT line comes.
    """
    began_ms = int(time.time() * 1000)
    before = _cpu(target)
    answers = [invoke(target, function, event(i)) for i in range(calls)]
    if target.embedded is not None:
        found.cpu_ms.append(machine.spent_ms(before, _cpu(target)) / calls)
    # AWS' answers end with the REPORT line; the embedded cloud writes it to the log, which nobody else uses.
    reports = [line for line in answers if line is not None]
    if len(reports) < calls:
        reports = _logged(target, function, began_ms, calls)
    found.duration_ms.append([float(match[1]) for line in reports if (match := _REPORT.match(line))])
    found.init_ms += [float(match[1]) for line in reports if (match := _INIT.search(line))]


def _cpu(target: Target) -> dict[int, int]:
    pids = machine.descendants(target.embedded.emulator.pid) if target.embedded else []
    return machine.threads_ns(pids)


def invoke(target: Target, function: str, event: dict[str, Any]) -> str | None:
    """Run the function once; return its REPORT line, if the answer has it. Raises `InstrumentError`."""
    answer = target.cloud.client("lambda").invoke(
        FunctionName=function, Payload=json.dumps(event).encode(), LogType="Tail"
    )
    if "FunctionError" in answer:
        raise InstrumentError(f"{function}: {answer['Payload'].read()[:400]!r}")
    return report_line(base64.b64decode(answer.get("LogResult", "")).decode(errors="replace"))


def report_line(tail: str) -> str | None:
    """Return the REPORT line of an invocation's log, if there is one."""
    match = _REPORT.search(tail)
    return None if match is None else match[0]


def _logged(target: Target, function: str, began_ms: int, calls: int) -> list[str]:
    """Wait for the REPORT lines since ``began_ms`` in the function's log, and return them."""
    configuration = target.cloud.client("lambda").get_function_configuration(FunctionName=function)
    group = configuration.get("LoggingConfig", {}).get("LogGroup", f"/aws/lambda/{function}")
    logs = target.cloud.client("logs").get_paginator("filter_log_events")
    reports: list[str] = []

    def all_there() -> bool:
        pages = logs.paginate(logGroupName=group, startTime=began_ms, filterPattern="REPORT")
        lines = (event["message"] for page in pages for event in page["events"])
        reports[:] = [line for line in lines if _REPORT.match(line)]
        return len(reports) >= calls

    if not reached(all_there, within_s=_LOGS_S, poll_s=0.5) and not reports:
        raise InstrumentError(
            f"{group} has no REPORT line after {_LOGS_S:.0f} s: deploy with function_logs=all"
        )
    return reports


@contextmanager
def reporting(target: Target, function: str) -> Iterator[None]:
    """Have Lambda write REPORT lines; the stacks leave them out (`function_logs`)."""
    client = target.cloud.client("lambda")
    was = client.get_function_configuration(FunctionName=function).get("LoggingConfig", {})
    if was.get("LogFormat") != "JSON":
        yield
        return
    try:
        configure(client, function, LoggingConfig={"LogFormat": "Text", "LogGroup": was["LogGroup"]})
        yield
    finally:
        configure(client, function, LoggingConfig=was)


# Time enough that a robot's share of Lambda 2 is whole again.
_ARRIVES_EVERY_S = 10


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


SIZES_MB = (128, 256, 512, 1024, 1769)
# "At 1,769 MB, a function has the equivalent of one vCPU": Lambda, "Configure memory".
ONE_VCPU_MB = 1769
ROBOT = "bench-functions"
ROUNDS = 3
CALLS = 60
BATCHES = 100
_LIVE, _ONE, _EMPTY = "Lambda 1 (live)", "Lambda 2, an event of 1 batch", "empty function"
_BACKLOG, _FLOOR = f"Lambda 2, an event of {BATCHES} batches", "floor of "
# A function, and the most that it may take of its floor's processor time, without the empty function's.
_MOST = {_LIVE: 3.0, _ONE: 3.0, _BACKLOG: 3.0}
_THESIS = {_LIVE: f"{thesis.LAMBDA_1[256]} (256 MB)", _ONE: thesis.LAMBDA_2}
# What an invocation costs by itself.
_NOTHING = "def handler(event, context):\n    return None\n"


def run(target: Target, say: Say) -> Section:
    """Invoke the functions in turns, warm and cold; then the node's cycle."""
    section, robot = Section("utilisation", "Utilisation (table 6.5)"), target.name(ROBOT)
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
        # Each function, and its floor after it.
        events = {name: events.get(name.removeprefix(_FLOOR), lambda _: {}) for name in names}
        for function in sorted(set(names.values())):
            stack.enter_context(reporting(target, function))
        for name, event in events.items():
            invoke(target, names[name], event(0))
        found = {name: Measured() for name in names}
        for turn in range(ROUNDS):
            for name, event in events.items():
                say(f"{name}, warm, {turn + 1} of {ROUNDS}")
                calls = CALLS // 10 if _BACKLOG in name else CALLS
                measure(target, names[name], event, calls, found[name])
        sizes = _memory_sizes(target, names[_LIVE], events[_LIVE], say)
        cold = {name: _cold(target, names[name], events[name], say) for name in (_LIVE, _ONE, _EMPTY)}
    say("the node's cycle")
    report(section, found, cold, sizes, _cycle())
    return section


def report(
    section: Section,
    found: dict[str, Measured],
    cold: dict[str, Measured],
    sizes: dict[int, Measured],
    cycle: dict[str, float],
) -> None:
    """Add the tables, the picture and the ratios."""
    rows = [
        [
            name,
            _duration(one),
            f"{median(one.cpu_ms):.2f} ms" if one.cpu_ms else NOT_MEASURED,
            _cold_text(cold[name]) if name in cold else NOT_MEASURED,
            _THESIS.get(name, NOT_MEASURED),
        ]
        for name, one in found.items()
    ]
    node = f"{cycle['p50']:.4f} ms (p95 {cycle['p95']:.4f})"
    rows.append(["robot's node, a cycle", node, "", "", f"{thesis.NODE_CYCLE_MS} ms"])
    head = ["function", "duration, warm: median (p95, p99)", "processor time", "cold", "thesis, 2018"]
    section.table("An invocation", head, rows)
    if sizes:
        rows = [
            [f"{mb} MB", _duration(one), thesis.LAMBDA_1.get(mb, NOT_MEASURED)] for mb, one in sizes.items()
        ]
        section.table("Lambda 1 by memory size", ["memory", "duration, warm", "thesis, 2018"], rows)
    else:
        title = "Projection, not a measurement: processor time by the share of a vCPU of each memory size"
        rows = [[name, *(f"{ms:.1f} ms" for ms in values)] for name, values in _projected(found).items()]
        section.table(title, ["function", *(f"{size} MB" for size in SIZES_MB)], rows)
        section.notes.append(
            f"On the embedded cloud the memory size changes nothing. The projection is processor time x "
            f"{ONE_VCPU_MB} MB / memory, by AWS' word that {ONE_VCPU_MB} MB have one vCPU; waiting for "
            "DynamoDB or PubNub is not in it, and this machine's core is not AWS'."
        )
    for name, most in _MOST.items():
        times = ratio(_beyond(found, name), _beyond(found, _FLOOR + name))
        section.ratio(f"{name}: processor / its floor", times and round(times, 2), most, tolerance=1.6)
    cycles = round(cycle["p50"] / thesis.NODE_CYCLE_MS, 5)
    section.ratio("node's cycle / thesis' 2 ms", cycles, 0.05, tolerance=3, by_machine=True)
    if figures := {name: median(one.cpu_ms) for name, one in found.items() if one.cpu_ms}:
        section.plot("utilisation", "Processor time an invocation, warm", plots.bars(figures, unit="ms"))
    section.raw = {
        "warm": {name: asdict(one) for name, one in found.items()},
        "cold": {name: asdict(one) for name, one in cold.items()},
        "memory": {str(mb): asdict(one) for mb, one in sizes.items()},
        "cycle_ms": cycle,
    }


def _beyond(found: dict[str, Measured], name: str) -> list[list[float]]:
    """The processor time of an invocation beyond an empty one, in ms for each round."""
    return [[ours - empty] for ours, empty in zip(found[name].cpu_ms, found[_EMPTY].cpu_ms, strict=True)]


def _projected(found: dict[str, Measured]) -> dict[str, list[float]]:
    return {
        name: [median(one.cpu_ms) * max(1.0, ONE_VCPU_MB / size) for size in SIZES_MB]
        for name, one in found.items()
        if one.cpu_ms
    }


def _duration(one: Measured) -> str:
    shown = spread(one.duration_ms)
    return shown.text() if shown else NOT_MEASURED


def _cold_text(one: Measured) -> str:
    first = median(value for values in one.duration_ms for value in values)
    if one.init_ms:
        return f"{median(one.init_ms):.0f} ms to start, then {first:.0f} ms"
    spent = f", {median(one.cpu_ms):.0f} ms of processor" if one.cpu_ms else ""
    return f"{first:.0f} ms{spent}"


def _memory_sizes(target: Target, function: str, event: Event, say: Say) -> dict[int, Measured]:
    """Measure Lambda 1 at each memory size, on AWS; restore the size at the end."""
    if target.embedded is not None:
        return {}
    client = target.cloud.client("lambda")
    was = client.get_function_configuration(FunctionName=function)["MemorySize"]
    found = {}
    try:
        for size in SIZES_MB:
            say(f"Lambda 1 at {size} MB")
            configure(client, function, MemorySize=size)
            invoke(target, function, event(0))
            found[size] = Measured()
            measure(target, function, event, CALLS, found[size])
    finally:
        configure(client, function, MemorySize=was)
    return found


def _cold(target: Target, function: str, event: Event, say: Say) -> Measured:
    """Measure first invocations; a changed environment variable starts a new environment."""
    client = target.cloud.client("lambda")
    was = client.get_function_configuration(FunctionName=function).get("Environment", {}).get("Variables", {})
    found = Measured()
    try:
        for turn in range(ROUNDS):
            say(f"{function}, cold, {turn + 1} of {ROUNDS}")
            configure(client, function, Environment={"Variables": {**was, "BENCH_TURN": str(turn)}})
            measure(target, function, event, 1, found)
    finally:
        configure(client, function, Environment={"Variables": was})
    return found


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


def _cycle() -> dict[str, float]:
    with process("bench.ros.cycle", "5000") as objects:
        return next(objects)


SECTION = Declared("functions and node, beside their floors", run)
