"""The simulated car: exact in time, the same for a seed, and plausible."""

from __future__ import annotations

import math
import operator
import threading
from pathlib import Path
from typing import Any, Callable, Iterator

import pytest

from iort_agent.common.schema import Place, load
from iort_agent.errors import ConfigError, SourceError
from iort_agent.sources.sim import ALL, PoseConfig, Sensors, SimConfig, SimGraph
from iort_agent.sources.sim.driver import HALL, Circuit, Pose, Wish, wrapped
from iort_agent.sources.sim.faults import KINDS, STRENGTHS, FaultConfig
from iort_agent.sources.sim.vehicle import G_MPS2, IDLE_W, Battery, Heat, Vehicle, VehicleConfig, open_voltage
from iort_agent.sources.vesc_protocol import LAYOUTS
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


# The simulated car's physics, against closed forms.

DT = 0.02
CAR = VehicleConfig()


def steps(vehicle: Vehicle, seconds: float, wish: Wish | None = None) -> Iterator[Vehicle]:
    for _ in range(round(seconds / DT)):
        vehicle.step(DT, wish)
        yield vehicle


def test_the_battery_gives_what_the_drive_uses_and_the_losses_are_heat() -> None:
    vehicle = Vehicle(CAR, 1)
    joules = dict.fromkeys(("battery", "shaft", "windings", "board", "moving"), 0.0)
    for car in steps(vehicle, 60):
        rad_s = car.wheel_mps * CAR.speed_to_erpm_gain * 2 * math.pi / 60
        winding = car.motor_resistance_ohm - CAR.fet_resistance_ohm
        joules["battery"] += car.battery.voltage_v * car.battery.current_a * DT
        joules["shaft"] += 1.5 * rad_s * CAR.flux_linkage_wb * car.motor_a * DT
        joules["windings"] += 1.5 * winding * car.motor_a**2 * DT
        joules["board"] += (1.5 * CAR.fet_resistance_ohm * car.motor_a**2 + IDLE_W) * DT
    used = joules["shaft"] + joules["windings"] + joules["board"]
    assert joules["battery"] == pytest.approx(used, rel=1e-3)
    # What the shaft gave is in the car's motion, and in its losses, which only take.
    moving = 0.5 * (CAR.mass_kg + CAR.rotating_mass_kg) * vehicle.speed_mps**2
    least_n = CAR.rolling_resistance * CAR.mass_kg * G_MPS2 + CAR.drivetrain_friction_n
    driven_m = vehicle.counts / 6 * 60 / CAR.speed_to_erpm_gain
    assert moving + least_n * driven_m < joules["shaft"] < moving + 2.5 * least_n * driven_m


def test_at_an_even_speed_the_motor_pushes_against_friction_and_drag_alone() -> None:
    vehicle = Vehicle(CAR, 1)
    for _ in steps(vehicle, 20, Wish(3.0, 0.0)):
        pass
    against_n = CAR.rolling_resistance * CAR.mass_kg * G_MPS2 + CAR.drivetrain_friction_n
    against_n += 0.5 * 1.2 * CAR.drag_area_m2 * vehicle.speed_mps**2
    assert vehicle.speed_mps == pytest.approx(3.0, rel=0.01)
    assert vehicle.motor_a * CAR.newtons_per_amp * CAR.drivetrain_efficiency == pytest.approx(
        against_n, rel=1e-3
    )


def test_a_battery_under_an_even_load_sags_at_once_and_then_slowly_to_the_sum_of_its_resistances() -> None:
    config = VehicleConfig(capacity_ah=1000, charge=0.5)
    battery = Battery(config)
    battery.step(100.0, DT)
    at_once = (battery.open_v - battery.voltage_v) / battery.current_a
    assert at_once == pytest.approx(config.battery_resistance_ohm, rel=0.01)
    for _ in range(round(10 * config.battery_slow_s / DT)):
        battery.step(100.0, DT)
    in_the_end = (battery.open_v - battery.voltage_v) / battery.current_a
    both = config.battery_resistance_ohm + config.battery_slow_resistance_ohm
    assert in_the_end == pytest.approx(both, rel=0.01)
    assert battery.voltage_v * battery.current_a == pytest.approx(100.0)


def test_the_open_voltage_falls_with_the_charge() -> None:
    curve = [open_voltage(i / 100) for i in range(101)]
    assert curve == sorted(curve)
    assert (curve[0], curve[50], curve[100]) == pytest.approx((3.0, 3.73, 4.2), abs=0.01)


def test_motor_and_board_warm_up_to_the_temperature_at_which_they_lose_their_heat() -> None:
    config = VehicleConfig(motor_to_board_w_per_k=0.0)
    heat = Heat(config)
    for _ in range(40_000):
        heat.step(3.0, 2.0, 5.0, 0.5, 1.0)
    # At 5 m/s the cooling is twice as good, and half of it is left.
    assert heat.motor_degc - config.ambient_degc == pytest.approx(3.0 / config.motor_cooling_w_per_k)
    assert heat.board_degc - config.ambient_degc == pytest.approx(2.0 / config.board_cooling_w_per_k)
    assert heat.winding(0.01) == pytest.approx(0.01 * (1 + 0.0039 * (heat.motor_degc - 25)))


