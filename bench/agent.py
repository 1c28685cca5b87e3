"""`make bench-agent`: the cost of the agent on a real ROS 1 graph, beside a bare rospy subscriber.

    python -m bench.agent [--seconds 30] [--soak 600] [--json FILE]

It measures at 50 Hz and at 1000 Hz:

- the processor time a sample, of the agent (both lanes, the spool, TLS to the embedded cloud's broker) and of
  a bare subscriber of the same topic in the same run;
- the memory at the start and at the end, and the samples lost;
- the delay from ROS publish to an MQTT subscriber over the live lane, beside a bare MQTT client's
  (`bench.meters.live_lane`). This needs mosquitto: the embedded cloud's broker hands Basic Ingest messages to
  the rule and to no subscriber, as AWS IoT does.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from bench.errors import BenchError
from bench.floors import mosquitto
from bench.meters import live_lane, usage
from bench.ros.graph import PYTHONPATH, RosError, RosGraph, python_with_rospy
from iort_station.cloud import Cloud
from iort_station.fleet import robots
from iort_station.operations import delivery
from local.cloud import EmbeddedCloud
from local.errors import LocalError

TOPIC = "/sensors/core"
RATES_HZ = (50, 1000)
# What the figures are held against, here and in the README.
CPU_US = {50: 300.0, 1000: 100.0}
TARGETS = {"live_ms_p50": 0.7, "cycle_ms_p50": 0.1, "rss_mb": 80.0}
_WARM_UP_S = 3
_CATCH_UP_S = 30.0


@dataclass(frozen=True)
class Run:
    """The figures at one rate: processor time a sample in us, memory, and lost samples."""

    rate_hz: int
    samples: int
    lost: int
    agent_cpu_us: float
    floor_cpu_us: float
    rss_mb_first: float
    rss_mb_last: float


def main() -> None:
    """Measure and print; exit status 1 if a sample was lost."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=int, default=30, help="how long each rate is measured")
    parser.add_argument("--soak", type=int, metavar="S", help="measure 1000 Hz alone, for so long")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures as JSON too")
    options = parser.parse_args()
    console = Console()
    try:
        python = python_with_rospy()
        cycle = json.loads(_output([python, "-m", "bench.meters.cycle", "20000"]))
        runs = []
        with EmbeddedCloud(progress=lambda step: console.print(f"  {step}", style="dim")) as embedded:
            for rate_hz in (1000,) if options.soak else RATES_HZ:
                seconds = options.soak or options.seconds
                console.print(f"{rate_hz} Hz for {seconds} s ...")
                runs.append(_measure(embedded.cloud, python, rate_hz, seconds))
        lean = []
        program = mosquitto.found()
        if program is None:
            console.print("mosquitto is not installed (apt install mosquitto): left out", style="yellow")
        for rate_hz in RATES_HZ if program is not None and not options.soak else ():
            console.print(f"mosquitto, {rate_hz} Hz for {options.seconds} s ...")
            lean.append(live_lane.measure(str(program), python, rate_hz, options.seconds))
    except (BenchError, LocalError) as error:
        sys.exit(f"bench-agent: {error}")
    console.print(_table(runs, cycle, lean))
    if options.json:
        options.json.write_text(json.dumps(_report(runs, cycle, lean), indent=2) + "\n")
    sys.exit(1 if any(run.lost for run in runs) else 0)


