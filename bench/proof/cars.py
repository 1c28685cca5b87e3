"""The simulated fleet: cars that differ a little, and the drives of each, which differ too. All by seeds."""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from iort_agent.sources.sim import ALL, ROS1
from iort_agent.sources.sim.faults import KINDS, FaultConfig
from iort_agent.sources.sim.vehicle import VehicleConfig
from iort_contract.messages.analysis import DriveKey

DRIVE_S = 600.0
# The first drive begins on 2026-03-02 at 9:00 UTC, and a car drives once a day.
_FIRST_US, _DAY_US = 1_772_442_000_000_000, 86_400_000_000
# How much a car of the fleet may differ from the default, as a share either way.
_CARS = {
    "mass_kg": 0.03,
    "rotating_mass_kg": 0.1,
    "rolling_resistance": 0.15,
    "drivetrain_friction_n": 0.2,
    "drivetrain_efficiency": 0.01,
    "speed_to_erpm_gain": 0.015,
    "motor_kv": 0.03,
    "motor_resistance_ohm": 0.08,
    "fet_resistance_ohm": 0.1,
    "motor_cooling_w_per_k": 0.15,
    "board_heat_capacity_j_per_k": 0.05,
    "board_cooling_w_per_k": 0.1,
    "friction": 0.05,
    "capacity_ah": 0.04,
    "battery_resistance_ohm": 0.12,
    "battery_slow_resistance_ohm": 0.2,
    "battery_slow_s": 0.3,
}
# The same for cars of any lab. What an analysis knows by a prior only differs among them as much as the prior
# says: the tyres' part of the friction, and the battery's slow resistance. In a fleet that is more alike, the
# intervals hold more often.
ANY_CARS = {
    **_CARS,
    "rolling_resistance": 0.35,
    "drivetrain_friction_n": 0.35,
    "battery_slow_resistance_ohm": 0.6,
    "battery_slow_s": 0.5,
}
# How much a drive may differ from the car's others: floor and tyres, bearings, the battery's plug and its
# temperature, the air's way.
_DRIVES = {
    "rolling_resistance": 0.04,
    "drivetrain_friction_n": 0.05,
    "speed_to_erpm_gain": 0.002,
    "battery_resistance_ohm": 0.03,
    "battery_slow_resistance_ohm": 0.03,
    "board_cooling_w_per_k": 0.03,
    "motor_cooling_w_per_k": 0.03,
}
_PACES, _CHARGES, _AMBIENT_DEGC = (0.8, 1.0), (0.55, 1.0), (21.0, 27.0)
# A sensor sticks somewhere in the drive.
_STUCK_FROM_S = (60.0, 480.0)


@dataclass(frozen=True)
class DriveSpec:
    """Everything that a simulated drive depends on."""

    key: DriveKey
    vehicle: VehicleConfig
    seed: int
    pace: float
    fields: str
    seconds: float = DRIVE_S
    faults: tuple[FaultConfig, ...] = ()


def drive_of(
    car: int,
    number: int,
    faults: Sequence[FaultConfig] = (),
    *,
    day: int | None = None,
    seconds: float = DRIVE_S,
    cars: Mapping[str, float] = _CARS,
) -> DriveSpec:
    """A drive of a car of the fleet: the same for the same numbers, on the day of its number or on ``day``.

    Cars with even numbers have the fields of the ROS 1 driver, the others all that a VESC sends on its serial
    line.
    """
    chance = _chance("drive", car, number)
    vehicle = _varied(_varied(VehicleConfig(), cars, _chance("car", car)), _DRIVES, chance)
    vehicle = replace(vehicle, charge=chance.uniform(*_CHARGES), ambient_degc=chance.uniform(*_AMBIENT_DEGC))
    start_us = _FIRST_US + (number if day is None else day) * _DAY_US + chance.randrange(3_600_000_000)
    return DriveSpec(
        key=DriveKey(f"car{car}", start_us, f"{chance.randrange(1 << 32):08x}"),
        vehicle=vehicle,
        seed=chance.randrange(1 << 31),
        pace=chance.uniform(*_PACES),
        fields=ALL if car % 2 else ROS1,
        seconds=seconds,
        faults=tuple(faults),
    )


def fault_of(car: int, kind: str, strength: str) -> FaultConfig:
    """A fault as a car has it: from the beginning of the drive, but a stuck sensor at any time. The cars take
    the fields that a sensor's fault may have in turns."""
    chance = _chance("fault", car, kind)
    fields = list(KINDS[kind].by_field) or ["voltage_input"]
    from_s = chance.uniform(*_STUCK_FROM_S) if kind == "sensor_stuck" else 0.0
    return FaultConfig(kind, strength, from_s, fields[car % len(fields)])


def _chance(*seed: Any) -> random.Random:
    return random.Random(":".join(map(str, seed)))  # noqa: S311 - the fleet must be the same each time


def _varied(config: VehicleConfig, shares: Mapping[str, float], chance: random.Random) -> VehicleConfig:
    changes: dict[str, Any] = {
        name: getattr(config, name) * chance.uniform(1 - share, 1 + share) for name, share in shares.items()
    }
    return replace(config, **changes)
