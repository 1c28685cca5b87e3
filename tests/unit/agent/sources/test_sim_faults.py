"""The simulated car's faults: each changes what it should, by what it names, and nothing else."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any, Callable

import pytest

from iort_agent.common.schema import Place, load
from iort_agent.errors import ConfigError
from iort_agent.sources.sim import Sensors, SimConfig
from iort_agent.sources.sim.driver import Wish
from iort_agent.sources.sim.faults import KINDS, STRENGTHS, FaultConfig
from iort_agent.sources.sim.vehicle import G_MPS2, Vehicle
from testkit.agent import ManualClock
from tests.unit.agent.sources.test_sim_physics import CAR, steps


def samples(*faults: FaultConfig, seconds: float = 60.0, seed: int = 1) -> list[dict[str, Any]]:
    vehicle = Vehicle(CAR, seed, faults=faults)
    sensors = Sensors(vehicle, seed)
    return [sensors.vesc() for _ in steps(vehicle, seconds)]


def drive(*faults: FaultConfig) -> dict[str, list[tuple[int, Any]]]:
    out: dict[str, list[tuple[int, Any]]] = {"vesc": [], "pose": []}
    source = SimConfig(duration_s=300, faults=faults).build(ManualClock(now_us=0))
    source.run(lambda stream, t_us, values: out[stream].append((t_us, values)), threading.Event())
    return out


# What a fault changes at once, and what it leaves as it is: the value of a car that has driven with it.
SEEN: dict[str, Callable[[Vehicle], float]] = {
    "worn_battery": lambda car: (car.battery.open_v - car.battery.voltage_v) / car.battery.current_a,
    "added_friction": lambda car: -car.speed_mps,
    "flat_tyre": lambda car: car.wheel_mps / car.speed_mps,
    "dragging_brake": lambda car: car.damage.drag_n,
    "cell_dropout": lambda car: car.damage.lost_v,
    "cooling_lost": lambda car: car.heat.board_degc,
    "loose_pinion": lambda car: abs(car.wheel_mps - car.speed_mps),
    "motor_resistance": lambda car: car.motor_resistance_ohm,
    "payload": lambda car: car.mass_kg,
}


def mean(kind: str, faults: list[FaultConfig]) -> float:
    vehicle = Vehicle(CAR, 1, faults=faults)
    found = [
        SEEN[kind](car) for car in steps(vehicle, 60) if abs(car.speed_mps) > 1 and car.battery.current_a > 1
    ]
    return sum(found) / len(found)


@pytest.mark.parametrize("kind", SEEN)
def test_a_stronger_fault_changes_the_car_more(kind: str) -> None:
    found = [mean(kind, [])] + [mean(kind, [FaultConfig(kind, strength)]) for strength in STRENGTHS]
    assert found == sorted(found)
    assert found[0] < found[1], "a weak fault changes something"


def test_faults_have_the_physical_size_that_they_name() -> None:
    """Steady states of the faulty car, against the healthy one's."""

    def cruise(*faults: FaultConfig) -> Vehicle:
        vehicle = Vehicle(CAR, 1, faults=faults)
        for _ in steps(vehicle, 10, Wish(3.0, 0.0)):
            pass
        return vehicle

    def force_n(car: Vehicle) -> float:
        drag_n = 0.5 * 1.2 * CAR.drag_area_m2 * car.speed_mps**2
        return car.motor_a * CAR.newtons_per_amp * CAR.drivetrain_efficiency - drag_n

    healthy = cruise()
    assert force_n(cruise(FaultConfig("added_friction", 1.0))) - force_n(healthy) == pytest.approx(
        1.0, abs=0.01
    )
    heavy = cruise(FaultConfig("payload", 1.0))
    assert force_n(heavy) - force_n(healthy) == pytest.approx(CAR.rolling_resistance * G_MPS2, abs=0.01)
    flat = cruise(FaultConfig("flat_tyre", 0.1))
    assert flat.wheel_mps / flat.speed_mps == pytest.approx(1 / 0.9, rel=0.01)
    joint = cruise(FaultConfig("motor_resistance", 0.01))
    assert joint.motor_resistance_ohm - healthy.motor_resistance_ohm == pytest.approx(0.01, abs=2e-4)
    for kind in ("worn_battery", "cooling_lost", "motor_resistance", "cell_dropout"):
        assert cruise(FaultConfig(kind, "strong")).motor_a == pytest.approx(healthy.motor_a), kind


