"""What is driven for the proof: by healthy cars, by cars with faults, and for the intervals."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from bench.proof.cars import ANY_CARS, DRIVE_S, DriveSpec, drive_of, fault_of
from iort_agent.sources.sim.faults import KINDS, STRENGTHS

# Numbers of drives and cars, apart from those of the healthy drives.
_FAULTY_FROM, _COVERED_FROM = 1000, 1000


@dataclass(frozen=True)
class Plan:
    """How many cars, the drives of each: first those of the baseline, then further healthy ones; and how many
    cars with one drive each for the intervals."""

    cars: int
    baseline: int
    healthy: int
    covered: int
    seconds: float = DRIVE_S

    def baselines(self, car: int) -> list[DriveSpec]:
        """The drives that a car is compared with."""
        return [drive_of(car, number, seconds=self.seconds) for number in range(self.baseline)]

    def healthy_drives(self, car: int) -> list[DriveSpec]:
        """The drives after them, with nothing to be found."""
        numbers = range(self.baseline, self.baseline + self.healthy)
        return [drive_of(car, number, seconds=self.seconds) for number in numbers]

    def faulty_drives(self, car: int) -> dict[tuple[str, str], DriveSpec]:
        """The drive after those of the baseline with each fault, by its kind and strength."""
        cases = [(kind, strength) for kind in KINDS for strength in STRENGTHS]
        return {
            case: drive_of(
                car, _FAULTY_FROM + i, [fault_of(car, *case)], day=self.baseline, seconds=self.seconds
            )
            for i, case in enumerate(cases)
        }

    def covered_drives(self) -> list[DriveSpec]:
        """A drive of each of the cars whose truth is held against the intervals."""
        cars = range(_COVERED_FROM, _COVERED_FROM + self.covered)
        return [drive_of(car, 0, seconds=self.seconds, cars=ANY_CARS) for car in cars]

    def all_drives(self) -> Iterator[DriveSpec]:
        for car in range(self.cars):
            yield from self.baselines(car)
            yield from self.healthy_drives(car)
            yield from self.faulty_drives(car).values()
        yield from self.covered_drives()

    @property
    def healthy_hours(self) -> float:
        """The driving hours of the healthy drives after the baselines."""
        return self.cars * self.healthy * self.seconds / 3600


FULL = Plan(cars=20, baseline=8, healthy=8, covered=270)
QUICK = Plan(cars=4, baseline=6, healthy=3, covered=16)
