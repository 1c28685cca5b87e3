"""The cost of the agent on a real ROS 2 graph, beside a bare rclpy subscriber and `ros2 bag record`, under
each middleware.

All three subscribe to the same topics in the same run. The agent records to its spool and publishes to
mosquitto, where a watcher counts everything; the bare subscriber takes raw messages on rclpy's
SingleThreadedExecutor, and counts them.

- the processor time a message, at 1000 Hz, at 50 topics of 20 Hz, which come together or evenly, and at
  30 Hz of 100 KB;
- the same while somebody looks at each of the 50 topics; otherwise nobody does, and the live lane sends one
  message of a topic in ten seconds;
- the messages lost, by the publisher's own count;
- the time from ROS publish to the broker over the live lane, beside the bare subscriber's arrival.

Without ROS 2 or mosquitto the section has no figures and says why.
"""

from __future__ import annotations

import json
import re
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Any

from bench.floors import mosquitto
from bench.floors.mosquitto import ROBOT, Mosquitto, subscribed
from bench.floors.raw_mqtt import RawClient
from bench.load.counting import await_received, finish
from bench.report import NOT_MEASURED, Report, Section
from bench.ros.ros2_loads import BIG, FAST, LIVE, LOADS, MANY, SPREAD, Load
from bench.sections import Declared, Option
from iort_agent.status import SOCKET
from iort_contract.limits import LIVE_MAX_RATE_HZ
from iort_contract.messages.batch import decode_batch
from iort_contract.messages.live import decode_live
from iort_contract.topics import LIVE as LIVE_LANE
from iort_contract.topics import RECORD, build_topic, live_topic, parse_topic
from local.figures import Spread
from testkit import machine
from testkit.ros2 import Ros2, Ros2Error, Ros2Graph, find
from testkit.target import Say, Target
from testkit.waiting import InstrumentError

AGENT, FLOOR, RECORDER = "agent", "bare rclpy subscriber", "ros2 bag record"
# The most: processor time as a multiple of the bare subscriber's, and ms after its arrival.
CPU_TIMES, LATER_MS = 1.0, 1.0
# Fast DDS has a second one, which no robot has by default.
_MIDDLEWARES = ("rmw_fastrtps_cpp", "rmw_cyclonedds_cpp", "rmw_zenoh_cpp")
_WARM_UP_S, _CATCH_UP_S, _END_S = 3, 60.0, 60.0
_BASIC_INGEST = "$aws/rules/"
_WATCHER, _TRIPS = "watcher", 50
_NONE = machine.Threads()


@dataclass(frozen=True)
class Run:
    """A load under a middleware: processor us a message, messages lost, and memory, by subscriber."""

    middleware: str
    load: str
    # Whether somebody looks at every topic: ten live messages a second, as far as the limits allow.
    live: bool
    messages: int
    cpu_us: dict[str, float]
    rss_mb: dict[str, float]
    lost: dict[str, int]
    # What the agent itself says that the middleware lost.
    source: dict[str, Any]
    # Of each thread of the agent: us a message, and wake-ups a second.
    threads: dict[str, tuple[float, float]]


def run(_target: Target | None, say: Say, *, messages: int, duration: int) -> Section:
    """Measure each load under each middleware; the target is not used."""
    section, program = Section("ros2", "The agent on a real ROS 2 graph"), mosquitto.found()
    try:
        ros2 = find()
    except Ros2Error as error:
        section.notes.append(f"Not measured here: {error}.")
        return section
    if program is None:
        section.notes.append("Not measured here: mosquitto is not installed (apt install mosquitto).")
        return section
    runs, live = list[Run](), dict[str, tuple[Spread, Spread, float]]()
    for middleware in [one for one in _MIDDLEWARES if one in ros2.middlewares()]:
        for name, looked_at in ((FAST, False), (MANY, False), (SPREAD, False), (BIG, False), (MANY, True)):
            load = LOADS[name]
            each = messages // len(load.topics) if name == FAST else load.rate_hz * duration
            say(f"{middleware}, {load.title}: {each * len(load.topics):,} messages")
            runs.append(_measure(program, ros2, middleware, name, each, live=looked_at))
        say(f"{middleware}, {LOADS[LIVE].title}: the live lane for {duration} s")
        live[middleware] = _delays(program, ros2, middleware, duration)
    report(section, runs, live)
    section.notes.append(f"ROS 2 {ros2.distribution}; every process on this machine.")
    return section


def _topics(load: Load) -> dict[str, dict[str, str]]:
    return {topic: {"stream": topic[1:].replace("/", "_"), "time": "header"} for topic in load.topics}


