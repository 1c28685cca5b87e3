"""The robot of the recorder's proof: an agent with a ring on a small disk of its own, and its publishers."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from iort_agent.status import SOCKET
from iort_contract.messages.recorder import UPLOADED, Incident, Trigger, encode_trigger
from iort_station.data.incidents import incidents
from iort_station.fleet import robots
from iort_station.fleet.control import Shadow
from local.cloud import EmbeddedCloud
from testkit.proxy import Proxy
from testkit.waiting import until
from tests.ros.process import Process
from tests.ros.recorder.account import LATCHED, Sent, sent

NODES = Path(__file__).resolve().parents[1] / "nodes"
TOPICS = ("/small", "/large", "/demand", LATCHED)
# The demands that fire.
ONE, OTHER, OFTEN = 1, 2, 3
DISK_MB = 1000
WAIT_S = 300.0
_MEGABYTE = bytes(1_000_000)


@contextmanager
def small_disk(folder: Path) -> Iterator[Path | None]:
    """A disk that can be filled; None for who may not mount one."""
    if os.geteuid() != 0:
        yield None
        return
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={DISK_MB}m", "tmpfs", str(folder)], check=True)
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


class Robot:
    """The agent and the publishers in a graph of either ROS."""

    def __init__(self, graph: Any, cloud: EmbeddedCloud, proxy: Proxy, disk: Path | None) -> None:
        self.graph, self.cloud, self.proxy, self.disk = graph, cloud, proxy, disk
        self.behind = graph.folder / "behind"
        self.behind.write_text("0")
        topics = {
            "/small": {"stream": "small", "time": "header", "only": "ring"},
            "/large": {"stream": "large", "time": "header", "only": "ring"},
            "/demand": {"stream": "demand", "time": "header"},
            LATCHED: {"stream": "static", "time": "header", "only": "ring"},
        }
        self.ring = (disk or graph.folder) / "ring"
        settings = {
            "port": proxy.port,
            "queue": {"path": "spool.db", "max_bytes": 4_000_000},
            "files": {"rate_kb_s": 0},
            "sources": [{"type": f"ros{graph.ros}", "topics": topics}],
            "recorder": {
                "folder": str(self.ring), "keep_free_mb": 0, "max_mb": 400, "max_disk_share": 0.5,
                "topics": list(TOPICS),
            },
        }  # fmt: skip
        self.bundle = robots.add(cloud.cloud, graph.folder.name, out=graph.folder, settings=settings)
        self.agent: Process
        self.publisher: Process
        self._published: list[Path] = []

    # --- processes ---------------------------------------------------------------------------------

    def start_agent(self) -> None:
        """Start an agent, and wait for its connection."""
        config = self.bundle.folder / self.bundle.config.name
        command = [self.graph.python, NODES / "clock_agent.py", self.behind, "run", "--config", config]
        self.agent = self.graph.start([*map(str, command), "--drain-s", "5"])

    def start_publisher(self) -> None:
        """Start a publisher, and wait until the agent hears it."""
        name = f"robot{len(self._published)}"
        flags = ["--latched", *(["--ros2"] if self.graph.ros == 2 else [])]
        self.publisher = self.graph.module("bench.ros.recorder_publisher", name, self.graph.folder, *flags)
        self._published.append(self.graph.folder / f"{name}.sent")
        self.publisher.until(lambda: "ready" in self.publisher.lines, "subscribers")

    def published(self) -> list[list[Sent]]:
        """Every publisher's record, after the last one has ended."""
        return [sent(path) for path in self._published]

    # --- what happens ------------------------------------------------------------------------------

    def trigger(self, *triggers: Trigger) -> None:
        """Put triggers into the shadow, and wait for the robot's answers."""
        shadow = Shadow(self.cloud.cloud, self.bundle.robot)
        for trigger in triggers:
            shadow.desire(encode_trigger(trigger))
        names = {trigger.name for trigger in triggers}

        def accepted() -> bool:
            answers = (self.status().get("recorder") or {}).get("answers", {})
            return names <= {name for name, answer in answers.items() if answer == "accepted"}

        until(accepted, within_s=WAIT_S)

    def demand(self, value: int) -> None:
        """Let a trigger fire."""
        self.publisher.say(f"demand {value}")

    def set_back(self, seconds: int) -> None:
        """Set the robot's clock back."""
        (made := self.behind.with_suffix(".part")).write_text(f"{seconds}")
        made.replace(self.behind)
        self.publisher.say(f"back {seconds}")

    @contextmanager
    def full_disk(self) -> Iterator[None]:
        """Let somebody fill the ring's disk."""
        assert self.disk is not None
        filler = self.disk / "filler"
        with filler.open("wb", buffering=0) as file:

            def full() -> bool:
                # What the ring gives free is taken, too.
                with suppress(OSError):
                    while True:
                        file.write(_MEGABYTE)
                return self._ring_stopped() is True

            until(full, within_s=WAIT_S)
        yield
        filler.unlink()
        until(lambda: self._ring_stopped() is False, within_s=WAIT_S)

    # --- what is seen ------------------------------------------------------------------------------

    def status(self) -> dict[str, Any]:
        """What the agent tells of itself; nothing while it starts."""
        return self.agent.status(self.bundle.folder / SOCKET)

    def told(self) -> dict[str, Any]:
        """Wait for the status."""
        return until(self.status, "the agent's status")

    def _ring_stopped(self) -> bool | None:
        """Whether the ring says that it has no room; None without a status."""
        alarms = self.status().get("alarms")
        said = ("the ring cannot", "the ring keeps nothing")
        return None if alarms is None else any(part in alarm for alarm in alarms for part in said)

    def recorder(self, name: str) -> int:
        """One of the recorder's counts."""
        return int((self.status().get("recorder") or {}).get(name, 0))

    def incidents(self) -> dict[str, Incident]:
        """The incidents that the cloud knows, by id."""
        found = incidents(self.cloud.cloud, self.bundle.robot)
        return {one.incident.id: one.incident for one in found}

    def uploaded(self, known: set[str], count: int = 1) -> list[Incident]:
        """Wait until so many more incidents are uploaded than the known ones; the oldest first."""

        def new() -> list[Incident]:
            found = [
                one for one in self.incidents().values() if one.state == UPLOADED and one.id not in known
            ]
            return found if len(found) >= count else []

        return sorted(until(new, within_s=WAIT_S), key=lambda one: one.from_us)

    def download(self, incident: Incident) -> Path:
        """Get an incident's file from the bucket."""
        path: Path = self.graph.folder / f"{incident.id}.mcap"
        bucket = self.cloud.cloud.output("storage", "FilesBucket")
        self.cloud.cloud.client("s3").download_file(bucket, incident.key, str(path))
        return path
