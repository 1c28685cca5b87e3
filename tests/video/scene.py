"""The scene of the proof: a car with a camera, viewers, and a network between them.

The car's agent and the viewers are on machines of their own, with the network of `testkit.wire` between them.
The cloud and the page's server are here; both machines reach them by passages, the viewers' with the same
delay as the network. Without namespaces all are on one machine, and nothing is delayed, lost or cut.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from typing_extensions import Self

from iort_agent.status import SOCKET
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.messages.commands import DRIVE_TYPE
from iort_station.cloud import EMBEDDED
from iort_station.fleet import robots
from iort_station.page import motion
from iort_station.page.answers import actions, answers, keyed_actions
from iort_station.page.server import PageServer
from local.cloud import EmbeddedCloud
from testkit.namespaces import Machine, NoNamespacesError
from testkit.proxy import FREEZE, PASS, Proxy
from testkit.waiting import until
from testkit.wire import Wire
from tests.ros.process import Process
from tests.video.account import Shown

LEASE_S = 0.5
LIMIT_MS = 500
SETTINGS: dict[str, Any] = {
    "sources": [{"type": "sim", "stream": VESC_STREAM, "rate_hz": 50}],
    "ping": {"rate_hz": 5},
    "video": {"source": {"type": "sim"}, "max_age_ms": LIMIT_MS},
    "downlink": {
        "cmd": {
            "drive": {
                "topic": "/drive",
                "type": DRIVE_TYPE,
                "partial": True,
                "motion": {"lease_s": LEASE_S, "stop": {"drive": {"speed": 0.0}}},
            }
        },
        "drive": {
            "command": "drive",
            "speed": "drive.speed",
            "steering": "drive.steering_angle",
            "max_speed_mps": 1.5,
        },
    },
}  # fmt: skip


class Receiver:
    """A viewer by aiortc in a process of its own, from `__enter__` to `__exit__`."""

    def __init__(self, scene: Scene) -> None:
        command = [sys.executable, "-m", "tests.video.receiver", "--robot", scene.robot]
        command += ["--embedded", str(scene.embedded.folder / EMBEDDED.name)]
        self._process = Process(scene.there(*command), dict(os.environ))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()

    def _lines(self, key: str) -> Iterator[dict[str, Any]]:
        for line in list(self._process.lines):
            if key in (content := json.loads(line)):
                yield content

    @property
    def shown(self) -> list[Shown]:
        """The pictures so far."""
        return [Shown(one["shown_us"], one["number"]) for one in self._lines("shown_us")]

    @property
    def marks(self) -> dict[int, int]:
        """The capture times by number, as the robot's marks told them."""
        found = ((one["number"], one["captured_us"]) for one in self._lines("shown_us"))
        return {number: captured for number, captured in found if number and captured}

    @property
    def stats(self) -> list[dict[str, Any]]:
        """What `getStats()` said, each second."""
        return [one["stats"] for one in self._lines("stats")]

    def begun(self) -> Self:
        """Wait for the first picture."""
        until(lambda: self.check() and self.shown, "the first picture at the aiortc receiver")
        return self

    def check(self) -> bool:
        assert self._process.alive(), "\n".join(self._process.errors[-25:])
        return True


class Scene:
    """Everything from `__enter__` to `__exit__`, but for the browser."""

    def __init__(
        self, embedded: EmbeddedCloud, folder: Path, *, say: Callable[[str], None], name: str = "seeing"
    ) -> None:
        self.embedded, self.cloud, self.folder, self.robot = embedded, embedded.cloud, folder, name
        self.wire: Wire | None = None
        self._say = say
        self._far: list[Proxy] = []
        self._exit = ExitStack()
        self.agent: Process
        self.server: PageServer
        self.bundle: robots.Bundle

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            try:
                self.wire = stack.enter_context(Wire(self.folder))
            except NoNamespacesError as error:
                self._say(f"no network between the machines, so nothing is delayed, lost or cut: {error}")
            self.bundle = robots.add(self.cloud, self.robot, out=self.folder, settings=SETTINGS)
            self.server = stack.enter_context(
                PageServer(
                    namespace=self.cloud.namespace,
                    **motion.reaching(self.cloud, "iot"),
                    answers=answers(self.cloud),
                    open_actions=actions(self.cloud),
                    actions=keyed_actions(self.cloud),
                )
            )
            gateway = port_of(self.cloud.endpoint_url or "")
            if self.wire is not None:
                for port in (self.cloud.mqtt_port, gateway):
                    self._passage(stack, self.wire.one, port)
                for port in (gateway, port_of(self.cloud.websocket_url), port_of(self.server.url)):
                    self._far.append(self._passage(stack, self.wire.other, port))
            self.start_agent()
            stack.callback(self.agent.kill)
            self._exit = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._exit.close()

    @staticmethod
    def _passage(stack: ExitStack, machine: Machine, port: int) -> Proxy:
        listener = machine.socket(bind=("127.0.0.1", port), listen=True)
        return stack.enter_context(Proxy("127.0.0.1", port, listener=listener))

    def start_agent(self) -> None:
        """Start the agent as a supervisor does, and wait for its connection."""
        command = [sys.executable, "-m", "tests.video.agent", "run", "--config", str(self.bundle.config)]
        here = self.wire.one.command(*command) if self.wire else command
        self.agent = Process([*here, "--drain-s", "5"], dict(os.environ))
        self.agent.until_said("connected to 127.0.0.1")

    def there(self, *command: str) -> list[str]:
        """A command as it is run on the viewers' machine."""
        return self.wire.other.command(*command) if self.wire else [*command]

    def status(self) -> dict[str, Any]:
        """What the agent tells of itself; nothing while it starts."""
        return self.agent.status(self.bundle.folder / SOCKET)

    def passed(self) -> int:
        """How many commands have passed."""
        report = self.status().get("downlink") or {}
        return int((report.get("commands") or {}).get("drive", {}).get("passed", 0))

    def strike(self, *words: object) -> None:
        """Kill a thread of the agent, or let it hang: see `tests.video.agent`."""
        before = len(self.agent.lines)
        self.agent.say(" ".join(map(str, words)))
        (line,) = self.agent.until(lambda: self.agent.lines[before:], "word of the thread")
        assert line == "struck 1", f"no thread {words[1]} in the agent"

    def network(self, **conditions: Any) -> None:
        """Change the network between the car and the viewers: see `testkit.wire.Conditions`."""
        assert self.wire is not None
        self.wire.set(**conditions)
        for passage in self._far:
            passage.latency_s = self.wire.conditions.delay_ms / 1000
            passage.mode = FREEZE if self.wire.conditions.cut else PASS

    @contextmanager
    def cut(self) -> Iterator[None]:
        """Nothing passes between the viewers and anybody."""
        self.network(cut=True)
        try:
            yield
        finally:
            self.network(cut=False)


def port_of(url: str) -> int:
    port = urlsplit(url).port
    assert port is not None, url
    return port