def _measure(program: str, ros2: Ros2, middleware: str, name: str, each: int, *, live: bool) -> Run:
    load, heard = LOADS[name], list[tuple[str, bytes]]()
    count, streams = each * len(load.topics), {one["stream"] for one in _topics(load).values()}
    with (
        tempfile.TemporaryDirectory() as path,
        Mosquitto(program, Path(path)) as broker,
        subscribed(
            broker,
            [f"{_BASIC_INGEST}#", f"{RECORD}/#"],
            lambda topic, payload: heard.append((topic, payload)),
            qos=1,
        ),
        Ros2Graph(ros2, Path(path), middleware) as graph,
    ):
        folder = Path(path)
        when = "always" if live else "watched"
        car, bag = broker.car(_topics(load), "ros2", live=when), folder / "bag"
        written = folder / "report.json"
        processes = {
            AGENT: graph.start(
                "iort_agent.cli", "run", "--config", car, "--report", written, "--drain-s", _CATCH_UP_S
            ),
            FLOOR: graph.start("bench.floors.ros2_floor", load.kind, *load.topics),
        }
        if ros2.has("ros2bag"):
            processes[RECORDER] = graph.run(
                ["ros2", "bag", "record", "-s", "mcap", "-o", str(bag), *load.topics]
            )
        publisher = graph.publisher(name, each, len(processes))
        publisher.ready()
        publisher.go()
        publisher.publish_for(_WARM_UP_S)
        before, began = _threads(processes), time.monotonic()
        publisher.publish_for(each / load.rate_hz - _WARM_UP_S - 1)
        after, took_s = _threads(processes), time.monotonic() - began
        rss_mb = {who: machine.usage_of(one.pid).rss_mb for who, one in processes.items()}
        if int(publisher.finish()) != count:
            raise InstrumentError("the publisher has another count")
        await_received(
            car.parent / SOCKET,
            lambda received: sum(received.get(stream, 0) for stream in streams) >= count,
            within_s=_CATCH_UP_S,
        )
        counted = {FLOOR: _counted(processes[FLOOR])}
        if RECORDER in processes:
            finish(processes[RECORDER], signal.SIGINT, within_s=_CATCH_UP_S + _END_S)
            counted[RECORDER] = _in_bag(bag)
        finish(processes[AGENT], signal.SIGTERM, within_s=_CATCH_UP_S + _END_S)
        source = json.loads(written.read_text())["sources"][0]
        counted[AGENT] = _arrived(heard, streams)
    messages = took_s * load.rate_hz * len(load.topics)
    spent = {who: machine.spent(before[who], threads, took_s, messages) for who, threads in after.items()}
    return Run(
        middleware,
        name,
        live,
        count,
        {who: sum(us for us, _ in threads.values()) for who, threads in spent.items()},
        rss_mb,
        {who: count - got for who, got in counted.items()},
        source,
        spent[AGENT],
    )


def _threads(processes: Mapping[str, subprocess.Popen[str]]) -> dict[str, dict[str, machine.Threads]]:
    """What each process' threads have taken; those that Fast DDS names by a port are one."""
    used: dict[str, dict[str, machine.Threads]] = {}
    for who, process in processes.items():
        used[who] = {}
        for name, now in machine.threads_of(process.pid).items():
            short = re.sub(r"[.\d]+$", "", name)
            before = used[who].get(short, _NONE)
            used[who][short] = machine.Threads(before.cpu_s + now.cpu_s, before.waits + now.waits)
    return used


def _counted(floor: subprocess.Popen[str]) -> int:
    assert floor.stdin is not None
    assert floor.stdout is not None
    floor.stdin.write("\n")
    floor.stdin.flush()
    return int(floor.stdout.readline())


def _in_bag(bag: Path) -> int:
    from rosbags.rosbag2 import Reader  # noqa: PLC0415 - optional, and only this section needs it

    with Reader(bag) as reader:
        return int(reader.message_count)


def _arrived(heard: list[tuple[str, bytes]], streams: set[str]) -> int:
    """Count the samples of the streams; a repeated batch counts once."""
    numbers, samples = set[tuple[str, str, int]](), 0
    for whole, payload in heard:
        # By Basic Ingest a topic has the rule before it.
        topic = parse_topic(whole.split("/", 3)[-1] if whole.startswith(_BASIC_INGEST) else whole)
        if (name := topic.name) not in streams or topic.lane != RECORD:
            continue
        batch = decode_batch(payload)
        if (name, batch.boot, batch.seq) not in numbers:
            numbers.add((name, batch.boot, batch.seq))
            samples += len(batch.times_us)
    return samples


