"""A simulated car: the physics of `vehicle`, sampled as from a real VESC, and its pose."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass
from typing import Any, Sequence

from iort_agent.clock import Clock, Pace
from iort_agent.common.schema import Place, existing_path, items, number, section, setting, text
from iort_agent.sources import Emit, Source, SourceConfig
from iort_agent.sources.sim.circuit import HALL, Circuit
from iort_agent.sources.sim.faults import FaultConfig, fault_rule
from iort_agent.sources.sim.graph import SimGraph
from iort_agent.sources.sim.parameters import VehicleConfig
from iort_agent.sources.sim.sensors import FIELDS, ROS1, Sensors
from iort_agent.sources.sim.vehicle import Vehicle
from iort_contract.catalog.streams import POSE_STREAM
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.limits import ContractError
from iort_contract.topics import check_stream
from iort_contract.track import Track, parse_track

_MAX_STEP_S = 0.02
_MAX_TRACK_BYTES = 4_000_000


@dataclass(frozen=True)
class PoseConfig:
    """The stream of the car's poses, as a localisation gives them; 0 Hz for none."""

    stream: str = setting(text(check_stream), POSE_STREAM)
    rate_hz: float = setting(number(0, 100, unit="Hz"), 20.0)


def _track(value: Any, place: Place) -> Track:
    path = existing_path()(value, place)
    try:
        with path.open("rb") as file:
            return parse_track(file.read(_MAX_TRACK_BYTES).decode())
    except (OSError, UnicodeDecodeError, ContractError) as error:
        raise place.problem(f"{path}: {error}") from error


@dataclass(frozen=True)
class SimConfig(SourceConfig):
    """A simulated car. One ``seed`` always drives the same laps; without ``duration_s`` it never stops.

    ``track`` is a CSV file of the centre line and widths; without one, the car drives in a hall of our own.
    ``pace`` is the driver's share of the highest speed. ``fields``: ``ros1`` are the ROS 1 driver's, ``all``
    are those that a VESC sends on its serial line. ``faults`` are explained on the simulated car's own page.
    """

    stream: str = setting(text(check_stream), VESC_STREAM)
    rate_hz: float = setting(number(0.1, 2000, unit="Hz"), 50.0)
    duration_s: float | None = setting(number(0.001, 1e9, unit="s"), None)
    seed: int = setting(number(0, 2**31, whole=True), 1)
    pose: PoseConfig = setting(section(PoseConfig), PoseConfig())
    track: Track = setting(_track, HALL)
    pace: float = setting(number(0.1, 1), 1.0)
    fields: str = setting(FIELDS, ROS1)
    vehicle: VehicleConfig = setting(section(VehicleConfig), VehicleConfig())
    faults: tuple[FaultConfig, ...] = setting(items(fault_rule, what="a list of faults"), ())

    def streams(self) -> Sequence[str]:
        """The VESC's stream, and the pose's."""
        return [self.stream, self.pose.stream] if self.pose.rate_hz else [self.stream]

    def describe(self) -> str:
        """The source in a few words."""
        wrong = " and ".join(fault.kind for fault in self.faults)
        return f"simulated car at {self.rate_hz:g} Hz" + (f" with {wrong}" if wrong else "")

    def build(self, clock: Clock) -> SimSource:
        """Make the source."""
        return SimSource(self, clock)


class SimSource(Source):
    """Emits exactly ``rate_hz * duration_s`` samples, each at its absolute deadline, less those that an
    intermittent CAN loses. The car obeys the commands that ``graph`` takes."""

    def __init__(self, config: SimConfig, clock: Clock) -> None:
        self._config = config
        self._clock = clock
        self.graph = SimGraph(clock)

    def run(self, emit: Emit, stop: threading.Event) -> None:
        """Drive until the duration is over or ``stop`` is set."""
        config = self._config
        vehicle = Vehicle(
            config.vehicle, config.seed, Circuit(config.track), faults=config.faults, pace=config.pace
        )
        measured = Sensors(vehicle, config.seed, config.fields)
        pace = Pace(self._clock, stop)
        steps = math.ceil(1 / config.rate_hz / _MAX_STEP_S)
        total = None if config.duration_s is None else round(config.rate_hz * config.duration_s)
        done = poses = 0
        while (total is None or done < total) and pace.until(done / config.rate_hz):
            for _ in range(steps):
                vehicle.step(1 / config.rate_hz / steps, self.graph.wish())
            now_us = self._clock.now_us()
            if not vehicle.damage.silent:
                emit(config.stream, now_us, measured.vesc())
            # With the first sample at or after its time, so that both have the same time.
            due = math.floor(done * config.pose.rate_hz / config.rate_hz) + 1
            if config.pose.rate_hz and due > poses:
                emit(config.pose.stream, now_us, measured.pose())
                poses = due
            done += 1
