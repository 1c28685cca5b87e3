"""The simulated car: exact in time, the same for a seed, and plausible."""

from __future__ import annotations

import math
import operator
import threading
from pathlib import Path
from typing import Any

import pytest

from iort_agent.common.schema import Place, load
from iort_agent.errors import ConfigError, SourceError
from iort_agent.sources.sim import PoseConfig, Sensors, SimConfig, SimGraph
from iort_agent.sources.sim.driver import HALL, Circuit, Pose, wrapped
from iort_agent.sources.sim.vehicle import Vehicle, VehicleConfig
from iort_contract.catalog.streams import CATALOG, POSE_STREAM
from iort_contract.catalog.vesc import VESC_FIELDS, VESC_STREAM
from iort_contract.messages.commands import DRIVE_TYPE, DriveLimits
from testkit.agent import ManualClock
from tests.unit.agent.control.downlink_rig import Rig

NO_POSE = PoseConfig(rate_hz=0)
T0 = 1_700_000_000_000_000


def drive(stream: str = VESC_STREAM, **settings: Any) -> list[tuple[str, int, Any]]:
    out: list[tuple[str, int, Any]] = []
    source = SimConfig(**settings).build(ManualClock(now_us=T0))
    source.run(lambda *sample: out.append(sample), threading.Event())
    return [sample for sample in out if sample[0] == stream]


@pytest.mark.parametrize(("rate_hz", "duration_s", "count"), [(50, 60, 3000), (7, 3, 21), (1000, 2, 2000)])
def test_as_many_samples_as_asked_for_at_even_times(rate_hz: float, duration_s: float, count: int) -> None:
    samples = drive(rate_hz=rate_hz, duration_s=duration_s)
    assert len(samples) == count
    for i, (_, t_us, _) in enumerate(samples):
        assert abs(t_us - T0 - i * 1_000_000 / rate_hz) < 1000, "no drift"


def test_a_slow_reader_does_not_shift_later_samples() -> None:
    clock, times = ManualClock(now_us=T0), []

    def emit(stream: str, t_us: int, values: Any) -> None:
        times.append(t_us - T0)
        clock.advance(0.2 if len(times) == 10 else 0.001)

    SimConfig(duration_s=1, pose=NO_POSE).build(clock).run(emit, threading.Event())
    assert len(times) == 50
    assert abs(times[-1] - 980_000) < 1000


def test_stops_when_asked() -> None:
    stop, seen = threading.Event(), []

    def emit(stream: str, t_us: int, values: Any) -> None:
        seen.append(t_us)
        if len(seen) == 7:
            stop.set()

    SimConfig(pose=NO_POSE).build(ManualClock()).run(emit, stop)
    assert len(seen) == 7


def test_the_fields_are_those_of_the_ros_1_driver() -> None:
    expected = [name for name, field in VESC_FIELDS.items() if 1 in field.ros]
    for _, _, values in drive(duration_s=1):
        assert sorted(values) == sorted(expected)
        assert len(expected) == 13


def test_the_same_seed_drives_the_same_lap() -> None:
    for stream in (VESC_STREAM, POSE_STREAM):
        assert drive(stream, duration_s=20, seed=5) == drive(stream, duration_s=20, seed=5)
        assert drive(stream, duration_s=20, seed=5) != drive(stream, duration_s=20, seed=6)


def test_the_example_of_a_track_is_the_hall_and_a_car_may_drive_another(tmp_path: Path) -> None:
    example = Path(__file__).parents[4] / "docs" / "examples" / "hall.csv"
    assert example.read_text() == HALL.csv()
    big = tmp_path / "big.csv"
    big.write_text("0,0,2,2\n60,0,2,2\n60,40,2,2\n0,40,2,2\n")
    config = load(SimConfig, {"track": "big.csv", "duration_s": 60}, Place(tmp_path / "car.yaml"))
    xs: list[Any] = []
    config.build(ManualClock()).run(lambda *sample: xs.append(sample[2].get("x", 0)), threading.Event())
    assert 58 < max(xs) < 62
    big.write_text("0,0,2,2\n60,0\n")
    with pytest.raises(ConfigError, match=r"track: .*big.csv: line 2 must be the four numbers"):
        load(SimConfig, {"track": "big.csv"}, Place(tmp_path / "car.yaml"))


