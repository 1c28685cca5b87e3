"""The cost of the event recorder on a real graph: a ring of 1,000 small messages and 30 of 100 KB a second,
beside `rosbag record` or `ros2 bag record` of the same topics.

All of these subscribe at the same time: an agent with the ring, one without that takes only what is recorded,
and ROS' recorder. Both agents publish the live lane to mosquitto, so that its delays are of the same moments.
Then a trigger fires. Its incident is what would be uploaded, and what it costs is told apart: ROS' recorders
cut nothing.

Without ROS or mosquitto the section has no figures and says why.
"""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import yaml

from bench.floors import mosquitto
from bench.floors.mosquitto import Mosquitto, subscribed
from bench.report import Report, Section
from bench.sections import Declared, Option
from iort_agent.errors import AgentError
from iort_agent.status import SOCKET, fetch
from iort_contract.messages.live import decode_live
from iort_contract.messages.recorder import Trigger, encode_trigger
from iort_contract.topics import LIVE, build_topic, live_topic
from local.figures import Spread
from testkit import machine
from testkit.ros import PACKAGES, SYSTEM_PYTHON, Nodes, RosGraph, python_with_rospy
from testkit.ros2 import Ros2, Ros2Error, Ros2Graph, find
from testkit.target import Say, Target
from testkit.waiting import InstrumentError, reached

# The most: as a multiple of what ROS' recorder takes.
TIMES = 1.2
WITH, WITHOUT, RECORDER = "agent with the ring", "agent without", "ROS' recorder"
# The agent's thread that cuts incidents.
_CUTS = "incidents"
_STREAM, _RING_TOPICS = "demand", ("/small", "/large")
_BEFORE_S, _AFTER_S, _DEMAND = 3.0, 2.0, 1
_START_S, _WARM_UP_S, _END_S = 90.0, 4.0, 60.0


@dataclass(frozen=True)
class Run:
    """What a drive of ``seconds`` took, by subscriber: share of a core, bytes written, ms of the live lane.
    ``published`` are its messages, ``incident`` the bytes of an incident of five seconds, and ``incident_s``
    the processor's seconds that it took."""

    recorder: str
    seconds: float
    published: int
    core: dict[str, float]
    written: dict[str, int]
    live: dict[str, Spread]
    dropped: int
    incident: int
    incident_s: float


def run(_target: Target | None, say: Say, *, seconds: int) -> Section:
    """Measure in each ROS that is here; the target is not used."""
    section, program = Section("recorder", "The event recorder"), mosquitto.found()
    if program is None:
        section.notes.append("Not measured here: mosquitto is not installed (apt install mosquitto).")
        return section
    runs = []
    if shutil.which("rosmaster") is None or shutil.which("rosbag") is None:
        section.notes.append(
            f"ROS 1 is not measured: it is not installed (apt install {PACKAGES} python3-rosbag)."
        )
    else:
        say(f"ROS 1: {seconds} s")
        runs.append(_measure(program, None, seconds))
    try:
        ros2 = find()
    except Ros2Error as error:
        section.notes.append(f"ROS 2 is not measured: {error}.")
    else:
        say(f"ROS 2: {seconds} s")
        runs.append(_measure(program, ros2, seconds))
    report(section, runs)
    return section


@contextmanager
def _graph(ros2: Ros2 | None, folder: Path) -> Iterator[Nodes]:
    if ros2 is None:
        with RosGraph(python_with_rospy(), folder) as graph:
            yield graph
    else:
        middleware = ros2.environment.get("RMW_IMPLEMENTATION") or "rmw_fastrtps_cpp"
        with Ros2Graph(ros2, folder, middleware) as graph2:
            yield graph2