def _delays(program: str, ros2: Ros2, middleware: str, seconds: int) -> tuple[Spread, Spread, float]:
    """From ROS publish to a bare MQTT subscriber by way of the agent, and to the bare ROS subscriber beside
    it; and how long the broker takes to the MQTT subscriber, which is half of its round trip, in ms."""
    load, agent_ms = LOADS[LIVE], list[float]()
    stream = load.topics[0][1:]
    with (
        tempfile.TemporaryDirectory() as path,
        Mosquitto(program, Path(path)) as broker,
        Ros2Graph(ros2, Path(path), middleware) as graph,
        RawClient(_watcher(broker, Path(path) / _WATCHER)) as watcher,
    ):
        watcher.subscribe(_WATCHER)
        trips_ms = []
        for _ in range(_TRIPS):
            # As seldom as live messages: a processor that sleeps between takes longer.
            time.sleep(1 / LIVE_MAX_RATE_HZ)
            trips_ms.append(watcher.round_trip(_WATCHER, bytes(300)) * 1e3)
        # A live message goes one way or the other; unlike AWS IoT, mosquitto delivers both.
        for lane in (build_topic(LIVE_LANE, ROBOT, stream), live_topic(ROBOT, stream)):
            watcher.subscribe(lane)

        def watch() -> None:
            with suppress(OSError, InstrumentError, IndexError):  # the end
                while True:
                    _, payload = watcher.receive()
                    agent_ms.append(time.time_ns() / 1e6 - decode_live(payload).t_us / 1e3)

        threading.Thread(target=watch, daemon=True).start()
        delays = Path(path) / "delays.json"
        graph.start("iort_agent.cli", "run", "--config", broker.car(_topics(load), "ros2"))
        floor = graph.start("bench.floors.ros2_floor", load.kind, *load.topics, "--delays", delays)
        publisher = graph.publisher(LIVE, load.rate_hz * (seconds + _WARM_UP_S), 2)
        publisher.ready()
        publisher.go()
        publisher.publish_for(_WARM_UP_S)
        warm = len(agent_ms)
        publisher.finish()
        _counted(floor)
        floor_ms = json.loads(delays.read_text())
    ours, bare = Spread.of(agent_ms[warm:]), Spread.of(floor_ms[load.rate_hz * _WARM_UP_S :])
    return ours, bare, median(trips_ms) / 2


def _watcher(broker: Mosquitto, folder: Path) -> Path:
    """The folder of a client that is no robot."""
    folder.mkdir()
    certificate, key = broker.identity(_WATCHER)
    settings = {
        "robot": _WATCHER,
        "endpoint": mosquitto.HOST,
        "port": broker.port,
        "certificate": str(certificate),
        "private_key": str(key),
        "root_ca": str(broker.ca),
    }
    (folder / "car.yaml").write_text(json.dumps(settings))
    return folder


def _title(one: Run) -> str:
    return f"{LOADS[one.load].title}{', looked at' if one.live else ''}"


def report(section: Section, runs: list[Run], live: dict[str, tuple[Spread, Spread, float]]) -> None:
    """Add the tables and the ratios."""
    order, rows = (AGENT, FLOOR, RECORDER), []
    for one in runs:
        cells = [_title(one), one.middleware, f"{one.messages:,}"]
        for values, unit in ((one.cpu_us, " us"), (one.lost, ""), (one.rss_mb, " MB")):
            cells += [f"{values[who]:,.0f}{unit}" if who in values else NOT_MEASURED for who in order]
        rows.append(cells)
        title = f"{_title(one)}, {one.middleware}"
        for who, most in ((FLOOR, None if one.load == BIG or one.live else CPU_TIMES), (RECORDER, None)):
            if who in one.cpu_us:
                name = f"{title}: the agent's processor / {who}'s"
                section.ratio(name, one.cpu_us[AGENT] / one.cpu_us[who], most)
        lost = f"{title}: messages that the agent lost"
        section.ratio(lost, one.lost[AGENT], 0, unit=f"of {one.messages:,}")
    figures = [f"{figure}: {who}" for figure in ("processor a message", "lost", "memory") for who in order]
    section.table(
        "The agent, and who hears the same beside it", ["load", "middleware", "messages", *figures], rows
    )
    rows = []
    for middleware, (agent_ms, floor_ms, hop_ms) in live.items():
        rows.append([middleware, agent_ms.text(2), f"{hop_ms:.2f} ms", floor_ms.text(2)])
        if agent_ms.p50 and floor_ms.p50:
            name = (
                f"{LOADS[LIVE].title}, {middleware}: ROS publish to broker, after the bare subscriber (p50)"
            )
            later_ms = agent_ms.p50 - hop_ms - floor_ms.p50
            section.ratio(name, later_ms, LATER_MS, unit="ms", tolerance=3)
    section.table(
        f"From ROS publish, {LOADS[LIVE].title}",
        ["middleware", "to a bare MQTT subscriber", "of it from the broker", f"to the {FLOOR}"],
        rows,
    )
    names = {name: None for one in runs for name in one.threads}
    section.table(
        "The agent's threads: us a message, wake-ups a second",
        ["thread", *(f"{_title(one)}, {one.middleware}" for one in runs)],
        [
            [name, *("{:.1f}, {:.0f}".format(*one.threads.get(name, (0, 0))) for one in runs)]
            for name in names
        ],
    )
    section.raw = {
        "runs": [asdict(one) for one in runs],
        "live_ms": {name: [asdict(ours), asdict(bare), hop] for name, (ours, bare, hop) in live.items()},
    }


SECTION = Declared(
    "the agent on a real ROS 2 graph, beside a bare rclpy subscriber and ros2 bag record",
    run,
    (
        Option("MESSAGES", int, 100_000, "messages of the fastest topic"),
        Option("DURATION", int, 30, "seconds of each other load"),
    ),
    Report("ros2", "The agent on ROS 2", "make bench ONLY=ros2"),
    cloud=False,
)
