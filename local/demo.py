"""`make demo`: a car drives through the embedded cloud, and the demo counts the samples that arrive.

python -m local.demo --duration 20 --bag drive.bag --report report.json
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from botocore.exceptions import BotoCoreError, ClientError
from rich.console import Console

from iort_agent.common.schema import Place
from iort_agent.common.threads import SystemClock
from iort_agent.errors import ConfigError, SourceError
from iort_agent.sources.recording import BagConfig, BagSource
from iort_agent.sources.sim.driver import HALL
from iort_agent.sources.sim.faults import fault_rule
from iort_contract.catalog.streams import OWN_STREAMS, RTT_STREAM
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.cloud import IOT, PUBNUB
from iort_contract.messages.commands import MAX_LEASE_MS, stick_downlink
from iort_contract.topics import PING_PATHS
from iort_station import kept
from iort_station.errors import StationError
from iort_station.fleet import robots
from iort_station.fleet.viewing import Viewer
from iort_station.operations import audit
from iort_station.page import answers as control
from iort_station.page.answers import actions, answers, downloads
from iort_station.page.listening import listening
from iort_station.page.live import Listening
from iort_station.page.motion import reaching
from iort_station.page.server import PageServer
from local import ros2_car
from local.cloud import FOLDER, EmbeddedCloud
from local.deployment import ROOT
from local.figures import Figures, Spread, round_trips
from local.processes import Child, LocalError, interrupt_by_signals


def read() -> argparse.Namespace:
    """The options; ends the process with an error if one is wrong."""
    parser = argparse.ArgumentParser(
        prog="make demo",
        usage="make demo [DURATION=20] [BAG=drive.bag] [FAULTS=kind:strength] [ROS2=1] [LIVE=pubnub] "
        "[REPORT=r.json] [PORT=8080]",
        description="A car drives through the embedded cloud, and the demo counts the samples that arrive.",
    )
    parser.add_argument("--duration", type=_positive, metavar="S", help="seconds to drive (default 60)")
    parser.add_argument(
        "--bag", type=Path, metavar="FILE", help="drive a recording instead of a simulated car"
    )
    parser.add_argument(
        "--faults", type=_faults, default=[], metavar="KIND:STRENGTH,...", help="of the simulated car"
    )
    parser.add_argument(
        "--ros2", action="store_true", help="simulate the car in a ROS 2 graph, which the agent joins"
    )
    parser.add_argument(
        "--live",
        choices=[IOT, PUBNUB],
        default=IOT,
        help="the way of live messages: AWS IoT's own, or PubNub's with a stand-in (default: %(default)s)",
    )
    parser.add_argument("--report", type=Path, metavar="FILE", help="write the figures as JSON")
    parser.add_argument("--port", type=int, default=0, help="the page's port (default: a free one)")
    parser.add_argument(
        "--folder", type=Path, default=FOLDER, help="where the embedded cloud keeps its state"
    )
    options = parser.parse_args()
    if options.bag is not None and not options.bag.exists():
        parser.error(f"BAG must exist, got {options.bag}")
    if options.bag is not None and (options.faults or options.ros2):
        parser.error("FAULTS and ROS2 are of a simulated car: give no BAG")
    if options.bag is not None:
        try:
            with BagSource(BagConfig(path=options.bag), SystemClock()).open() as messages:
                next(messages, None)
        except SourceError as error:
            parser.error(f"BAG={error}")
    if options.ros2:
        try:
            options.ros2 = ros2_car.find()
        except LocalError as error:
            parser.error(str(error))
    if options.report is not None and not options.report.absolute().parent.is_dir():
        parser.error(f"REPORT must be in an existing folder, got {options.report}")
    if options.report is not None and options.report.is_dir():
        parser.error(f"REPORT must be a file, got the folder {options.report}")
    if not 0 <= options.port <= 65535:
        parser.error(f"PORT must be 1 to 65535, got {options.port}")
    try:
        socket.create_server(("127.0.0.1", options.port)).close()
    except OSError as error:
        parser.error(f"PORT must be free, got {options.port}: {error.strerror}; give none for a free one")
    return options


def _faults(value: str) -> list[dict[str, Any]]:
    """Faults as in a car.yaml, from a text such as ``worn_battery:strong,payload:1.2``."""
    faults: list[dict[str, Any]] = []
    for part in value.split(","):
        kind, _, strength = part.partition(":")
        fault: dict[str, Any] = {"kind": kind}
        if strength:
            with suppress(ValueError):
                fault["strength"] = float(strength)
            fault.setdefault("strength", strength)
        try:
            fault_rule(fault, Place(Path("FAULTS")))
        except ConfigError as error:
            raise argparse.ArgumentTypeError(str(error)) from error
        faults.append(fault)
    return faults


def _positive(value: str) -> float:
    try:
        seconds = float(value)
    except ValueError:
        seconds = 0.0
    if not 0 < seconds <= 86_400:
        raise argparse.ArgumentTypeError(f"DURATION must be over 0 and at most 86400 s, got {value}")
    return seconds


ROBOT = "car1"
ROBOT_LOG = "ros2-car.log"
_SOURCE_RATE_HZ = 50
# Ten pings a second of half a kilobyte over each path.
_PING = {"rate_hz": 10, "paths": list(PING_PATHS), "padding_bytes": 430}
# An hour of the demo's car.
_RECORDER = {"max_mb": 200}
# `iort send car1 drive '{"drive": {"speed": 1.0}}' --lease-ms 5000`, and the stick of page and terminal.
# Nobody is hurt by a long lease.
DOWNLINK = stick_downlink(MAX_LEASE_MS)
_STANDS_S = 60.0
_STATUS_S = 1.0
_LOOK_S = 1.0


def _camera() -> dict[str, Any]:
    """The section for the simulated car's camera, where the packages for it are installed."""
    installed = all(importlib.util.find_spec(name) for name in ("aiortc", "av", "PIL"))
    return {"video": {"source": {"type": "sim"}}} if installed else {}