def _measure(cloud: Cloud, python: str, rate_hz: int, seconds: int) -> Run:
    robot, count = f"bench-{rate_hz}", rate_hz * (seconds + _WARM_UP_S)
    with tempfile.TemporaryDirectory() as name, RosGraph(python, Path(name)) as graph:
        folder = Path(name)
        source = {"type": "ros1", "topics": {TOPIC: {"stream": "vesc", "time": "header"}}}
        bundle = robots.add(
            cloud, robot, out=folder, settings={"sources": [source], "queue": {"path": "spool.db"}}
        )
        agent = graph.start("iort_agent.cli", "run", "--config", bundle.config)
        floor = graph.start("bench.floors.ros_floor", TOPIC)
        publisher = graph.publisher(TOPIC, rate_hz, count)
        publisher.begin()
        publisher.publish_for(_WARM_UP_S)
        before = usage.of(agent.pid), usage.of(floor.pid)
        began = time.monotonic()
        publisher.publish_for(seconds - 1)
        measured = (time.monotonic() - began) * rate_hz
        after = usage.of(agent.pid), usage.of(floor.pid)
        publisher.finish()
        stored = _stored(cloud, robot, count)
        agent.terminate()
        agent.wait()
    return Run(
        rate_hz=rate_hz,
        samples=count,
        lost=count - stored,
        agent_cpu_us=round((after[0].cpu_s - before[0].cpu_s) / measured * 1e6, 1),
        floor_cpu_us=round((after[1].cpu_s - before[1].cpu_s) / measured * 1e6, 1),
        rss_mb_first=round(before[0].rss_mb, 1),
        rss_mb_last=round(after[0].rss_mb, 1),
    )


def _stored(cloud: Cloud, robot: str, count: int) -> int:
    """Count the samples in the table, after all have arrived or the wait is over."""
    deadline = time.monotonic() + _CATCH_UP_S
    while True:
        stored = sum(len(batch.times_us) for batch in delivery.batches(cloud, robot, "vesc"))
        if stored >= count or time.monotonic() > deadline:
            return stored
        time.sleep(0.5)


def _output(command: list[str]) -> str:
    environment = {**os.environ, "PYTHONPATH": PYTHONPATH}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RosError(f"{' '.join(command)} failed:\n{done.stderr[-1000:]}")
    return done.stdout


def _table(runs: list[Run], cycle: dict[str, float], lean: list[live_lane.Lane]) -> Table:
    table = Table(title="The agent", title_justify="left", title_style="bold")
    for column in ("figure", "measured", "target", "floor, same run"):
        table.add_column(column, justify="left" if column == "figure" else "right")
    for run in runs:
        rate = f"at {run.rate_hz} Hz"
        target = CPU_US[run.rate_hz]
        table.add_row(
            f"processor a sample {rate}",
            f"{run.agent_cpu_us:.0f} us",
            f"{target:.0f} us",
            f"{run.floor_cpu_us:.0f} us (x{run.agent_cpu_us / run.floor_cpu_us:.1f})",
        )
        rss = f"{run.rss_mb_first:.1f} to {run.rss_mb_last:.1f} MB"
        table.add_row(f"memory {rate}, first to last", rss, f"{TARGETS['rss_mb']:.0f} MB", "")
        table.add_row(f"samples lost {rate}", f"{run.lost} of {run.samples:,}", "0", "")
    for lane in lean:
        table.add_row(
            f"ROS publish to MQTT subscriber at {lane.rate_hz} Hz, mosquitto",
            lane.shown(lane.agent_ms),
            f"{TARGETS['live_ms_p50']} ms",
            lane.shown(lane.floor_ms),
        )
    p50 = f"{cycle['p50']:.4f} ms (p95 {cycle['p95']:.4f})"
    table.add_row("node's cycle, callback to spool", p50, f"{TARGETS['cycle_ms_p50']} ms", "thesis: 2 ms")
    return table


def _report(runs: list[Run], cycle: dict[str, float], lean: list[live_lane.Lane]) -> dict[str, Any]:
    return {
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, {platform.platform()}",
        "python": platform.python_version(),
        "load_1min": os.getloadavg()[0],
        "targets": {**TARGETS, "cpu_us": CPU_US},
        "cycle_ms": cycle,
        "runs": [asdict(run) for run in runs],
        "mosquitto": [asdict(lane) for lane in lean],
    }


if __name__ == "__main__":
    main()
