"""Table 6.5: what the functions and the robot's node use.

Durations are those of Lambda's REPORT lines in CloudWatch Logs. The embedded cloud runs every function
with the whole of a core whatever its memory, so there processor time is measured as well, by the operating
system, and projected to each memory size; on AWS the sizes are set and measured.
"""

from __future__ import annotations

import base64
import json
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from statistics import median
from typing import Any

from boto3.dynamodb.types import TypeSerializer

from bench import borrowed, cpu, plots
from bench.machine import ROOT
from bench.result import NOT_MEASURED, Plot, Ratio, Section, Table
from bench.spread import spread
from bench.target import Say, Target
from contract import (
    EXPIRES_S,
    LIVE,
    RECEIVED_MS,
    RECORD,
    T_US,
    TOPIC,
    VESC_STREAM,
    Batch,
    LiveSample,
    build_topic,
    encode,
    encode_live,
    live_event,
)
from device.sources.vehicle import Vehicle, VehicleConfig
from station import delivery

SIZES_MB = (128, 256, 512, 1024, 1769)
# "At 1,769 MB, a function has the equivalent of one vCPU": Lambda, "Configure memory".
ONE_VCPU_MB = 1769
ROBOT = "bench-functions"
ROUNDS = 3
CALLS = 60
BATCHES = 100
_CATCH_UP_S = 60.0
_LOGS_S = 60.0
_REPORT = re.compile(r"^REPORT .*?\tDuration: ([\d.]+) ms.*", re.MULTILINE)
_INIT = re.compile(r"Init Duration: ([\d.]+) ms")
# What an invocation costs by itself.
_EMPTY = "def handler(event, context):\n    return None\n"


@dataclass
class Measured:
    """Of one function: milliseconds an invocation, a list a round."""

    duration_ms: list[list[float]] = field(default_factory=list)
    cpu_ms: list[float] = field(default_factory=list)
    init_ms: list[float] = field(default_factory=list)


def run(target: Target, say: Say) -> Section:
    """Invoke the functions in turns, warm and cold; then the node's cycle."""
    section = Section("utilisation", "Utilisation (table 6.5)")
    batches = _store(target, say)
    # The newest batch alone is what a driving car makes of the stream; all of them, a backlog.
    one, many = _stream_event(batches[-1:]), _stream_event(batches)
    events: dict[str, Callable[[int], dict[str, Any]]] = {
        "Lambda 1 (live)": lambda i: _live_event(target, i),
        "Lambda 2, an event of 1 batch": lambda _: one,
        f"Lambda 2, an event of {BATCHES} batches": lambda _: many,
    }
    live = target.cloud.output("processing", "LiveFunction")
    summarize = target.cloud.output("processing", "SummarizeFunction")
    with borrowed.function(target, "empty", _EMPTY, memory_mb=256) as empty, ExitStack() as reports:
        names = dict(zip(events, (live, summarize, summarize), strict=True))
        events["empty function"], names["empty function"] = (lambda _: {}), empty
        for name in sorted(set(names.values())):
            reports.enter_context(_reporting(target, name))
        found = {name: Measured() for name in events}
        for name, event in events.items():
            _invoke(target, names[name], event(0))
        for turn in range(ROUNDS):
            for name, event in events.items():
                say(f"{name}, warm, {turn + 1} of {ROUNDS}")
                calls = CALLS // 10 if "100" in name else CALLS
                _measure(target, names[name], event, calls, found[name])
        sizes = _memory_sizes(target, live, events["Lambda 1 (live)"], say)
        cold = {
            name: _cold(target, names[name], event, say)
            for name, event in events.items()
            if "100" not in name
        }
    say("the node's cycle")
    cycle = _cycle()
    _report(section, found, cold, sizes, cycle)
    return section


def _report(
    section: Section,
    found: dict[str, Measured],
    cold: dict[str, Measured],
    sizes: dict[int, Measured],
    cycle: dict[str, float],
) -> None:
    rows = []
    for name, one in found.items():
        frozen = cold.get(name)
        rows.append(
            [
                name,
                _duration(one),
                f"{median(one.cpu_ms):.2f} ms" if one.cpu_ms else NOT_MEASURED,
                _cold_text(frozen) if frozen else NOT_MEASURED,
                "12 ms" if "1 batch" in name else NOT_MEASURED,
            ]
        )
    rows.append(["robot's node, a cycle", f"{cycle['p50']:.4f} ms (p95 {cycle['p95']:.4f})", "", "", "2 ms"])
    section.tables.append(
        Table(
            "An invocation",
            ["function", "duration, warm: median (p95, p99)", "processor time", "cold", "thesis, 2018"],
            rows,
        )
    )
    projected = _projected(found)
    if not sizes:
        section.tables.append(
            Table(
                "Projection, not a measurement: processor time by the share of a vCPU of each memory size",
                ["function", *(f"{size} MB" for size in SIZES_MB)],
                [[name, *(f"{ms:.1f} ms" for ms in values)] for name, values in projected.items()],
            )
        )
        section.notes.append(
            f"On the embedded cloud the memory size changes nothing. The projection is processor time x "
            f"{ONE_VCPU_MB} MB / memory, by AWS' word that {ONE_VCPU_MB} MB have one vCPU; waiting for "
            "DynamoDB or PubNub is not in it, and this machine's core is not AWS'."
        )
    else:
        section.tables.append(
            Table(
                "Lambda 1 by memory size",
                ["memory", "duration, warm"],
                [[f"{mb} MB", _duration(one)] for mb, one in sizes.items()],
            )
        )
    _ratios(section, found, cycle)
    figures = {name: median(one.cpu_ms) for name, one in found.items() if one.cpu_ms}
    if figures:
        title = "Processor time an invocation, warm"
        section.plots.append(Plot("utilisation", title, plots.bars(title, figures, unit="ms")))
    section.raw = {
        "warm": {name: asdict(one) for name, one in found.items()},
        "cold": {name: asdict(one) for name, one in cold.items()},
        "memory": {str(mb): asdict(one) for mb, one in sizes.items()},
        "cycle_ms": cycle,
    }


