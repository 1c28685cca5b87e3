"""Simulated drives as arrays, much faster than real time, beside the truth; kept under build/.

streams, truth = simulated(drive_of(car=3, number=0))
"""

from __future__ import annotations

import hashlib
import json
import random
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import iort_agent.sources.sim
from bench.proof.cars import DriveSpec
from iort_agent.sources.sim import Sensors
from iort_agent.sources.sim.driver import Wish
from iort_agent.sources.sim.vehicle import Vehicle
from iort_analysis.samples.blocks import Block
from iort_contract.catalog.streams import POSE_STREAM
from iort_contract.catalog.vesc import TACHOMETER_COUNTS, VESC_STREAM
from testkit import ROOT

KEPT = ROOT / "build" / "bench-analysis" / "drives"
RATE_HZ, POSE_RATE_HZ = 50, 20
# A car stands before and after a drive, as its battery rests.
_STANDS_S = 5.0
_STANDING = Wish(0.0, 0.0)
# The time between a measurement and its stamp differs by so much, as on a busy computer.
_JITTER_US = 300.0
# The sensors' resolutions are decimal, so that the columns are kept as integers.
_SCALES = (1, 10, 100, 1000)


class Simulated(NamedTuple):
    """A drive: its streams, and the truth about the car and the drive by name, with units."""

    streams: dict[str, Block]
    truth: dict[str, float]


def simulated(spec: DriveSpec, kept: Path | None = KEPT) -> Simulated:
    """Simulate a drive, or take it from the folder ``kept``."""
    if kept is None:
        return _simulate(spec)
    path = kept / f"{digest(spec)}.npz"
    if not path.exists():
        made = _simulate(spec)
        kept.mkdir(parents=True, exist_ok=True)
        partial = path.with_suffix(f".{random.getrandbits(64):x}.npz")
        np.savez(partial, **_packed(made))
        partial.replace(path)
        return made
    with np.load(path) as arrays:
        return _unpacked(dict(arrays))


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
    """The version of what makes a drive: its code."""
    (folder,) = iort_agent.sources.sim.__path__
    code = [*sorted(Path(folder).glob("*.py")), Path(__file__)]
    return hashlib.sha256(b"".join(path.read_bytes() for path in code)).hexdigest()


def digest(spec: DriveSpec) -> str:
    """A name for a drive as this simulator makes it."""
    return hashlib.sha256(f"{_simulator()} {spec!r}".encode()).hexdigest()[:32]


def _packed(made: Simulated) -> dict[str, Any]:
    """The arrays of a drive, in a quarter of the bytes."""
    arrays: dict[str, Any] = {"truth": np.array(json.dumps(made.truth))}
    for stream, block in made.streams.items():
        arrays[f"{stream}/times"] = block.times_us
        for name, column in block.columns.items():
            scale = next((s for s in _SCALES if bool((np.round(column * s) / s == column).all())), None)
            small = column if scale is None else np.round(column * scale).astype(np.int32)
            if scale is not None and abs(small).max(initial=0) < 2**15:
                small = small.astype(np.int16)
            arrays[f"{stream}/{name}/{scale or ''}"] = small
    return arrays


def _unpacked(arrays: Mapping[str, Any]) -> Simulated:
    truth = json.loads(str(arrays["truth"]))
    times = {name.split("/")[0]: column for name, column in arrays.items() if name.endswith("/times")}
    columns: dict[str, dict[str, Any]] = {stream: {} for stream in times}
    for key, column in arrays.items():
        stream, _, rest = key.partition("/")
        name, _, scale = rest.partition("/")
        if stream in columns and rest != "times":
            columns[stream][name] = column / float(scale) if scale else column
    return Simulated({stream: Block(times[stream], columns[stream]) for stream in times}, truth)
