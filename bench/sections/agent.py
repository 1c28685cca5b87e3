"""The cost of the agent on a real ROS 1 graph, beside a bare rospy subscriber, at 50 Hz and at 1000 Hz.

- the processor time a sample, of the agent (both lanes, the spool, TLS to the embedded cloud's broker) and of
  a bare subscriber of the same topic in the same run;
- what each thread of the agent takes of it, and how often it wakes up;
- the memory at the start and at the end, and the samples lost;
- the processor that the connected agent takes while no sample comes;
- the delay from ROS publish to an MQTT subscriber over the live lane, beside a bare MQTT client's. This needs
  mosquitto: the embedded cloud's broker hands Basic Ingest messages to the rule and to no subscriber, as AWS
  IoT does.
"""

from __future__ import annotations

import struct
import subprocess
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

from bench.floors import mosquitto
from bench.floors.mosquitto import ROBOT, Mosquitto, subscribed
from bench.report import Report, Section
from bench.ros.mixed_robot import CORE
from bench.sections import Declared, Option
from iort_contract.catalog.streams import ACCOUNT_STREAM
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.limits import LIVE_MAX_RATE_HZ
from iort_contract.messages.live import decode_live
from iort_contract.topics import LIVE, build_topic, live_topic
from iort_station.cloud import Cloud
from iort_station.fleet import robots
from iort_station.operations import audit
from local.figures import Spread
from testkit import machine
from testkit.ros import RosGraph, python_with_rospy
from testkit.target import Say, Target
from testkit.waiting import reached

TOPIC = "/sensors/core"
_FLOOR = "bench/floor"
# A live message goes one way or the other; unlike AWS IoT, mosquitto delivers both.
_AGENT = (build_topic(LIVE, ROBOT, VESC_STREAM), live_topic(ROBOT, VESC_STREAM))
_WARM_UP_S = 3


def delays(program: str, python: str, rate_hz: int, seconds: int) -> tuple[Spread, Spread]:
    """The delays through mosquitto, of the agent and of the floor beside it."""
    agent_ms: list[float] = []
    floor_ms: list[float] = []

    def take(topic: str, payload: bytes) -> None:
        now_us = time.time_ns() // 1000
        if topic == _FLOOR:
            floor_ms.append((now_us - _stamp_us(payload)) / 1000)
        else:
            agent_ms.append((now_us - decode_live(payload).t_us) / 1000)

    with (
        tempfile.TemporaryDirectory() as name,
        Mosquitto(program, Path(name)) as broker,
        RosGraph(python, Path(name)) as graph,
        subscribed(broker, (*_AGENT, _FLOOR), take),
    ):
        car = broker.car({TOPIC: {"stream": VESC_STREAM, "time": "header"}})
        graph.start("iort_agent.cli", "run", "--config", car)
        every = max(1, round(rate_hz / LIVE_MAX_RATE_HZ))
        floor = (TOPIC, every, broker.port, *broker.identity("floor"), broker.ca, _FLOOR)
        graph.start("bench.floors.mqtt_floor", *floor)
        publisher = graph.publisher(CORE, seconds + _WARM_UP_S, rate_hz=rate_hz)
        publisher.ready()
        publisher.go()
        publisher.publish_for(_WARM_UP_S)
        warm = len(agent_ms), len(floor_ms)
        publisher.finish()
    return Spread.of(agent_ms[warm[0] :]), Spread.of(floor_ms[warm[1] :])