def _car(broker: Mosquitto, folder: Path, robot: str, source: str, *, ring: bool) -> Path:
    """The configuration of an agent; one with a ring has a trigger."""
    settings: dict[str, Any] = yaml.safe_load(
        broker.car({"/demand": {"stream": _STREAM, "time": "header"}}, source).read_text()
    )
    certificate, key = broker.identity(robot)
    settings |= {"robot": robot, "certificate": str(certificate), "private_key": str(key)}
    # Two agents of one graph are two nodes.
    settings["sources"][0]["node"] = f"iort_{robot}"
    (home := folder / robot).mkdir()
    if ring:
        for topic in _RING_TOPICS:
            settings["sources"][0]["topics"][topic] = {"stream": topic[1:], "time": "header", "only": "ring"}
        settings["recorder"] = {"folder": str(home / "ring"), "keep_free_mb": 0}
        trigger = Trigger(
            "bench", f"x == {_DEMAND}", stream=_STREAM, before_s=_BEFORE_S, after_s=_AFTER_S,
            topics=("/small", "/large", "/demand"),
        )  # fmt: skip
        plan: dict[str, Any] = {"incidents": [], "takes": {}, "last_us": {}, "spent": {}}
        (home / "ring").mkdir()
        (home / "ring" / "recorder.json").write_text(
            json.dumps({**plan, "triggers": _as_in_the_shadow(trigger)})
        )
    path = home / "car.yaml"
    path.write_text(yaml.safe_dump(settings))
    return path


def _as_in_the_shadow(trigger: Trigger) -> dict[str, Any]:
    # Null removes there.
    found: dict[str, Any] = encode_trigger(trigger)["recorder"]["triggers"]
    return {
        name: {key: value for key, value in entry.items() if value is not None}
        for name, entry in found.items()
    }


def _measure(program: str, ros2: Ros2 | None, seconds: int) -> Run:
    delays: dict[str, list[float]] = {WITH: [], WITHOUT: []}
    robots = {"ring": WITH, "plain": WITHOUT}
    lanes = {
        topic: who
        for robot, who in robots.items()
        for topic in (build_topic(LIVE, robot, _STREAM), live_topic(robot, _STREAM))
    }

    def take(topic: str, payload: bytes) -> None:
        delays[lanes[topic]].append(time.time_ns() / 1e6 - decode_live(payload).t_us / 1e3)

    source, pause = "ros1" if ros2 is None else "ros2", threading.Event()
    with (
        tempfile.TemporaryDirectory() as name,
        Mosquitto(program, Path(name)) as broker,
        subscribed(broker, list(lanes), take),
        _graph(ros2, Path(name)) as graph,
    ):
        folder = Path(name)
        cars = {who: _car(broker, folder, robot, source, ring=who == WITH) for robot, who in robots.items()}
        processes = {
            who: graph.start("iort_agent.cli", "run", "--config", car, "--drain-s", 1)
            for who, car in cars.items()
        }
        bag, topics = folder / "bag", ["/small", "/large", "/demand"]
        if ros2 is None:
            command = [
                SYSTEM_PYTHON,
                str(shutil.which("rosbag")),
                "record",
                "--quiet",
                "-O",
                f"{bag}.bag",
                *topics,
            ]
            processes[RECORDER] = graph.run(command)
        elif ros2.has("ros2bag"):
            processes[RECORDER] = graph.run(["ros2", "bag", "record", "-s", "mcap", "-o", str(bag), *topics])
        # The two agents' demands, and each ring's topics and the recorder's.
        publisher = graph.start(
            "bench.ros.recorder_publisher", "bench", folder, *(["--ros2"] if ros2 is not None else []),
            "--subscribers", 2 if RECORDER in processes else 1,
        )  # fmt: skip
        _line(publisher, "ready")
        pause.wait(_WARM_UP_S)
        status = _status(cars[WITH])
        warm = {who: len(found) for who, found in delays.items()}
        written, before, began = _written(status, folder), machine.usages(processes), time.monotonic()
        pause.wait(seconds)
        after, took_s = machine.usages(processes), time.monotonic() - began
        status = _status(cars[WITH])
        now_written = _written(status, folder)
        live = {who: Spread.of(found[warm[who] :]) for who, found in delays.items()}
        cutting = machine.threads_of(processes[WITH].pid)[_CUTS]
        _say(publisher, f"demand {_DEMAND}")
        incidents = cars[WITH].parent / "ring" / "incidents"
        if not reached(lambda: bool(list(incidents.glob("*.mcap"))), within_s=_END_S):
            raise InstrumentError("no incident was cut")
        incident_s = machine.threads_of(processes[WITH].pid)[_CUTS].cpu_s - cutting.cpu_s
        _say(publisher, "quit")
        published = int(_line(publisher))
        incident = sum(path.stat().st_size for path in incidents.glob("*.mcap"))
        for who, process in processes.items():
            process.send_signal(signal.SIGINT if who == RECORDER else signal.SIGTERM)
        for process in processes.values():
            process.wait(_END_S)
    return Run(
        "rosbag record" if ros2 is None else "ros2 bag record",
        took_s,
        published,
        {who: (usage.cpu_s - before[who].cpu_s) / took_s for who, usage in after.items()},
        {who: size - written[who] for who, size in now_written.items()},
        live,
        sum(status["recorder"]["ring"]["dropped"].values()),
        incident,
        incident_s,
    )