@pytest.mark.parametrize("field", ["voltage_input", "current_motor", "temperature_pcb"])
def test_a_faulty_sensor_changes_its_own_field_only(field: str) -> None:
    healthy = samples()
    stuck = samples(FaultConfig("sensor_stuck", 10.0, 20.0, field))
    drifting = samples(FaultConfig("sensor_drift", 100.0, 20.0, field))
    for rows in (stuck, drifting):
        assert [{**row, field: 0} for row in rows] == [{**row, field: 0} for row in healthy]
        assert [row[field] for row in rows[:1000]] == [row[field] for row in healthy[:1000]]
    assert len({row[field] for row in stuck[1001:1499]}) == 1
    assert stuck[1501:] == healthy[1501:]
    assert drifting[-1][field] - healthy[-1][field] == pytest.approx(100.0 * 40 / 600, abs=0.06)


def test_an_intermittent_can_loses_its_share_of_the_samples_in_gaps_and_no_poses() -> None:
    fault = FaultConfig("intermittent_can", 0.08, 60.0)
    with_fault, without = drive(fault), drive()
    assert with_fault["pose"] == without["pose"]
    lossy, healthy = with_fault["vesc"], without["vesc"]
    assert 1 - len(lossy) / len(healthy) == pytest.approx(0.08 * 240 / 300, abs=0.025)
    assert lossy[:3000] == healthy[:3000]
    gaps = [(b[0] - a[0]) / 1e6 for a, b in zip(lossy, lossy[1:]) if b[0] - a[0] > 30_000]
    assert 0.04 < min(gaps) < max(gaps) < 1.5


@pytest.mark.parametrize(
    ("fault", "error"),
    [
        (
            {"kind": "worn_batery"},
            r"faults\[0\].kind: must be one of worn_battery, .*did you mean worn_battery\?",
        ),
        ({}, r"faults\[0\].kind: required"),
        (
            {"kind": "payload", "strength": "huge"},
            r"strength: must be weak, middle, strong or a number .*'huge'",
        ),
        ({"kind": "payload", "strength": -1}, r"strength: must be weak"),
        ({"kind": "flat_tyre", "strength": 0.9}, r"strength: must be at most 0.5 for flat_tyre, got 0.9"),
        (
            {"kind": "payload", "field": "speed"},
            r"field: only sensor_stuck and sensor_drift have a field, got payload",
        ),
        (
            {"kind": "sensor_drift", "field": "speed"},
            r"field: must be one of voltage_input, .* for sensor_drift",
        ),
        ({"kind": "sensor_stuck", "field": "x"}, r"field: must be one of current_input"),
        ({"kind": "payload", "from_s": -1}, r"from_s: must be a number from 0"),
    ],
)
def test_a_wrong_fault_is_refused(fault: dict[str, Any], error: str) -> None:
    with pytest.raises(ConfigError, match=error):
        load(SimConfig, {"faults": [fault]}, Place(Path("car.yaml")))


def test_faults_are_set_by_name_or_by_number_and_are_in_the_description() -> None:
    faults = [{"kind": "payload"}, {"kind": "flat_tyre", "strength": 0.07, "from_s": 5}]
    config = load(SimConfig, {"faults": faults}, Place(Path("car.yaml")))
    assert [fault.value for fault in config.faults] == [KINDS["payload"].strengths[1], 0.07]
    assert config.describe() == "simulated car at 50 Hz with payload and flat_tyre"