def _stamp_us(message: bytes) -> int:
    _, sec, nanosec = struct.unpack_from("<III", message)
    return int(sec * 1_000_000 + nanosec // 1000)


RATES_HZ = (50, 1000)
# The most: processor time and live delay as a multiple of the floor's in the same run, percent of a core
# without samples, and memory.
CPU_TIMES = {50: 2.5, 1000: 1.5}
LIVE_TIMES, REST_PERCENT, RSS_MB = 2.0, 0.3, 80.0
_CATCH_UP_S = 30.0


@dataclass(frozen=True)
class Run:
    """The figures at one rate: processor time a sample in us, memory, and lost samples."""

    rate_hz: int
    samples: int
    lost: int
    agent_cpu_us: float
    floor_cpu_us: float
    # Of each thread of the agent: us a sample, and wake-ups a second.
    threads: dict[str, tuple[float, float]]
    rss_mb_first: float
    rss_mb_last: float


def run(target: Target, say: Say, *, duration: int, soak: int) -> Section:
    """Measure each rate on the embedded cloud, then the live lane through mosquitto."""
    python, live, runs = python_with_rospy(), dict[int, tuple[Spread, Spread]](), []
    for rate_hz in (1000,) if soak else RATES_HZ:
        say(f"{rate_hz} Hz for {soak or duration} s")
        runs.append(_measure(target.cloud, python, rate_hz, soak or duration))
    rest_percent = None
    if not soak:
        say(f"at rest for {duration} s")
        rest_percent = _at_rest(target.cloud, python, duration)
    program = mosquitto.found()
    for rate_hz in RATES_HZ if program is not None and not soak else ():
        say(f"mosquitto, {rate_hz} Hz for {duration} s")
        live[rate_hz] = delays(str(program), python, rate_hz, duration)
    section = report(runs, live, rest_percent)
    if program is None:
        section.notes.append("mosquitto is not installed (apt install mosquitto): the live lane is left out.")
    return section


def _start(cloud: Cloud, robot: str, folder: Path, graph: RosGraph, *, live: str) -> subprocess.Popen[str]:
    settings = {
        "sources": [{"type": "ros1", "topics": {TOPIC: {"stream": VESC_STREAM, "time": "header"}}}],
        "queue": {"path": "spool.db"},
        "live": {"when": live},
    }
    bundle = robots.add(cloud, robot, out=folder, settings=settings)
    return graph.start("iort_agent.cli", "run", "--config", bundle.config)


def _at_rest(cloud: Cloud, python: str, seconds: int) -> float:
    """Percent of a core that the connected agent takes while no sample comes."""
    with tempfile.TemporaryDirectory() as name, RosGraph(python, Path(name)) as graph:
        agent = _start(cloud, "bench-rest", Path(name), graph, live="watched")
        # Its first account.
        reached(lambda: any(audit.batches(cloud, "bench-rest", ACCOUNT_STREAM)), within_s=_CATCH_UP_S)
        before, began = _cpu_s(agent.pid), time.monotonic()
        time.sleep(seconds)
        return (_cpu_s(agent.pid) - before) / (time.monotonic() - began) * 100


def _cpu_s(pid: int) -> float:
    return sum(threads.cpu_s for threads in machine.threads_of(pid).values())


def _measure(cloud: Cloud, python: str, rate_hz: int, seconds: int) -> Run:
    robot, count = f"bench-{rate_hz}", rate_hz * (seconds + _WARM_UP_S)
    with tempfile.TemporaryDirectory() as name, RosGraph(python, Path(name)) as graph:
        agent = _start(cloud, robot, Path(name), graph, live="always")
        floor = graph.start("bench.floors.ros_floor", TOPIC)
        publisher = graph.publisher(CORE, seconds + _WARM_UP_S, rate_hz=rate_hz)
        publisher.ready()
        publisher.go()
        publisher.publish_for(_WARM_UP_S)
        before, began = [machine.threads_of(process.pid) for process in (agent, floor)], time.monotonic()
        rss_mb = machine.usage_of(agent.pid).rss_mb
        publisher.publish_for(seconds - 1)
        took_s = time.monotonic() - began
        after = [machine.threads_of(process.pid) for process in (agent, floor)]
        rss_mb_last = machine.usage_of(agent.pid).rss_mb
        publisher.finish()

        def stored() -> int:
            return sum(len(batch.times_us) for batch in audit.batches(cloud, robot, VESC_STREAM))

        reached(lambda: stored() >= count, within_s=_CATCH_UP_S, poll_s=0.5)
        lost = count - stored()
        agent.terminate()
        agent.wait()
    ours, floors = (
        machine.spent(then, threads, took_s, took_s * rate_hz)
        for then, threads in zip(before, after, strict=True)
    )
    agent_us, floor_us = (sum(us for us, _ in threads.values()) for threads in (ours, floors))
    return Run(rate_hz, count, lost, agent_us, floor_us, ours, rss_mb, rss_mb_last)


def report(
    runs: list[Run], live: dict[int, tuple[Spread, Spread]], rest_percent: float | None = None
) -> Section:
    """Make the section of the runs, of the live lane's delays beside the floor's, by rate, and of the
    processor at rest."""
    section, rows = Section("agent", "The agent on a real ROS 1 graph"), []
    for run in runs:
        rate, ours, floor = f"at {run.rate_hz} Hz", run.agent_cpu_us, run.floor_cpu_us
        rss = f"{run.rss_mb_first:.1f} to {run.rss_mb_last:.1f} MB"
        rows.append([f"processor a sample {rate}", f"{ours:.0f} us", f"{floor:.0f} us"])
        rows.append([f"memory {rate}, first to last", rss, ""])
        name = f"agent's processor a sample {rate} / floor"
        section.ratio(name, ours / floor, CPU_TIMES[run.rate_hz])
        section.ratio(f"agent's memory {rate}", run.rss_mb_last, RSS_MB, unit="MB")
        section.ratio(f"samples lost {rate}", run.lost, 0, unit=f"of {run.samples:,}")
    if rest_percent is not None:
        rows.append(["processor at rest, connected", f"{rest_percent:.2f} % of a core", ""])
        section.ratio("agent's processor at rest", rest_percent, REST_PERCENT, unit="% of a core")
    for rate_hz, (agent_ms, floor_ms) in live.items():
        name = f"ROS publish to MQTT subscriber at {rate_hz} Hz, mosquitto"
        # To a hundredth of a ms: the two differ by no more.
        rows.append([name, agent_ms.text(2), floor_ms.text(2)])
        if agent_ms.p50 and floor_ms.p50:
            section.ratio(f"{name} / floor", agent_ms.p50 / floor_ms.p50, LIVE_TIMES)
    section.table("The agent", ["figure", "measured", "floor, same run"], rows)
    section.table(
        "Its threads; `ros1 node` with those of rospy",
        ["thread", *(f"us a sample, wake-ups a second at {run.rate_hz} Hz" for run in runs)],
        [
            [name, *("{:.1f}, {:.1f}".format(*run.threads.get(name, (0.0, 0.0))) for run in runs)]
            for name in sorted(runs[0].threads, key=runs[0].threads.__getitem__, reverse=True)
        ],
    )
    section.raw = {
        "runs": [asdict(run) for run in runs],
        "rest_percent": rest_percent,
        "live_ms": {rate_hz: [asdict(spread) for spread in spreads] for rate_hz, spreads in live.items()},
    }
    return section


SECTION = Declared(
    "the agent on a real ROS 1 graph, beside a bare rospy subscriber",
    run,
    (
        Option("DURATION", int, 30, "seconds of each rate"),
        Option("SOAK", int, 0, "1000 Hz alone, for so many seconds"),
    ),
    Report("agent", "The agent", "make bench ONLY=agent"),
)