def _ratios(section: Section, found: dict[str, Measured], cycle: dict[str, float]) -> None:
    live, empty = found["Lambda 1 (live)"], found["empty function"]
    if live.cpu_ms and empty.cpu_ms:
        beyond = median(a - b for a, b in zip(live.cpu_ms, empty.cpu_ms, strict=True))
        section.ratios.append(
            Ratio(
                "Lambda 1 warm, processor time beyond an empty function",
                round(beyond, 3),
                3.0,
                "ms",
                tolerance=1.6,
                by_machine=True,
            )
        )
    many = found[f"Lambda 2, an event of {BATCHES} batches"]
    if many.cpu_ms:
        each = median(a - b for a, b in zip(many.cpu_ms, empty.cpu_ms, strict=True)) / BATCHES
        section.ratios.append(
            Ratio(
                "Lambda 2, processor time a batch of 50 samples",
                round(each, 3),
                1.0,
                "ms",
                tolerance=1.6,
                by_machine=True,
            )
        )
    section.ratios.append(
        Ratio("node's cycle / thesis' 2 ms", round(cycle["p50"] / 2, 5), 0.05, tolerance=3, by_machine=True)
    )


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


def _measure(
    target: Target, function: str, event: Callable[[int], dict[str, Any]], calls: int, found: Measured
) -> None:
    began_ms = int(time.time() * 1000)
    before = _cpu(target)
    told = [_invoke(target, function, event(i)) for i in range(calls)]
    after = _cpu(target)
    if before is not None and after is not None:
        found.cpu_ms.append(cpu.spent_ms(before, after) / calls)
    # AWS' answers end with the REPORT line; the embedded cloud's are in its log, where nobody else's are.
    reports = [line for line in told if line is not None]
    if len(reports) < calls:
        reports = _logged(target, function, began_ms, calls)
    found.duration_ms.append([float(match[1]) for line in reports if (match := _REPORT.match(line))])
    found.init_ms += [float(match[1]) for line in reports if (match := _INIT.search(line))]


def _cpu(target: Target) -> dict[int, int] | None:
    return None if target.embedded is None else cpu.of_tree(target.embedded.emulator.pid)


def _invoke(target: Target, function: str, event: dict[str, Any]) -> str | None:
    """Run the function once and wait; its REPORT line, if the answer has it. Raises RuntimeError where it
    fails."""
    answer = target.cloud.client("lambda").invoke(
        FunctionName=function, Payload=json.dumps(event).encode(), LogType="Tail"
    )
    if "FunctionError" in answer:
        raise RuntimeError(f"{function}: {answer['Payload'].read()[:400]!r}")
    return report_line(base64.b64decode(answer.get("LogResult", "")).decode(errors="replace"))


def report_line(tail: str) -> str | None:
    """The REPORT line of an invocation's log, if it is there."""
    match = _REPORT.search(tail)
    return None if match is None else match[0]


def _logged(target: Target, function: str, began_ms: int, calls: int) -> list[str]:
    """The REPORT lines in the function's log since then, once they are all there."""
    client = target.cloud.client("lambda")
    logging = client.get_function_configuration(FunctionName=function).get("LoggingConfig", {})
    group = logging.get("LogGroup", f"/aws/lambda/{function}")
    deadline = time.monotonic() + _LOGS_S
    while True:
        pages = target.cloud.client("logs").get_paginator("filter_log_events")
        lines = [
            event["message"]
            for page in pages.paginate(logGroupName=group, startTime=began_ms, filterPattern="REPORT")
            for event in page["events"]
        ]
        reports = [line for line in lines if _REPORT.match(line)]
        if not reports and time.monotonic() > deadline:
            raise RuntimeError(
                f"{group} has no REPORT line after {_LOGS_S:.0f} s: deploy with function_logs=all"
            )
        if len(reports) >= calls or time.monotonic() > deadline:
            return reports
        # A log tells nobody when it has the next line.
        threading.Event().wait(0.5)


