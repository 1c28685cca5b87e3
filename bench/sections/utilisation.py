"""Table 6.5: the time and processor time of the functions and of the robot's node.

Durations come from Lambda's REPORT lines. The embedded cloud gives every function a whole core, whatever its
memory size. So there the operating system also measures processor time, which is projected to each memory
size. On AWS each size is set and measured.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from contextlib import ExitStack
from dataclasses import asdict
from statistics import median
from typing import Any

from bench import ROOT
from bench.errors import BenchError
from bench.load import stored_drive
from bench.load.simulated import RATE_HZ
from bench.meters.invocations import Event, Measured, configure, invoke, measure, reporting
from bench.report import plots, thesis
from bench.report.result import NOT_MEASURED, Section
from bench.report.spread import spread
from bench.target import Say, Target, temporary_function
from iort_agent.sources.sim.parameters import VehicleConfig
from iort_agent.sources.sim.sensors import Sensors
from iort_agent.sources.sim.vehicle import Vehicle
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.messages.event import rule_event
from iort_contract.messages.live import LiveSample, encode_live
from iort_contract.tables import BATCH, REPLAY, TOPIC
from iort_contract.topics import LIVE, build_topic

SIZES_MB = (128, 256, 512, 1024, 1769)
# "At 1,769 MB, a function has the equivalent of one vCPU": Lambda, "Configure memory".
ONE_VCPU_MB = 1769
ROBOT = "bench-functions"
ROUNDS = 3
CALLS = 60
BATCHES = 100
_LIVE, _ONE, _EMPTY = "Lambda 1 (live)", "Lambda 2, an event of 1 batch", "empty function"
_BACKLOG = f"Lambda 2, an event of {BATCHES} batches"
_THESIS = {_LIVE: f"{thesis.LAMBDA_1[256]} (256 MB)", _ONE: thesis.LAMBDA_2}
# What an invocation costs by itself.
_NOTHING = "def handler(event, context):\n    return None\n"


def run(target: Target, say: Say) -> Section:
    """Invoke the functions in turns, warm and cold; then the node's cycle."""
    section = Section("utilisation", "Utilisation (table 6.5)")
    say("storing a drive")
    batches = stored_drive.store(target, target.name(ROBOT), stored_drive.simulated(BATCHES * RATE_HZ))
    # The newest batch alone is what a driving car makes of the stream; all of them, a backlog.
    one, many = _stream_event(batches[-1:]), _stream_event(batches)
    events: dict[str, Event] = {
        _LIVE: lambda i: _live_event(target, i),
        _ONE: lambda _: one,
        _BACKLOG: lambda _: many,
    }
    live = target.cloud.output("processing", "LiveFunction")
    summarize = target.cloud.output("processing", "SummarizeFunction")
    with temporary_function(target, "empty", _NOTHING, memory_mb=256) as empty, ExitStack() as reports:
        names = dict(zip(events, (live, summarize, summarize), strict=True))
        events[_EMPTY], names[_EMPTY] = (lambda _: {}), empty
        for name in sorted(set(names.values())):
            reports.enter_context(reporting(target, name))
        found = {name: Measured() for name in events}
        for name, event in events.items():
            invoke(target, names[name], event(0))
        for turn in range(ROUNDS):
            for name, event in events.items():
                say(f"{name}, warm, {turn + 1} of {ROUNDS}")
                calls = CALLS // 10 if name == _BACKLOG else CALLS
                measure(target, names[name], event, calls, found[name])
        sizes = _memory_sizes(target, live, events[_LIVE], say)
        cold = {
            name: _cold(target, names[name], event, say) for name, event in events.items() if name != _BACKLOG
        }
    say("the node's cycle")
    cycle = _cycle()
    report(section, found, cold, sizes, cycle)
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
        section.table(
            "Lambda 1 by memory size",
            ["memory", "duration, warm", "thesis, 2018"],
            [
                [f"{mb} MB", _duration(one), thesis.LAMBDA_1.get(mb, NOT_MEASURED)]
                for mb, one in sizes.items()
            ],
        )
    else:
        section.table(
            "Projection, not a measurement: processor time by the share of a vCPU of each memory size",
            ["function", *(f"{size} MB" for size in SIZES_MB)],
            [[name, *(f"{ms:.1f} ms" for ms in values)] for name, values in _projected(found).items()],
        )
        section.notes.append(
            f"On the embedded cloud the memory size changes nothing. The projection is processor time x "
            f"{ONE_VCPU_MB} MB / memory, by AWS' word that {ONE_VCPU_MB} MB have one vCPU; waiting for "
            "DynamoDB or PubNub is not in it, and this machine's core is not AWS'."
        )
    empty_ms = found[_EMPTY].cpu_ms
    for name, spent_ms, shared_by, most_ms in (
        ("Lambda 1 warm, processor time beyond an empty function", found[_LIVE].cpu_ms, 1, 3.0),
        ("Lambda 2, processor time a batch of 50 samples", found[_BACKLOG].cpu_ms, BATCHES, 1.0),
    ):
        if spent_ms and empty_ms:
            beyond_ms = median(a - b for a, b in zip(spent_ms, empty_ms, strict=True)) / shared_by
            settings = {"unit": "ms", "tolerance": 1.6, "by_machine": True}
            section.ratio(name, round(beyond_ms, 3), most_ms, **settings)
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


def _stream_event(items: list[dict[str, Any]]) -> dict[str, Any]:
    records = [
        {
            "eventID": f"bench-{i}",
            "eventName": "INSERT",
            "eventSource": "aws:dynamodb",
            "dynamodb": {
                "Keys": {name: item[name] for name in (TOPIC, BATCH)},
                "NewImage": item,
                "SequenceNumber": f"{i + 1:021}",
                "StreamViewType": "NEW_IMAGE",
            },
        }
        for i, item in enumerate(items)
    ]
    # As an operator's: a robot that sent so many would be over its share.
    return {REPLAY: True, "Records": records}


def _live_event(target: Target, i: int) -> dict[str, Any]:
    """Return an event as the live rule sends it to Lambda 1."""
    now_us = time.time_ns() // 1000
    sample = Sensors(Vehicle(VehicleConfig(), seed=1), seed=1).vesc()
    message = encode_live(LiveSample("0badcafe", i, now_us - 1000, now_us, sample))
    topic = build_topic(LIVE, target.name(ROBOT), VESC_STREAM, target.cloud.namespace)
    return rule_event(message, topic, now_us // 1000)


def _cycle() -> dict[str, float]:
    done = subprocess.run(
        [sys.executable, "-m", "bench.meters.cycle", "5000"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise BenchError(f"bench.meters.cycle failed: {done.stderr[-800:]}")
    found: dict[str, float] = json.loads(done.stdout)
    return found
