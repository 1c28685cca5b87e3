"""Measures the node's cycle: from the message in the callback to the batch in the spool, without network.

    python -m bench.ros.cycle SAMPLES

Uses the agent's own parts, a spool on disk, and the uplink that keeps messages in memory; prints the
cycle's percentiles in milliseconds as JSON."""

from __future__ import annotations

import json
import struct
import sys
import tempfile
import time
from pathlib import Path
from statistics import quantiles

from bench.ros.mixed_robot import topics
from iort_agent.agent import Agent
from iort_agent.common.threads import SystemClock
from iort_agent.config import Config
from iort_agent.mqtt.dispatch import Dispatcher
from iort_agent.sources.intake import Intake, TopicConfig
from iort_agent.sources.sim import PoseConfig, SimConfig
from iort_agent.spool import QueueConfig
from iort_agent.spool.sqlite import make_spool
from testkit.agent import Loopback
from testkit.ros1_types import TYPE, body


def main() -> None:
    """Call the callback as fast as possible, and time each call."""
    samples = int(sys.argv[1])
    with tempfile.TemporaryDirectory() as folder:
        clock = SystemClock()
        uplink = Loopback(clock, Dispatcher())
        config = Config(
            robot="bench",
            endpoint="",
            certificate=Path(),
            private_key=Path(),
            sources=(SimConfig(pose=PoseConfig(rate_hz=0)),),
            queue=QueueConfig(path=Path(folder) / "spool.db"),
        )
        spool = make_spool(config.queue, clock)
        agent = Agent(config, uplink=uplink, spool=spool, clock=clock)
        intake = Intake("/sensors/core", TopicConfig("header", "vesc"), emit=agent.streams.emit, clock=clock)
        header = {"type": TYPE, "md5sum": "bench", "message_definition": topics()["/sensors/core"].definition}
        cycles = []
        for i in range(samples):
            now_ns = time.time_ns()
            data = struct.pack("<III", i, now_ns // 10**9, now_ns % 10**9) + body(i)
            began = time.perf_counter()
            intake.take(header, data)
            cycles.append((time.perf_counter() - began) * 1000)
        spool.close()
    percents = quantiles(cycles, n=100)
    print(json.dumps({"p50": percents[49], "p95": percents[94], "p99": percents[98]}))


if __name__ == "__main__":
    main()