def main() -> None:
    """Run the demo. The exit status is 0 if no sample was lost, 1 if one was, and 2 if it could not run."""
    given = read()
    stopped = threading.Event()

    # Every signal that stops the demo stops the processes that it started.
    interrupt_by_signals(stopped)
    console = Console()
    try:
        figures = _Demo(given, console, stopped).run()
    except (LocalError, StationError) as error:
        console.print(f"demo: {error}", style="red", markup=False, highlight=False)
        sys.exit(2)
    except (BotoCoreError, ClientError) as error:
        console.print(f"demo: the embedded cloud refused a call: {error}", style="red", markup=False)
        sys.exit(2)
    except KeyboardInterrupt:
        console.print("stopped; nothing is left running")
        sys.exit(130)
    if stopped.is_set():
        console.print("stopped; nothing is left running")
    sys.exit(1 if figures.samples_lost else 0)


class _Demo:
    def __init__(self, given: argparse.Namespace, console: Console, stopped: threading.Event) -> None:
        self._options, self._console, self._stopped = given, console, stopped
        self._began = time.monotonic()
        # What a car of its own process says that it has published.
        self._published: int | None = None

    def run(self) -> Figures:
        with ExitStack() as stack:
            live = self._options.live
            embedded = stack.enter_context(
                EmbeddedCloud(self._options.folder, live=live, progress=self._step)
            )
            vehicles = {ROBOT: dict(robots.F1TENTH)}
            page = stack.enter_context(
                PageServer(
                    namespace=embedded.namespace,
                    **reaching(embedded.cloud, live),
                    vehicles=vehicles,
                    answers=answers(embedded.cloud),
                    downloads=downloads(embedded.cloud),
                    track=HALL if self._options.bag is None else None,
                    open_actions=actions(embedded.cloud),
                    actions=control.keyed_actions(embedded.cloud),
                    port=self._options.port,
                    invitations=kept.pages(),
                )
            )
            embedded.show_page(page.url)
            listener = stack.enter_context(listening(embedded.cloud, live, robot=ROBOT))
            self._step("car")
            bundle = robots.add(
                embedded.cloud, ROBOT, out=embedded.folder / "robots", settings=self._settings()
            )
            self._console.print(
                f"\n[bold]Watch the car:[/bold] {page.invitation(f'#/car/{ROBOT}')}",
                highlight=False,
                soft_wrap=True,
            )
            ports = (page.port, *embedded.page_ports)
            forwarded = " ".join(f"-L {port}:127.0.0.1:{port}" for port in ports)
            self._console.print(f"From elsewhere: ssh {forwarded} {socket.gethostname()}\n", highlight=False)
            report = self._drive(embedded, bundle, listener)
            figures = self._count(embedded, report, listener)
            self._console.print(figures.as_table())
            if self._options.report is not None:
                self._options.report.write_text(json.dumps(figures.as_json(), indent=2) + "\n")
            if sys.stdin.isatty() and sys.stdout.isatty():
                # Ctrl-C after the figures is no failure.
                with suppress(KeyboardInterrupt):
                    self._stay(embedded, bundle, page.invitation())
            return figures

    def _step(self, name: str) -> None:
        self._console.print(f"{time.monotonic() - self._began:5.1f} s  {name}", highlight=False)

    def _settings(self, *, ends: bool = True) -> dict[str, Any]:
        return {**self._driven(ends=ends), "ping": _PING, "recorder": _RECORDER}

    def _driven(self, *, ends: bool) -> dict[str, Any]:
        """What drives: a recording, a car in ROS 2, or one that the agent simulates."""
        if self._options.bag is not None:
            given = {"duration_s": self._options.duration} if self._options.duration and ends else {}
            loop = {} if ends else {"loop": True}
            bag = {"type": "bag", "path": str(self._options.bag.resolve()), **given, **loop}
            return {"sources": [bag]}
        ros2: ros2_car.Ros2 | None = self._options.ros2 or None
        if ros2 is not None:
            return {"sources": [ros2.source()], "downlink": ros2.downlink(MAX_LEASE_MS)}
        return {"sources": [{"type": "sim", **self._car(ends=ends)}], "downlink": DOWNLINK, **_camera()}

    def _car(self, *, ends: bool) -> dict[str, Any]:
        """The settings of the simulated car."""
        faults = {"faults": self._options.faults} if self._options.faults else {}
        duration = {"duration_s": self._options.duration or 60.0} if ends else {}
        return {"stream": VESC_STREAM, "rate_hz": _SOURCE_RATE_HZ, **faults, **duration}

    @contextmanager
    def _robot(self, embedded: EmbeddedCloud, *, ends: bool) -> Iterator[Child | None]:
        """The simulated car in the ROS 2 graph; None if the agent simulates it."""
        if not self._options.ros2:
            yield None
            return
        command = [sys.executable, "-m", "local.ros2_car", "--settings", json.dumps(self._car(ends=ends))]
        environment = {**self._options.ros2.environment, "HOME": str(embedded.folder)}
        log = embedded.folder / ROBOT_LOG
        robot = Child("the car", command, environment=environment, cwd=ROOT, log=log)
        try:
            yield robot
        finally:
            robot.stop()

    def _drive(self, embedded: EmbeddedCloud, bundle: robots.Bundle, listener: Listening) -> dict[str, Any]:
        report = embedded.folder / "agent-report.json"
        # The figures are of a car that somebody looks at from its start.
        viewer = Viewer(embedded.cloud, [ROBOT], every_s=_LOOK_S, broker=embedded.live == IOT)
        with (
            viewer,
            self._robot(embedded, ends=True) as robot,
            self._agent(embedded, bundle, "--report", str(report)) as agent,
        ):
            began = time.monotonic()
            with self._console.status("starting the agent") as status:
                while self._running(agent) and (robot is None or robot.poll() is None):
                    embedded.emulator.check()
                    status.update(self._status_line(embedded, listener, time.monotonic() - began))
            if robot is not None:
                if robot.poll() != 0:
                    raise LocalError(robot.ended() if robot.poll() else f"the agent ended:\n{agent.tail()}")
                self._published = ros2_car.published(embedded.folder / ROBOT_LOG)
                agent.interrupt()
                agent.wait(_STANDS_S)
            if not report.exists():
                raise LocalError(f"the agent stopped with status {agent.poll()}:\n{agent.tail()}")
            if agent.poll():
                self._console.print(
                    f"the agent reports a failure:\n{agent.tail()}", style="red", markup=False
                )
        written: dict[str, Any] = json.loads(report.read_text())
        return written

    def _running(self, agent: Child) -> bool:
        """Wait a second; whether the agent still runs. Raises KeyboardInterrupt if the demo was stopped."""
        if self._stopped.is_set():
            raise KeyboardInterrupt
        return agent.wait(_STATUS_S) is None

    def _status_line(self, embedded: EmbeddedCloud, listener: Listening, seconds: float) -> str:
        stream = self._options.ros2.stream if self._options.ros2 else VESC_STREAM
        stored = sum(len(b.times_us) for b in audit.batches(embedded.cloud, ROBOT, stream))
        heard = list(listener.heard)
        delay = f"{heard[-1].delay_ms:.0f} ms" if heard else "-"
        return (
            f"driving {seconds:3.0f} s, stored {stored:,} samples, live {len(heard):,} updates, delay {delay}"
            + (f", {listener.malformed} malformed" if listener.malformed else "")
        )

    def _count(self, embedded: EmbeddedCloud, report: dict[str, Any], listener: Listening) -> Figures:
        """Read the tables until Lambda 2 has summarised every sample, or has done nothing for a minute."""
        streams = [name for name in report["streams"] if name not in OWN_STREAMS]
        sent = self._published
        if sent is None:
            sent = sum(report["streams"][name]["samples"] for name in streams)
        before, deadline = -1, 0.0
        while True:
            found = [audit.delivery(embedded.cloud, ROBOT, stream, report["boot"]) for stream in streams]
            summarized = sum(one.samples_summarized for one in found)
            stored = sum(one.samples_stored for one in found)
            if summarized > before:
                before, deadline = summarized, time.monotonic() + _STANDS_S
            if summarized >= sent or time.monotonic() > deadline:
                break
            # No event tells that the stream of Lambda 2 is empty.
            threading.Event().wait(0.2)
        return Figures(
            samples_sent=sent,
            samples_stored=stored,
            samples_summarized=summarized,
            live_published=report["lanes"]["live"]["published"],
            live_received=len({(h.stream, h.boot, h.seq) for h in listener.heard}),
            rtt_ms=round_trips(audit.batches(embedded.cloud, ROBOT, RTT_STREAM)),
            car_to_dashboard_ms=Spread.of([h.delay_ms for h in listener.heard]),
        )

    def _stay(self, embedded: EmbeddedCloud, bundle: robots.Bundle, url: str) -> None:
        """Let the car drive on until Ctrl-C, for the page."""
        robots.configure(bundle, self._settings(ends=False))
        self._console.print(
            f"\nThe car drives on: {url}  Ctrl-C stops everything.", highlight=False, soft_wrap=True
        )
        with self._robot(embedded, ends=False), self._agent(embedded, bundle) as agent:
            while self._running(agent):
                embedded.emulator.check()
            raise LocalError(f"the agent stopped with status {agent.poll()}:\n{agent.tail()}")

    @contextmanager
    def _agent(self, embedded: EmbeddedCloud, bundle: robots.Bundle, *arguments: str) -> Iterator[Child]:
        command = [
            str(Path(sys.executable).parent / "iort-agent"),
            "--config",
            str(bundle.config),
            *arguments,
        ]
        ros2: dict[str, str] = self._options.ros2.environment if self._options.ros2 else {"PATH": ""}
        agent = Child(
            "the agent",
            command,
            environment={**ros2, "HOME": str(embedded.folder)},
            cwd=ROOT,
            log=embedded.folder / "agent.log",
        )
        try:
            yield agent
        finally:
            agent.interrupt()
            agent.wait(15.0)
            agent.stop()


if __name__ == "__main__":
    main()