def test_poses_come_at_their_own_rate_with_the_times_of_samples() -> None:
    times = {t_us for _, t_us, _ in drive(duration_s=60)}
    poses = drive(POSE_STREAM, duration_s=60)
    assert len(poses) == 60 * 20
    assert {t_us for _, t_us, _ in poses} < times
    assert {tuple(values) for _, _, values in poses} == {tuple(f.name for f in CATALOG[POSE_STREAM].fields)}
    # The poses change nothing of the drive.
    assert drive(duration_s=20) == drive(duration_s=20, pose=NO_POSE)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_car_keeps_to_its_track_as_fast_as_its_motor_says(seed: int) -> None:
    circuit = Circuit(HALL)
    poses = [
        values for _, _, values in drive(POSE_STREAM, duration_s=120, seed=seed, pose=PoseConfig(rate_hz=50))
    ]
    place = 0
    for pose in poses:
        place = circuit.nearest(pose["x"], pose["y"], place)
        off_m = math.hypot(pose["x"] - circuit.x_m[place], pose["y"] - circuit.y_m[place])
        assert off_m < circuit.narrowest_m - 0.15, "half a car's width from the wall"
        assert abs(wrapped(pose["heading"] - circuit.heading_rad[place])) < 0.6
    driven_m = sum(math.hypot(b["x"] - a["x"], b["y"] - a["y"]) for a, b in zip(poses[::5], poses[5::5]))
    counts = drive(duration_s=120, seed=seed)[-1][2]["distance_traveled"]
    assert driven_m == pytest.approx(counts / 6 * 60 / VehicleConfig().speed_to_erpm_gain, rel=0.02)
    assert driven_m > 8 * circuit.length_m


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_figures_hang_together(seed: int) -> None:
    config = VehicleConfig()
    rows = [values for _, _, values in drive(duration_s=120, seed=seed)]

    def column(name: str) -> list[float]:
        return [row[name] for row in rows]

    speed_mps = [erpm / config.speed_to_erpm_gain for erpm in column("speed")]
    assert 5 < max(speed_mps) <= config.max_speed_mps * 1.05
    assert min(speed_mps[200:]) < 3, "corners are slower"
    assert min(column("current_motor")) < -5, "it brakes"
    assert min(column("current_input")) < 0, "and regenerates"
    assert -1 <= min(column("duty_cycle")) <= max(column("duty_cycle")) <= 1
    assert set(column("fault_code")) == {0}

    # Energy: what flowed at the terminals is what the counters say.
    wh = sum(map(operator.mul, column("voltage_input"), column("current_input"))) / 50 / 3600
    counted = (rows[-1]["energy_drawn"] - rows[-1]["energy_regen"]) * 1e-4
    assert counted == pytest.approx(wh, rel=0.02)
    ah = sum(column("current_input")) / 50 / 3600
    assert (rows[-1]["charge_drawn"] - rows[-1]["charge_regen"]) * 1e-4 == pytest.approx(ah, rel=0.02)
    for name in ("charge_drawn", "charge_regen", "energy_drawn", "energy_regen", "distance_traveled"):
        assert column(name) == sorted(column(name)), f"{name} only grows"
        assert all(float(value).is_integer() for value in column(name))

    # Distance: six counts an electrical revolution.
    counts = sum(column("speed")) / 60 * 6 / 50
    assert rows[-1]["distance_traveled"] == pytest.approx(counts, rel=0.01)

    # The voltage sags with the current drawn, and the duty cycle follows the speed.
    hard = [row["voltage_input"] for row in rows if row["current_input"] > 8]
    light = [row["voltage_input"] for row in rows if abs(row["current_input"]) < 1]
    assert sum(hard) / len(hard) < sum(light) / len(light) - 0.15
    for row in rows[::37]:
        volts = row["speed"] / config.pole_pairs / config.motor_kv
        volts += (
            math.sqrt(3) * row["current_motor"] * (config.motor_resistance_ohm + config.fet_resistance_ohm)
        )
        assert row["duty_cycle"] == pytest.approx(volts / row["voltage_input"], abs=0.02)
    assert 20 < column("temperature_pcb")[0] < column("temperature_pcb")[-1] < 80