def _memory_sizes(
    target: Target, function: str, event: Callable[[int], dict[str, Any]], say: Say
) -> dict[int, Measured]:
    """Lambda 1 at each memory size, on AWS; the size that was is set again."""
    if target.embedded is not None:
        return {}
    client = target.cloud.client("lambda")
    was = client.get_function_configuration(FunctionName=function)["MemorySize"]
    found = {}
    try:
        for size in SIZES_MB:
            say(f"Lambda 1 at {size} MB")
            _configure(client, function, MemorySize=size)
            _invoke(target, function, event(0))
            found[size] = Measured()
            _measure(target, function, event, CALLS, found[size])
    finally:
        _configure(client, function, MemorySize=was)
    return found


def _cold(target: Target, function: str, event: Callable[[int], dict[str, Any]], say: Say) -> Measured:
    """The first invocation of new environments: another environment variable makes one."""
    client = target.cloud.client("lambda")
    was = client.get_function_configuration(FunctionName=function).get("Environment", {}).get("Variables", {})
    found = Measured()
    try:
        for turn in range(ROUNDS):
            say(f"{function}, cold, {turn + 1} of {ROUNDS}")
            _configure(client, function, Environment={"Variables": {**was, "BENCH_TURN": str(turn)}})
            _measure(target, function, event, 1, found)
    finally:
        _configure(client, function, Environment={"Variables": was})
    return found


def _configure(client: Any, function: str, **change: Any) -> None:
    updated = client.get_waiter("function_updated_v2")
    # An interrupt may have left the change before under way, and AWS refuses one meanwhile.
    updated.wait(FunctionName=function)
    client.update_function_configuration(FunctionName=function, **change)
    updated.wait(FunctionName=function)


@contextmanager
def _reporting(target: Target, function: str) -> Iterator[None]:
    """Have Lambda write its REPORT lines meanwhile, which the stacks leave out (`function_logs`)."""
    client = target.cloud.client("lambda")
    was = client.get_function_configuration(FunctionName=function).get("LoggingConfig", {})
    if was.get("LogFormat") != "JSON":
        yield
        return
    try:
        _configure(client, function, LoggingConfig={"LogFormat": "Text", "LogGroup": was["LogGroup"]})
        yield
    finally:
        _configure(client, function, LoggingConfig=was)


def _store(target: Target, say: Say) -> list[dict[str, Any]]:
    """The items of a drive of 100 s at 50 Hz in the telemetry table; waits until Lambda 2 has seen them."""
    say("storing a drive")
    serialize = TypeSerializer().serialize
    topic = build_topic(RECORD, target.name(ROBOT), VESC_STREAM, target.cloud.namespace)
    vehicle = Vehicle(VehicleConfig(), seed=1)
    first_s = int(time.time()) - BATCHES - 10
    items = []
    for seq in range(BATCHES):
        samples = []
        for _ in range(50):
            vehicle.step(0.02)
            samples.append(vehicle.sample())
        times = [(first_s + seq) * 1_000_000 + i * 20_000 for i in range(50)]
        batch = Batch("0badcafe", seq, times, {name: [s[name] for s in samples] for name in samples[0]})
        item = {**json.loads(encode(batch)), TOPIC: topic, RECEIVED_MS: times[-1] // 1000}
        item[EXPIRES_S] = int(time.time()) + 86_400
        items.append({name: serialize(value) for name, value in item.items()})
    client, table = target.cloud.client("dynamodb"), target.cloud.output("storage", "TelemetryTable")
    for item in items:
        client.put_item(TableName=table, Item=item)
    deadline = time.monotonic() + _CATCH_UP_S
    while delivery.samples_summarized(target.cloud, target.name(ROBOT), VESC_STREAM) < 50 * BATCHES:
        if time.monotonic() > deadline:
            raise RuntimeError("Lambda 2 has not summarised what was stored")
        threading.Event().wait(0.2)
    return items


def _stream_event(items: list[dict[str, Any]]) -> dict[str, Any]:
    records = [
        {
            "eventID": f"bench-{i}",
            "eventName": "INSERT",
            "eventSource": "aws:dynamodb",
            "dynamodb": {
                "Keys": {name: item[name] for name in (TOPIC, T_US)},
                "NewImage": item,
                "SequenceNumber": f"{i + 1:021}",
                "StreamViewType": "NEW_IMAGE",
            },
        }
        for i, item in enumerate(items)
    ]
    return {"Records": records}


def _live_event(target: Target, i: int) -> dict[str, Any]:
    """What the live rule gives to Lambda 1."""
    now_us = time.time_ns() // 1000
    sample = Vehicle(VehicleConfig(), seed=1).sample()
    message = encode_live(LiveSample("0badcafe", i, now_us - 1000, now_us, sample))
    topic = build_topic(LIVE, target.name(ROBOT), VESC_STREAM, target.cloud.namespace)
    return live_event(message, topic, now_us // 1000)


def _cycle() -> dict[str, float]:
    done = subprocess.run(
        [sys.executable, "-m", "bench.cycle", "5000"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise RuntimeError(f"bench.cycle failed: {done.stderr[-800:]}")
    found: dict[str, float] = json.loads(done.stdout)
    return found