def _status(car: Path) -> dict[str, Any]:
    found: list[dict[str, Any]] = []

    def answered() -> bool:
        try:
            found.append(fetch(car.parent / SOCKET))
        except AgentError:
            return False
        return True

    if not reached(answered, within_s=_START_S):
        raise InstrumentError("the agent does not answer")
    return found[-1]


def _written(status: Mapping[str, Any], folder: Path) -> dict[str, int]:
    """The bytes that the ring and ROS' recorder have written so far."""
    bag = sum(path.stat().st_size for path in (*folder.glob("bag*.bag*"), *folder.glob("bag/*")))
    return {WITH: round(status["recorder"]["ring"]["written_mb"] * 1e6), **({RECORDER: bag} if bag else {})}


def _say(process: subprocess.Popen[str], line: str) -> None:
    assert process.stdin is not None
    process.stdin.write(f"{line}\n")
    process.stdin.flush()


def _line(process: subprocess.Popen[str], wanted: str = "") -> str:
    assert process.stdout is not None
    line = process.stdout.readline().strip()
    if not line or (wanted and line != wanted):
        raise InstrumentError(f"the publisher ended: {line!r}")
    return line


def report(section: Section, runs: list[Run]) -> None:
    """Add the tables and the ratios."""
    rows = []
    for one in runs:
        order = (WITH, WITHOUT, RECORDER)
        share = [f"{one.core[who]:.1%}" if who in one.core else "-" for who in order]
        rows.append([f"processor, of one core, beside {one.recorder}", *share])
        written = [
            f"{one.written[who] / one.seconds / 1e6:.2f} MB/s" if who in one.written else "-" for who in order
        ]
        rows.append([f"written, beside {one.recorder}", *written])
        live = [one.live[who].text(2) if who in one.live else "-" for who in order]
        rows.append([f"live lane, beside {one.recorder}", *live])
        if RECORDER in one.core:
            section.ratio(
                f"processor of the agent with the ring / {one.recorder}'s",
                one.core[WITH] / one.core[RECORDER], TIMES, tolerance=2,
            )  # fmt: skip
            section.ratio(
                f"bytes that the ring writes / {one.recorder}",
                one.written[WITH] / one.written[RECORDER],
                TIMES,
            )
        plain, ringed = one.live[WITHOUT].p50, one.live[WITH].p50
        if plain is not None and ringed is not None:
            section.ratio(
                f"live lane with the ring, later than without (p50), beside {one.recorder}",
                ringed - plain,
                None,
                unit="ms",
                tolerance=3,
            )
        of_s = _BEFORE_S + _AFTER_S
        everything = one.written[WITH] / one.seconds * of_s
        section.ratio(
            f"processor of an incident / the agent's of its {of_s:g} s, beside {one.recorder}",
            one.incident_s / (one.core[WITH] * of_s),
            None,
        )
        section.ratio(
            f"messages that the ring dropped, beside {one.recorder}", one.dropped, 0, unit="messages"
        )
        section.ratio(
            f"bytes of an incident / the ring's of that time, beside {one.recorder}",
            one.incident / everything,
            TIMES,
        )
        hour = one.written[WITH] / one.seconds * 3600
        section.ratio(
            f"uploaded with one such incident an hour / uploading everything, beside {one.recorder}",
            one.incident / hour, None,
        )  # fmt: skip
    section.table("1,000 small messages and 30 of 100 KB a second", ["figure", WITH, WITHOUT, RECORDER], rows)
    section.raw = {"runs": [asdict(one) for one in runs]}


SECTION = Declared(
    "the event recorder's ring, beside rosbag record and ros2 bag record",
    run,
    (Option("SECONDS", int, 30, "seconds of each drive"),),
    Report("recorder", "The event recorder", "make bench ONLY=recorder"),
    cloud=False,
)
