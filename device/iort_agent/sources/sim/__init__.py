"""A simulated car: its track, its driver, its physics, and its ROS graph for commands."""

from __future__ import annotations

import math
import random
import threading
from dataclasses import dataclass
from typing import Any, Sequence

from iort_agent.common.schema import FILE, Place, Rule, choice, items, number, section, setting, text
from iort_agent.common.threads import Clock, Pace
from iort_agent.errors import SourceError
from iort_agent.ros import Graph, OnBytes
from iort_agent.ros.json_message import decode
from iort_agent.ros.ros1_types import OnTrigger
from iort_agent.sources import Emit, Source, SourceConfig
from iort_agent.sources.sim.driver import HALL, Circuit, Pose, Wish, wrapped
from iort_agent.sources.sim.faults import FaultConfig, fault_rule
from iort_agent.sources.sim.vehicle import Vehicle, VehicleConfig
from iort_contract.catalog.streams import POSE_STREAM
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.limits import ContractError, Value
from iort_contract.messages.commands import DRIVE_TYPE, MAX_LEASE_MS, ROS2_DRIVE_TYPE
from iort_contract.ros.definition import RULE, Definition, parse
from iort_contract.topics import check_stream
from iort_contract.track import Track, parse_track

ROS1, ALL = "ros1", "all"
FIELDS: Rule = choice(ROS1, ALL)
# The noise of a position from a laser scanner on a map.
_NOISE_M, _NOISE_RAD = 0.01, 0.005
# A thermistor's noise, and that of the VESC's currents and voltages, before they are rounded.
_NOISE_K, _MOTOR_A, _BATTERY_A, _BATTERY_V, _MOTOR_V, _ERPM = 0.04, 0.08, 0.04, 0.02, 0.01, 12.0


class Sensors:
    """Samples of a car, with the ROS 1 driver's ``fields`` or all that a VESC sends on its serial line."""

    def __init__(self, vehicle: Vehicle, seed: int, fields: str = ROS1) -> None:
        self._vehicle, self._all = vehicle, fields == ALL
        # Apart, so that neither depends on how often the other is measured.
        self._chance, self._pose_chance, self._more = (random.Random(seed + i) for i in (1, 2, 4))  # noqa: S311 - noise

    def pose(self) -> dict[str, Value]:
        """The pose as a localisation on a map gives it, to the millimetre."""
        x_m, y_m, heading_rad = self._vehicle.pose
        noise = self._pose_chance.gauss
        return {
            "x": round(x_m + noise(0, _NOISE_M), 3),
            "y": round(y_m + noise(0, _NOISE_M), 3),
            "heading": round(wrapped(heading_rad + noise(0, _NOISE_RAD)), 3),
        }

    def vesc(self) -> dict[str, Value]:
        """The state of the VESC: the 13 fields of the ROS 1 driver's VescState, or those of firmware 6."""
        car, noise = self._vehicle, self._chance.gauss
        battery, rpm = car.battery, car.wheel_mps * car.config.speed_to_erpm_gain
        duty = math.copysign(math.sqrt(3) * math.hypot(car.vd_v, car.vq_v), car.vq_v) / battery.voltage_v
        sample: dict[str, Value] = {
            "voltage_input": round(battery.voltage_v + noise(0, _BATTERY_V), 1),
            "temperature_pcb": round(car.heat.board_degc + noise(0, _NOISE_K), 1),
            "current_motor": round(car.motor_a + noise(0, _MOTOR_A), 2),
            "current_input": round(battery.current_a + noise(0, _BATTERY_A), 2),
            "speed": float(round(rpm + (noise(0, _ERPM) if rpm else 0))),
            "duty_cycle": round(max(-0.95, min(0.95, duty)), 3),
            "charge_drawn": float(int(battery.drawn_ah * 1e4)),
            "charge_regen": float(int(battery.regen_ah * 1e4)),
            "energy_drawn": float(int(battery.drawn_wh * 1e4)),
            "energy_regen": float(int(battery.regen_wh * 1e4)),
            "displacement": float(int(car.counts)),
            "distance_traveled": float(int(car.counts_abs)),
            "fault_code": 0,
        }
        car.damage.measure(sample)
        return self._as_on_the_line(sample) if self._all else sample

    def _as_on_the_line(self, sample: dict[str, Value]) -> dict[str, Value]:
        """The sample with the motor's fields, too; the board's temperature is that of the MOSFETs."""
        car, noise = self._vehicle, self._more.gauss
        fet_degc = sample.pop("temperature_pcb")
        return {
            "temp_fet": fet_degc,
            "temp_motor": round(car.heat.motor_degc + noise(0, _NOISE_K), 1),
            **sample,
            "avg_id": round(noise(0, _MOTOR_A), 2),
            "avg_iq": sample["current_motor"],
            "pid_pos_now": 0.0,
            "controller_id": 0,
            "ntc_temp_mos1": fet_degc,
            "ntc_temp_mos2": fet_degc,
            "ntc_temp_mos3": fet_degc,
            "avg_vd": round(car.vd_v + noise(0, _MOTOR_V), 3),
            "avg_vq": round(car.vq_v + noise(0, _MOTOR_V), 3),
            "status": 0,
        }


