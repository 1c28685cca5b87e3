"""Finds a ROS 2 of this machine, and gives each graph of nodes a domain of its own.

It is the one that is sourced, or else the newest of /opt/ros. The interpreter must have rclpy and the
agent's requirements: this one, if ROS 2 was built for its version, or IORT_ROS2_PYTHON.
"""

from __future__ import annotations

import itertools
import os
import socket
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from testkit.ros import PYTHONPATH, Nodes, Publisher
from testkit.waiting import InstrumentError

INSTALLED = Path("/opt/ros")
ABSENT = f"no ROS 2 is sourced or in {INSTALLED}"
# These have no ROS_AUTOMATIC_DISCOVERY_RANGE.
_OLD = {"foxy", "galactic", "humble"}
# The ports of domains above 101 are those that Linux gives to anybody.
_DOMAINS = itertools.cycle([*range(61, 102), *range(1, 61)])
_FIRST_PORT, _PORTS = 7400, 250


class Ros2Error(InstrumentError):
    """No ROS 2 can be used here; the text says why."""


class Ros2(NamedTuple):
    """A ROS 2: ``environment`` is that of its set-up and of this checkout, ``python`` has rclpy."""

    distribution: str
    environment: dict[str, str]
    python: str

    @property
    def share(self) -> list[Path]:
        """The folders of installed packages' data, the overlays first."""
        return [Path(prefix) / "share" for prefix in self.environment["AMENT_PREFIX_PATH"].split(os.pathsep)]

    def has(self, package: str) -> bool:
        """Whether a package is installed."""
        return any((folder / package / "package.xml").is_file() for folder in self.share)

    def middlewares(self) -> list[str]:
        """The installed middlewares, as RMW_IMPLEMENTATION names them."""
        index = "ament_index/resource_index/rmw_typesupport"
        found = {path.name for folder in self.share for path in (folder / index).glob("rmw_*")}
        return sorted(found - {"rmw_implementation"})

    def alone(self, domain: int) -> dict[str, str]:
        """Return the environment of nodes that only see those of this machine and domain."""
        old = self.distribution in _OLD
        local = {"ROS_LOCALHOST_ONLY": "1"} if old else {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
        return {**self.environment, **local, "ROS_DOMAIN_ID": str(domain)}


def find() -> Ros2:
    """Return the ROS 2 of this machine. Raises `Ros2Error`, with `ABSENT` if there is none."""
    environment = _sourced()
    if environment is None:
        raise Ros2Error(ABSENT)
    found = [one for one in (environment.get("PYTHONPATH"), PYTHONPATH) if one]
    environment |= {"PYTHONPATH": os.pathsep.join(found), "PYTHONUNBUFFERED": "1"}
    first = Path(environment["AMENT_PREFIX_PATH"].split(os.pathsep)[-1]).name
    distribution = environment.get("ROS_DISTRO") or first
    python = os.environ.get("IORT_ROS2_PYTHON") or sys.executable
    tried = subprocess.run(
        [python, "-c", "import rclpy, iort_agent.cli"],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    if tried.returncode:
        why = (tried.stderr.splitlines() or ["no reason"])[-1]
        raise Ros2Error(
            f"{python} cannot import rclpy of {distribution} and the agent ({why}): set IORT_ROS2_PYTHON"
        )
    return Ros2(distribution, environment, python)


def _sourced() -> dict[str, str] | None:
    """Return the environment of the sourced ROS 2, or of the newest installed one."""
    # The domain and the discovery of nodes are the graph's own.
    own = {"ROS_DOMAIN_ID", "ROS_LOCALHOST_ONLY", "ROS_AUTOMATIC_DISCOVERY_RANGE"}
    here = {name: value for name, value in os.environ.items() if name not in own}
    if _rclpy(here):
        return here
    for script in sorted(INSTALLED.glob("*/setup.bash"), reverse=True):
        command = ["bash", "-c", 'source "$0" >&2 && env -0', str(script)]
        done = subprocess.run(command, env=here, capture_output=True, text=True, check=False)
        pairs = (line.partition("=") for line in done.stdout.split("\0") if "=" in line)
        environment = {name: value for name, _, value in pairs}
        if _rclpy(environment):
            return environment
    return None


def _rclpy(environment: Mapping[str, str]) -> bool:
    """Whether it is the environment of a ROS 2 with rclpy; ROS 1 has no ament."""
    prefixes = environment.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    return any(prefix and (Path(prefix) / "share" / "rclpy" / "package.xml").is_file() for prefix in prefixes)


class Domain:
    """A ROS domain that no other process has until `close`."""

    def __init__(self) -> None:
        for number in itertools.islice(_DOMAINS, 101):
            self._claim = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            try:
                # The kernel frees an abstract name when its process ends.
                self._claim.bind(f"\0iort-ros2-domain-{number}")
            except OSError:
                self._claim.close()
                continue
            if not _used(number):
                self.number = number
                return
            self._claim.close()
        raise Ros2Error("every ROS domain is in use")

    def close(self) -> None:
        self._claim.close()


def _used(domain: int) -> bool:
    """Whether somebody listens on the domain's port for discovery."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("", _FIRST_PORT + _PORTS * domain))
        except OSError:
            return True
    return False


class Ros2Graph(Nodes):
    """A graph of one middleware in a domain of its own."""

    def __init__(self, ros2: Ros2, folder: Path, middleware: str) -> None:
        self._domain = Domain()
        environment = {
            **ros2.alone(self._domain.number),
            "RMW_IMPLEMENTATION": middleware,
            "ROS_LOG_DIR": str(folder),
            "ROS_HOME": str(folder),
        }
        super().__init__(ros2.python, folder, environment)

    def __exit__(self, *reason: object) -> None:
        super().__exit__(*reason)
        self._domain.close()

    def publisher(self, load: str, messages: int, subscribers: int) -> Publisher:
        """Return a publisher of the bench's load, which sends so many messages of each topic."""
        return Publisher(self.start("bench.ros.ros2_publisher", load, messages, subscribers))