def test_wheels_spin_where_the_tyres_have_no_grip_and_hold_again() -> None:
    slippery = VehicleConfig(friction=0.3)
    vehicle = Vehicle(slippery, 1)
    ratios = [car.wheel_mps / car.speed_mps for car in steps(vehicle, 3, Wish(5.0, 0.0)) if car.speed_mps]
    assert max(ratios) > 1.5
    # The tyres cannot push harder than their grip, and on a dry floor they do not spin.
    assert vehicle.speed_mps <= slippery.friction * G_MPS2 * 3
    assert ratios[-1] == pytest.approx(1.0, abs=0.05)
    assert all(car.wheel_mps < car.speed_mps * 1.1 for car in steps(Vehicle(CAR, 1), 60))


def test_all_fields_are_those_of_the_serial_line_and_agree_with_the_motor() -> None:
    vehicle = Vehicle(CAR, 1)
    sensors = Sensors(vehicle, 1, ALL)
    rows: list[dict[str, Any]] = [sensors.vesc() for _ in steps(vehicle, 60)]
    newest = LAYOUTS[max(LAYOUTS)]
    assert sorted(rows[0]) == sorted(number.name for number in newest.numbers)
    for row in rows[100::37]:
        rad_s = row["speed"] * 2 * math.pi / 60
        ohm = CAR.motor_resistance_ohm * (1 + 0.0039 * (row["temp_motor"] - 25)) + CAR.fet_resistance_ohm
        assert row["avg_vq"] == pytest.approx(rad_s * CAR.flux_linkage_wb + ohm * row["avg_iq"], abs=0.06)
        watts = 1.5 * (row["avg_vq"] * row["avg_iq"] + row["avg_vd"] * row["avg_id"]) + IDLE_W
        assert row["voltage_input"] * row["current_input"] == pytest.approx(watts, abs=4 + 0.04 * abs(watts))
        assert math.sqrt(3) * math.hypot(row["avg_vd"], row["avg_vq"]) / row[
            "voltage_input"
        ] == pytest.approx(abs(row["duty_cycle"]), abs=0.012)


# The simulated car's faults: each changes what it should, by what it names, and nothing else.


def samples(*faults: FaultConfig, seconds: float = 60.0, seed: int = 1) -> list[dict[str, Any]]:
    vehicle = Vehicle(CAR, seed, faults=faults)
    sensors = Sensors(vehicle, seed)
    return [sensors.vesc() for _ in steps(vehicle, seconds)]


def drive_with(*faults: FaultConfig) -> dict[str, list[tuple[int, Any]]]:
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

    def force_n(car: Vehicle, radius: float = 1.0) -> float:
        drag_n = 0.5 * 1.2 * CAR.drag_area_m2 * car.speed_mps**2
        return car.motor_a * CAR.newtons_per_amp * CAR.drivetrain_efficiency / radius - drag_n

    healthy = cruise()
    assert force_n(cruise(FaultConfig("added_friction", 1.0))) - force_n(healthy) == pytest.approx(
        1.0, abs=0.01
    )
    heavy = cruise(FaultConfig("payload", 1.0))
    assert force_n(heavy) - force_n(healthy) == pytest.approx(CAR.rolling_resistance * G_MPS2, abs=0.01)
    flat = cruise(FaultConfig("flat_tyre", 0.1))
    assert flat.wheel_mps / flat.speed_mps == pytest.approx(1 / 0.9, rel=0.01)
    rolling_n = CAR.rolling_resistance * CAR.mass_kg * G_MPS2
    assert force_n(flat, 0.9) - force_n(healthy) == pytest.approx(20 * 0.1 * rolling_n, rel=0.01)
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
    with_fault, without = drive_with(fault), drive_with()
    assert with_fault["pose"] == without["pose"]
    lossy, healthy = with_fault["vesc"], without["vesc"]
    assert 1 - len(lossy) / len(healthy) == pytest.approx(0.08 * 240 / 300, abs=0.025)
    assert lossy[:3000] == healthy[:3000]
    gaps = [(b[0] - a[0]) / 1e6 for a, b in zip(lossy, lossy[1:]) if b[0] - a[0] > 30_000]
    assert 0.04 < min(gaps) < max(gaps) < 1.5


@pytest.mark.parametrize(
    ("fault", "error"),
    [
        ({"kind": "worn_batery"}, r"faults\[0\].kind: must be one of .*did you mean worn_battery\?"),
        ({}, r"faults\[0\].kind: required"),
        ({"kind": "payload", "strength": "huge"}, r"strength: must be weak, middle, .* or a number .*'huge'"),
        ({"kind": "payload", "strength": -1}, r"strength: must be weak"),
        ({"kind": "flat_tyre", "strength": 0.9}, r"strength: must be at most 0.5 for flat_tyre, got 0.9"),
        ({"kind": "payload", "field": "speed"}, r"only sensor_stuck and sensor_drift have a field, got"),
        ({"kind": "sensor_drift", "field": "speed"}, r"must be one of voltage_input, .* for sensor_drift"),
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