def test_a_heavier_car_is_slower_and_thirstier() -> None:
    light = drive(duration_s=20)[-1][2]
    heavy = drive(duration_s=20, vehicle=VehicleConfig(mass_kg=8.0))[-1][2]
    after_a_second = [drive(duration_s=1, vehicle=VehicleConfig(mass_kg=m))[-1][2] for m in (3.7, 8.0)]
    assert after_a_second[1]["speed"] < after_a_second[0]["speed"] * 0.7
    assert heavy["energy_drawn"] / heavy["distance_traveled"] > (
        light["energy_drawn"] / light["distance_traveled"]
    )


@pytest.mark.parametrize(
    "vehicle", [VehicleConfig(battery_resistance_ohm=10.0), VehicleConfig(cells=1, mass_kg=5000.0)]
)
def test_an_impossible_car_still_gives_numbers(vehicle: VehicleConfig) -> None:
    for _, _, values in drive(duration_s=10, vehicle=vehicle):
        assert all(math.isfinite(value) for value in values.values())


CAR_LIMITS = DriveLimits("drive", "drive.speed", "drive.steering_angle", 2.0, 0.4, 500)


class Commanded:
    """A simulated car and its downlink, in steps of 20 ms."""

    def __init__(self) -> None:
        drive = {"topic": "/drive", "type": DRIVE_TYPE, "partial": True}
        motion = {"lease_s": 10, "stop": {}}
        clock = ManualClock(now_us=T0)
        self.graph = SimGraph(clock)
        cmd = {"drive": {**drive, "motion": motion}}
        self.rig = Rig(cmd=cmd, drive={}, graph=self.graph, clock=clock)
        self.vehicle = Vehicle(VehicleConfig(), 1)
        self.measured = Sensors(self.vehicle, 1)

    def drive(self, seconds: float) -> list[tuple[float, Pose]]:
        """The speed and pose of each step."""
        found = []
        for i in range(round(seconds * 50)):
            self.rig.clock.advance(0.02)
            if i % 5 == 0:
                self.rig.downlink.tick()
            self.vehicle.step(0.02, self.graph.wish())
            found.append((self.measured.vesc()["speed"] / 4614, self.vehicle.pose))
        return found


def test_a_command_drives_the_car_until_its_lease_ends_and_then_it_finds_its_lap_again() -> None:
    car = Commanded()
    car.drive(3)
    car.rig.send({"drive": {"speed": 1.0, "steering_angle": 0.3}}, name="drive", lease_ms=4000)
    driven = car.drive(4)
    assert driven[-1][0] == pytest.approx(1.0, abs=0.03)
    turned = sum(wrapped(b[1].heading_rad - a[1].heading_rad) for a, b in zip(driven, driven[1:]))
    assert turned > 3, "it turns to the left"
    stopped = car.drive(1)
    assert stopped[-1][0] == 0.0
    car.drive(30)
    place = Circuit(HALL).nearest(car.vehicle.pose.x_m, car.vehicle.pose.y_m)
    away_m = math.dist(car.vehicle.pose[:2], Circuit(HALL).beside(place, 0.0))
    assert away_m < 0.5
    assert car.drive(15)[-1][0] > 2


def test_a_command_reverses_stops_and_holds() -> None:
    car = Commanded()
    car.drive(1)
    car.rig.send({"drive": {"speed": -1.0}}, name="drive", lease_ms=5000)
    speeds = [speed for speed, _ in car.drive(3)]
    assert speeds[-1] == pytest.approx(-1.0, abs=0.03)
    sample = car.measured.vesc()
    assert sample["duty_cycle"] < 0
    assert sample["displacement"] < sample["distance_traveled"]
    car.rig.send({}, name="drive", lease_ms=5000)
    assert {speed for speed, _ in car.drive(5)[100:]} == {0.0}, "it stands for the whole lease"


def test_a_simulated_car_takes_drive_commands_only() -> None:
    with pytest.raises(SourceError, match="of the type ackermann_msgs/AckermannDriveStamped only"):
        SimGraph(ManualClock()).advertise("/cmd_vel", "geometry_msgs/Twist")
    with pytest.raises(SourceError, match="cannot share /pose"):
        SimGraph(ManualClock()).subscribe("/pose", print)
