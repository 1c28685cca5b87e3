"""The simulated fleet: cars that differ a little, and the drives of each, which differ too. All by seeds."""

from __future__ import annotations

import hashlib
import pickle
import random
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

import iort_agent.sources.sim
from iort_agent.sources.sim import ALL, ROS1, Sensors
from iort_agent.sources.sim.driver import Wish
from iort_agent.sources.sim.faults import KINDS, STRENGTHS, FaultConfig
from iort_agent.sources.sim.vehicle import Vehicle, VehicleConfig
from iort_analysis.samples.blocks import Block, values
from iort_contract.catalog.streams import POSE_STREAM
from iort_contract.catalog.vesc import TACHOMETER_COUNTS, VESC_STREAM
from iort_contract.dynamodb import Item
from iort_contract.messages.analysis import DriveKey
from iort_contract.messages.batch import Batch
from testkit import ROOT
from testkit.dynamodb import item_of

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


KEPT = ROOT / "build" / "bench-analysis" / "drives"
RATE_HZ, POSE_RATE_HZ = 50, 20
# A car stands before and after a drive, as its battery rests.
_STANDS_S = 5.0
_STANDING = Wish(0.0, 0.0)
# The time between a measurement and its stamp differs by so much, as on a busy computer.
_JITTER_US = 300.0
T = TypeVar("T")


class Simulated(NamedTuple):
    """A drive: its streams, and the truth about the car and the drive by name, with units."""

    streams: dict[str, Block]
    truth: dict[str, float]


def cached(path: Path, make: Callable[[], T]) -> T:
    """What an earlier run kept under the path, or what ``make`` makes, which is kept."""
    if path.exists():
        found: T = pickle.loads(zlib.decompress(path.read_bytes()))  # noqa: S301 - this function's own file
        return found
    made = make()
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(f".{random.getrandbits(64):x}")
    partial.write_bytes(zlib.compress(pickle.dumps(made), 1))
    partial.replace(path)
    return made


def version(*paths: str | Path) -> str:
    """The version of what makes something: its code, in folders and files."""
    files = [
        file
        for path in map(Path, paths)
        for file in (sorted(path.rglob("*.py")) if path.is_dir() else [path])
    ]
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:16]


def simulated(spec: DriveSpec, kept: Path | None = KEPT) -> Simulated:
    """Simulate a drive, or take it from the folder ``kept``."""
    return cached(kept / digest(spec), lambda: _simulate(spec)) if kept else _simulate(spec)


def _simulate(spec: DriveSpec) -> Simulated:
    vehicle = Vehicle(spec.vehicle, spec.seed, faults=spec.faults, pace=spec.pace)
    sensors = Sensors(vehicle, spec.seed, spec.fields)
    jitter = random.Random(spec.seed + 5)  # noqa: S311 - the same for a seed, no secret
    count, dt = round(spec.seconds * RATE_HZ), 1 / RATE_HZ
    stands = round(_STANDS_S * RATE_HZ)
    rows: dict[str, list[tuple[Any, ...]]] = {VESC_STREAM: [], POSE_STREAM: []}
    times: dict[str, list[int]] = {VESC_STREAM: [], POSE_STREAM: []}
    names: dict[str, tuple[str, ...]] = {}
    heated = resistance = distance_m = slid_s = 0.0
    battery = vehicle.battery
    full_v = battery.open_v
    for i in range(count):
        vehicle.step(dt, None if stands <= i < count - stands else _STANDING)
        now_us = spec.key.start_us + i * 1_000_000 // RATE_HZ + round(abs(jitter.gauss(0, _JITTER_US)))
        samples = {} if vehicle.damage.silent else {VESC_STREAM: sensors.vesc()}
        if i * POSE_RATE_HZ % RATE_HZ < POSE_RATE_HZ:
            samples[POSE_STREAM] = sensors.pose()
        for stream, sample in samples.items():
            names.setdefault(stream, tuple(sample))
            rows[stream].append(tuple(sample.values()))
            times[stream].append(now_us)
        heat = vehicle.motor_a**2
        heated += heat
        resistance += heat * vehicle.motor_resistance_ohm
        distance_m += abs(vehicle.speed_mps) * dt
        slid_s += vehicle.slips * dt
    streams = {
        stream: Block(
            np.array(times[stream], dtype=np.int64),
            dict(zip(names[stream], np.array(rows[stream], dtype=np.float64).T.copy(), strict=True)),
        )
        for stream in names
    }
    seen = {
        # Weighted by the heat that it makes, as a fit over the drive does.
        "motor_resistance_now_ohm": resistance / heated,
        "motor_a2_mean": heated / count,
        "distance_m": distance_m,
        # With the tyres' creep, as distances give it.
        "driven_erpm_per_mps": vehicle.counts_abs * 60 / TACHOMETER_COUNTS / distance_m,
        "slid_s": slid_s,
        "charge_left": battery.charge,
        "open_voltage_v": battery.open_v,
        "voltage_per_ah": (full_v - battery.open_v) / (battery.drawn_ah - battery.regen_ah),
        "motor_degc": vehicle.heat.motor_degc,
        "board_degc": vehicle.heat.board_degc,
    }
    return Simulated(streams, {**_parameters(spec, vehicle), **seen})


def _parameters(spec: DriveSpec, vehicle: Vehicle) -> dict[str, float]:
    """The parameters of the car in this drive, with its faults in force."""
    car, damage = vars(spec.vehicle), vehicle.damage
    truth = {name: float(value) for name, value in car.items()}
    truth["flux_linkage_wb"] = spec.vehicle.flux_linkage_wb
    truth["newtons_per_amp"] = spec.vehicle.newtons_per_amp / damage.radius
    truth["battery_resistance_ohm"] *= damage.battery_resistance
    truth["battery_slow_resistance_ohm"] *= damage.battery_resistance
    truth["capacity_ah"] *= damage.capacity
    truth["mass_kg"] = vehicle.mass_kg
    truth["speed_to_erpm_gain"] /= damage.radius
    truth["rolling_resistance"] *= damage.rolling
    truth["drivetrain_friction_n"] += damage.friction_n
    truth["motor_resistance_ohm"] += damage.motor_resistance_ohm
    truth["motor_cooling_w_per_k"] *= damage.cooling
    truth["board_cooling_w_per_k"] *= damage.cooling
    return truth


@cache
def _simulator() -> str:
    return version(*iort_agent.sources.sim.__path__, __file__)


def digest(spec: DriveSpec) -> str:
    """A name for a drive as this simulator makes it."""
    return hashlib.sha256(f"{_simulator()} {spec!r}".encode()).hexdigest()[:32]


_S = 1_000_000


def stored(spec: DriveSpec) -> dict[str, list[Item]]:
    """The stored batches of a drive by stream."""
    return {
        stream: [
            item_of(
                Batch(
                    spec.key.run,
                    seq,
                    part.times_us.tolist(),
                    {name: values(column) for name, column in part.columns.items()},
                )
            )
            for seq, part in enumerate(_by_second(block))
        ]
        for stream, block in simulated(spec).streams.items()
    }


def _by_second(block: Block) -> list[Block]:
    seconds = (block.times_us - block.times_us[0]) // _S
    edges = np.searchsorted(seconds, np.arange(int(seconds[-1]) + 2)).tolist()
    return [block.take(slice(a, b)) for a, b in pairwise(edges) if a < b]
