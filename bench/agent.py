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

import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

from rich.console import Console

from bench.floors import mosquitto
from bench.meters import live_lane
from bench.report import thesis
from bench.ros.mixed_robot import CORE
from iort_contract.catalog.vesc import VESC_STREAM
from iort_station.cloud import Cloud
from iort_station.fleet import robots
from iort_station.operations import audit
from local.cloud import EmbeddedCloud
from local.processes import LocalError
from testkit import machine
from testkit.command import Table, made, parser, write
from testkit.ros import PYTHONPATH, RosError, RosGraph, python_with_rospy
from testkit.waiting import InstrumentError, reached

RATES_HZ = (50, 1000)
# The most: processor time and live delay as a multiple of the floor's in the same run, memory, and the node's
# cycle as a share of the thesis'.
CPU_TIMES = {50: 3.5, 1000: 2.0}
LIVE_TIMES, RSS_MB, CYCLE_SHARE = 2.0, 80.0, 0.05
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
    arguments = parser(__doc__)
    arguments.add_argument("--seconds", type=int, default=30, help="how long each rate is measured")
    arguments.add_argument("--soak", type=int, metavar="S", help="measure 1000 Hz alone, for so long")
    options = arguments.parse_args()
    console = Console()
    runs, lanes = [], []
    try:
        python = python_with_rospy()
        cycle = _cycle(python)
        with EmbeddedCloud(progress=lambda step: console.print(f"  {step}", style="dim")) as embedded:
            for rate_hz in (1000,) if options.soak else RATES_HZ:
                seconds = options.soak or options.seconds
                console.print(f"{rate_hz} Hz for {seconds} s ...")
                runs.append(_measure(embedded.cloud, python, rate_hz, seconds))
        program = mosquitto.found()
        if program is None:
            console.print("mosquitto is not installed (apt install mosquitto): left out", style="yellow")
        for rate_hz in RATES_HZ if program is not None and not options.soak else ():
            console.print(f"mosquitto, {rate_hz} Hz for {options.seconds} s ...")
            lanes.append(live_lane.measure(str(program), python, rate_hz, options.seconds))
    except (InstrumentError, LocalError) as error:
        sys.exit(f"bench-agent: {error}")
    _table(runs, cycle, lanes).show(console)
    write(
        options.json,
        {
            **made(),
            "targets": {
                "cpu / floor": CPU_TIMES,
                "live / floor": LIVE_TIMES,
                "rss_mb": RSS_MB,
                "cycle / thesis": CYCLE_SHARE,
            },
            "cycle_ms": cycle,
            "runs": [asdict(run) for run in runs],
            "mosquitto": [asdict(lane) for lane in lanes],
        },
    )
    sys.exit(1 if any(run.lost for run in runs) else 0)


def _measure(cloud: Cloud, python: str, rate_hz: int, seconds: int) -> Run:
    robot, count = f"bench-{rate_hz}", rate_hz * (seconds + _WARM_UP_S)
    with tempfile.TemporaryDirectory() as name, RosGraph(python, Path(name)) as graph:
        topics = {live_lane.TOPIC: {"stream": VESC_STREAM, "time": "header"}}
        settings = {
            "sources": [{"type": "ros1", "topics": topics}],
            "queue": {"path": "spool.db"},
            "live": {"when": "always"},
        }
        bundle = robots.add(cloud, robot, out=Path(name), settings=settings)
        agent = graph.start("iort_agent.cli", "run", "--config", bundle.config)
        floor = graph.start("bench.floors.ros_floor", live_lane.TOPIC)
        publisher = graph.publisher(CORE, seconds + _WARM_UP_S, rate_hz=rate_hz)
        publisher.ready()
        publisher.go()
        publisher.publish_for(_WARM_UP_S)
        before, began = (machine.usage_of(agent.pid), machine.usage_of(floor.pid)), time.monotonic()
        publisher.publish_for(seconds - 1)
        measured = (time.monotonic() - began) * rate_hz
        after = machine.usage_of(agent.pid), machine.usage_of(floor.pid)
        publisher.finish()

        def stored() -> int:
            return sum(len(batch.times_us) for batch in audit.batches(cloud, robot, VESC_STREAM))

        reached(lambda: stored() >= count, within_s=_CATCH_UP_S, poll_s=0.5)
        lost = count - stored()
        agent.terminate()
        agent.wait()
    agent_us, floor_us = (
        round((then.cpu_s - first.cpu_s) / measured * 1e6, 1)
        for first, then in zip(before, after, strict=True)
    )
    rss_mb = round(before[0].rss_mb, 1), round(after[0].rss_mb, 1)
    return Run(rate_hz, count, lost, agent_us, floor_us, *rss_mb)


def _cycle(python: str) -> dict[str, float]:
    environment = {**os.environ, "PYTHONPATH": PYTHONPATH}
    command = [python, "-m", "bench.meters.cycle", "20000"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RosError(f"{' '.join(command)} failed:\n{done.stderr[-1000:]}")
    found: dict[str, float] = json.loads(done.stdout)
    return found


def _table(runs: list[Run], cycle: dict[str, float], lanes: list[live_lane.Lane]) -> Table:
    rows = []
    for run in runs:
        rate, ours, floor = f"at {run.rate_hz} Hz", run.agent_cpu_us, run.floor_cpu_us
        times = [f"{ours:.0f} us: {ours / floor:.1f} times", f"{CPU_TIMES[run.rate_hz]:g} times the floor"]
        rows.append([f"processor a sample {rate}", *times, f"{floor:.0f} us"])
        rss = f"{run.rss_mb_first:.1f} to {run.rss_mb_last:.1f} MB"
        rows.append([f"memory {rate}, first to last", rss, f"{RSS_MB:.0f} MB", ""])
        rows.append([f"samples lost {rate}", f"{run.lost} of {run.samples:,}", "0", ""])
    for lane in lanes:
        name = f"ROS publish to MQTT subscriber at {lane.rate_hz} Hz, mosquitto"
        # To a hundredth of a ms: the two differ by no more.
        delays = lane.agent_ms.text(2), f"{LIVE_TIMES:g} times the floor", lane.floor_ms.text(2)
        rows.append([name, *delays])
    p50 = f"{cycle['p50']:.4f} ms (p95 {cycle['p95']:.4f})"
    share, theirs = f"{CYCLE_SHARE:g} of the thesis'", f"thesis: {thesis.NODE_CYCLE_MS} ms"
    rows.append(["node's cycle, callback to spool", p50, share, theirs])
    return Table("The agent", ["figure", "measured", "target", "floor, same run"], rows)


if __name__ == "__main__":
    main()
