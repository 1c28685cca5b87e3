"""The simulated car's ROS graph: it takes drive commands as a real car's does, and nobody else hears them."""

from __future__ import annotations

import threading

from iort_agent.clock import Clock
from iort_agent.errors import SourceError
from iort_agent.ros1.graph import Graph, OnBytes
from iort_agent.ros1.json_message import decode
from iort_agent.ros1.trigger import OnTrigger
from iort_agent.sources.sim.driver import Wish
from iort_contract.messages.control.commands import MAX_LEASE_MS
from iort_contract.messages.control.driving import DRIVE_TYPE
from iort_contract.ros1.definition import Definition, parse

_RULE = "=" * 80
_DRIVE = parse(
    DRIVE_TYPE,
    f"""Header header
AckermannDrive drive
{_RULE}
MSG: std_msgs/Header
uint32 seq
time stamp
string frame_id
{_RULE}
MSG: ackermann_msgs/AckermannDrive
float32 steering_angle
float32 steering_angle_velocity
float32 speed
float32 acceleration
float32 jerk
""",
)
# A command without a lease has no end of its own.
_LONGEST_S = MAX_LEASE_MS / 1000


class SimGraph(Graph):
    """Keeps the newest drive command, of any topic, until that topic is released. Safe to use from several
    threads."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._wish: Wish | None = None
        self._topic = ""
        self._until = 0.0

    def wish(self) -> Wish | None:
        """What the command in force wants; None if the car's own driver drives."""
        with self._lock:
            return self._wish if self._clock.monotonic() < self._until else None

    def definition(self, kind: str) -> Definition:
        if kind != DRIVE_TYPE:
            raise SourceError(f"a simulated car takes commands of the type {DRIVE_TYPE} only, got {kind}")
        return _DRIVE

    def advertise(self, topic: str, kind: str) -> None:  # noqa: ARG002 - as the graph has it
        self.definition(kind)

    def publish(self, topic: str, data: bytes) -> bool:
        drive = decode(_DRIVE, data)["drive"]
        with self._lock:
            self._wish, self._topic = Wish(drive["speed"], drive["steering_angle"]), topic
            self._until = self._clock.monotonic() + _LONGEST_S
        return True

    def release(self, topic: str) -> None:
        with self._lock:
            if topic == self._topic:
                self._wish = None

    def subscribe(self, topic: str, handler: OnBytes) -> None:  # noqa: ARG002 - as the graph has it
        raise SourceError(f"a simulated car publishes no ROS topics, so it cannot share {topic}")

    def offer(self, service: str, handler: OnTrigger) -> None:  # noqa: ARG002 - as the graph has it
        raise SourceError(f"a simulated car has no ROS nodes, so nobody could call {service}")

    def waits(self) -> str | None:
        return None

    def start(self) -> None:
        pass

    def close(self) -> None:
        pass
