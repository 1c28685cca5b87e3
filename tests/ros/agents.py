"""The real agent in a graph of either ROS, without a reachable broker: its samples stay in its queue."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple, Protocol

import yaml

from iort_agent.errors import AgentError
from iort_agent.status import fetch
from testkit.waiting import until
from tests.local.faults.test_uplink import self_signed
from tests.ros.process import Process
from tests.unit.agent.test_agent import config_file


class Graph(Protocol):
    """Runs a module under a Python that has the ROS."""

    def module(self, module: str, *arguments: object) -> Process: ...


class Agent(NamedTuple):
    process: Process
    folder: Path

    def status(self) -> dict[str, Any]:
        assert self.process.alive(), "\n".join(self.process.errors)
        try:
            return fetch(self.folder / "agent.sock")
        except AgentError:
            return {}  # none yet, or too busy

    def told(self) -> dict[str, Any]:
        """Wait for the status."""
        return until(self.status, "the agent's status")

    def waits(self) -> list[str] | None:
        """Return the alarms of waiting sources; None without a status."""
        alarms = self.status().get("alarms")
        return None if alarms is None else [one for one in alarms if one.startswith("source waits")]

    def topic(self, name: str) -> dict[str, Any]:
        """Return the counts of a topic of the first source."""
        counts: dict[str, Any] = self.status().get("sources", [{}])[0].get(name, {})
        return counts

    def samples(self, stream: str) -> int:
        return int(self.status().get("streams", {}).get(stream, {}).get("samples", 0))


def agent_of(
    graph: Graph,
    folder: Path,
    *sources: dict[str, Any],
    arguments: tuple[str, ...] = (),
    more: str = "",
) -> Agent:
    """Return the real agent in a graph, without a reachable broker; ``more`` are lines of its car.yaml."""
    command = (
        "iort_agent.cli",
        "run",
        "--config",
        configuration(folder, *sources, more=more),
        "--drain-s",
        0,
        *arguments,
    )
    return Agent(graph.module(*map(str, command)), folder)


def configuration(folder: Path, *sources: dict[str, Any], more: str = "") -> Path:
    """Return the car.yaml of an agent without a reachable broker."""
    text = yaml.safe_dump(list(sources), default_flow_style=True, width=1000).strip()[1:-1]
    config = config_file(folder, text, f"queue: {{path: queue.db}}\nport: 1\n{more}")
    self_signed(folder)
    for made, named in (("private.key", "key.pem"), ("certificate.pem", "cert.pem")):
        (folder / made).replace(folder / named)
    (folder / "ca.pem").write_bytes((folder / "cert.pem").read_bytes())
    return config
