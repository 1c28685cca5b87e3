"""A simulated car: the physics of `iort_agent.sources.vehicle`, sampled as from a real VESC."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass
from typing import Sequence

from iort_agent.clock import Clock, Pace
from iort_agent.common.schema import number, section, setting, text
from iort_agent.sources import Emit, Source, SourceConfig
from iort_agent.sources.vehicle import Vehicle, VehicleConfig
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.topics import check_stream

_MAX_STEP_S = 0.02


@dataclass(frozen=True)
class SimConfig(SourceConfig):
    """A simulated car. One ``seed`` always drives the same laps; without ``duration_s`` it never stops."""

    stream: str = setting(text(check_stream), VESC_STREAM)
    rate_hz: float = setting(number(0.1, 2000, unit="Hz"), 50.0)
    duration_s: float | None = setting(number(0.001, 1e9, unit="s"), None)
    seed: int = setting(number(0, 2**31, whole=True), 1)
    vehicle: VehicleConfig = setting(section(VehicleConfig), VehicleConfig())

    def streams(self) -> Sequence[str]:
        """The one stream."""
        return [self.stream]

    def describe(self) -> str:
        """The source in a few words."""
        return f"simulated car at {self.rate_hz:g} Hz"

    def build(self, clock: Clock) -> SimSource:
        """Make the source."""
        return SimSource(self, clock)


class SimSource(Source):
    """Emits exactly ``rate_hz * duration_s`` samples, each at its absolute deadline."""

    def __init__(self, config: SimConfig, clock: Clock) -> None:
        self._config = config
        self._clock = clock

    def run(self, emit: Emit, stop: threading.Event) -> None:
        """Drive until the duration is over or ``stop`` is set."""
        config = self._config
        vehicle = Vehicle(config.vehicle, config.seed)
        pace = Pace(self._clock, stop)
        steps = math.ceil(1 / config.rate_hz / _MAX_STEP_S)
        total = None if config.duration_s is None else round(config.rate_hz * config.duration_s)
        done = 0
        while (total is None or done < total) and pace.until(done / config.rate_hz):
            for _ in range(steps):
                vehicle.step(1 / config.rate_hz / steps)
            emit(config.stream, self._clock.now_us(), vehicle.sample())
            done += 1