_STAMPS = {DRIVE_TYPE: "uint32 seq\ntime stamp", ROS2_DRIVE_TYPE: "builtin_interfaces/Time stamp"}
_DRIVES = {
    kind: parse(
        kind,
        f"""std_msgs/Header header
AckermannDrive drive
{RULE}
MSG: std_msgs/Header
{stamp}
string frame_id
{RULE}
MSG: ackermann_msgs/AckermannDrive
float32 steering_angle
float32 steering_angle_velocity
float32 speed
float32 acceleration
float32 jerk
""",
    )
    for kind, stamp in _STAMPS.items()
}
# A command without a lease has no end of its own.
_LONGEST_S = MAX_LEASE_MS / 1000


class SimGraph(Graph):
    """Keeps the newest drive command, of any topic, until that topic is released. Its type may have the form
    of either ROS. Safe to use from several threads."""

    ros = 1

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._types: dict[str, Definition] = {}
        self._wish: Wish | None = None
        self._topic = ""
        self._until = 0.0

    def wish(self) -> Wish | None:
        """What the command in force wants; None if the car's own driver drives."""
        with self._lock:
            return self._wish if self._clock.monotonic() < self._until else None

    def definition(self, kind: str) -> Definition:
        if kind not in _DRIVES:
            raise SourceError(f"a simulated car takes commands of the type {DRIVE_TYPE} only, got {kind}")
        return _DRIVES[kind]

    def advertise(self, topic: str, kind: str) -> None:
        self._types[topic] = self.definition(kind)

    def publish(self, topic: str, data: bytes) -> bool:
        drive = decode(self._types[topic], data)["drive"]
        self.drive(topic, Wish(drive["speed"], drive["steering_angle"]))
        return True

    def drive(self, topic: str, wish: Wish) -> None:
        """Take a command."""
        with self._lock:
            self._wish, self._topic = wish, topic
            self._until = self._clock.monotonic() + _LONGEST_S

    def release(self, topic: str) -> None:
        with self._lock:
            if topic == self._topic:
                self._wish = None

    def subscribe(self, topic: str, handler: OnBytes) -> None:  # noqa: ARG002 - as the graph has it
        raise SourceError(f"a simulated car publishes no ROS topics, so it cannot share {topic}")

    def unsubscribe(self, topic: str, handler: OnBytes) -> None:
        pass

    def offer(self, service: str, handler: OnTrigger) -> None:  # noqa: ARG002 - as the graph has it
        raise SourceError(f"a simulated car has no ROS nodes, so nobody could call {service}")

    def waits(self) -> str | None:
        return None

    def start(self) -> None:
        pass

    def close(self) -> None:
        pass


_MAX_STEP_S = 0.02
_MAX_TRACK_BYTES = 4_000_000


@dataclass(frozen=True)
class PoseConfig:
    """The stream of the car's poses, as a localisation gives them; 0 Hz for none."""

    stream: str = setting(text(check_stream), POSE_STREAM)
    rate_hz: float = setting(number(0, 100, unit="Hz"), 20.0)


def _track(value: Any, place: Place) -> Track:
    path = FILE(value, place)
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
        return [self.stream, self.pose.stream] if self.pose.rate_hz else [self.stream]

    def describe(self) -> str:
        wrong = " and ".join(fault.kind for fault in self.faults)
        return f"simulated car at {self.rate_hz:g} Hz" + (f" with {wrong}" if wrong else "")

    def build(self, clock: Clock) -> SimSource:
        return SimSource(self, clock)


class SimSource(Source):
    """Emits exactly ``rate_hz * duration_s`` samples, each at its absolute deadline, less those that an
    intermittent CAN loses. The car obeys the commands that ``graph`` takes."""

    def __init__(self, config: SimConfig, clock: Clock) -> None:
        self.config = config
        self._clock = clock
        self.graph = SimGraph(clock)
        # Where the car is, for any thread; None before it drives.
        self.pose: Pose | None = None

    def run(self, emit: Emit, stop: threading.Event) -> None:
        """Drive until the duration is over or ``stop`` is set."""
        config = self.config
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
            self.pose = vehicle.pose
            now_us = self._clock.now_us()
            if not vehicle.damage.silent:
                emit(config.stream, now_us, measured.vesc())
            # With the first sample at or after its time, so that both have the same time.
            due = math.floor(done * config.pose.rate_hz / config.rate_hz) + 1
            if config.pose.rate_hz and due > poses:
                emit(config.pose.stream, now_us, measured.pose())
                poses = due
            done += 1
