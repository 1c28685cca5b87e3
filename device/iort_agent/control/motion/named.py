"""The names of commands, and what they move: several names may move the robot by one ROS topic."""

from __future__ import annotations

from typing import Any, Mapping

from iort_agent.control.config import CommandConfig
from iort_agent.control.motion.driving import drive_sample
from iort_agent.control.motion.leases import Leases, Limits
from iort_agent.errors import ConfigError
from iort_agent.ros1.json_message import encode
from iort_contract.limits import MessageError, Value
from iort_contract.messages.control.commands import Command
from iort_contract.messages.control.driving import DriveLimits
from iort_contract.ros1.definition import Definition


class Motion:
    """What moves the robot by one ROS topic: its lease, whichever commands renew it, and its stop."""

    def __init__(self, topic: str, stop: Mapping[str, Any], definition: Definition) -> None:
        self.topic, self.leases = topic, Leases()
        self._stop, self._definition = stop, definition
        self.stopping = False
        # What the guard knows: the lease's end, and whether an emergency stop holds.
        self.guarded: tuple[float | None, bool] = (None, False)
        # The name of the newest command that passed.
        self.last: Named | None = None
        self.stops = 0
        # The newest stop could not be published: the agent is not in the ROS graph.
        self.unheard = False
        # When the first stop is written, for sure.
        self.written = 0.0

    def next_due(self, now: float) -> float | None:
        """When something is to be done next; None while nothing moves."""
        due = self.leases.next_due()
        return self.written if now < self.written and (due is None or self.written < due) else due

    def stop(self, now_us: int) -> bytes:
        return encode(self._definition, self._stop, now_us=now_us, partial=True)


class Named:
    """The commands of one name. ``motion`` is what they move, ``limits`` are those of a stick, if it drives
    this command."""

    def __init__(
        self,
        name: str,
        config: CommandConfig,
        definition: Definition,
        *,
        skew_s: float,
        motion: Motion | None,
        limits: DriveLimits | None,
    ) -> None:
        self.name, self.config, self.definition = name, config, definition
        self.motion, self.limits = motion, limits
        lease_s = config.motion.lease_s if config.motion is not None else None
        self.allowed = Limits(config.max_age_s, skew_s, lease_s)
        self.leases = motion.leases if motion is not None else Leases()
        self.passed = self.limited = 0
        # When the next refused motion becomes a sample.
        self.refused_due = 0.0

    def check(self, now_us: int) -> None:
        """Raise `ConfigError` if the stop, or what a stick drives, does not fit the ROS type."""
        try:
            if self.motion is not None:
                self.motion.stop(now_us)
        except MessageError as error:
            raise ConfigError(f"downlink.cmd.{self.name}.motion.stop: {error}") from error
        if self.limits is not None:
            try:
                self.data(self.limits.message(0.0, 0.0), now_us)
            except MessageError as error:
                raise ConfigError(
                    f"downlink.drive: {error}; downlink.cmd.{self.name}.partial must be true if the message "
                    "has other fields"
                ) from error

    def data(self, message: Mapping[str, Any], now_us: int) -> bytes:
        return encode(self.definition, message, now_us=now_us, partial=self.config.partial)

    def sample(self, command: Command, outcome: str, now: float) -> Mapping[str, Value]:
        left_s = self.leases.left_s(now)
        return drive_sample(command, outcome, self.leases.driver(now), left_s, self.limits)

    def report(self) -> dict[str, int]:
        counts = {"passed": self.passed, "stops": self.motion.stops if self.motion is not None else 0}
        return {**counts, "limited": self.limited} if self.limits is not None else counts
