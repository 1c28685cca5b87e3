"""The faults that a simulated car may have, each with three strengths, and what they change of the car from
moment to moment."""

from __future__ import annotations

import math
import operator
import random
from dataclasses import dataclass
from typing import Any, Callable, Mapping, MutableMapping, NamedTuple, Sequence, Tuple

from iort_agent.common.schema import Place, choice, number, section, setting
from iort_contract.limits import Value

_MIDDLE = "middle"
STRENGTHS = ("weak", _MIDDLE, "strong")
_Three = Tuple[float, float, float]
_STUCK_S: _Three = (3.0, 15.0, 60.0)


class Kind(NamedTuple):
    """A kind of fault: what it does, its strengths with their unit, and the largest one.

    A sensor's fault has the strengths of each field that may have it.
    """

    meaning: str
    unit: str
    strengths: _Three
    most: float
    by_field: Mapping[str, _Three] = {}


KINDS: Mapping[str, Kind] = {
    "worn_battery": Kind(
        "the battery's resistances grow by this share, and its capacity shrinks by a fifth of it",
        "1",
        (0.2, 0.5, 1.0),
        5.0,
    ),
    "added_friction": Kind(
        "more friction in the drivetrain, such as from a dry bearing", "N", (0.5, 1.0, 2.0), 1e4
    ),
    "flat_tyre": Kind(
        "the tyres' radius shrinks by this share, and the rolling resistance grows by twenty times the share",
        "1",
        (0.02, 0.05, 0.1),
        0.5,
    ),
    "dragging_brake": Kind(
        "after braking a brake still drags with this force, which falls to a third in four seconds",
        "N",
        (1.0, 2.5, 5.0),
        1e4,
    ),
    "sensor_stuck": Kind(
        "a field keeps its value for so long",
        "s",
        _STUCK_S,
        1e9,
        {
            "voltage_input": _STUCK_S,
            "current_motor": _STUCK_S,
            "current_input": _STUCK_S,
            "speed": _STUCK_S,
            "temperature_pcb": _STUCK_S,
        },
    ),
    "sensor_drift": Kind(
        "a field's error grows by this in ten minutes",
        "V, A or K",
        (0.1, 0.3, 0.8),
        1e4,
        {
            "voltage_input": (0.1, 0.3, 0.8),
            "current_motor": (0.5, 1.5, 4.0),
            "temperature_pcb": (2.0, 5.0, 12.0),
        },
    ),
    "cell_dropout": Kind(
        "under load a cell loses this voltage for half a second to three, every ten seconds on average",
        "V",
        (0.3, 0.8, 2.0),
        1e3,
    ),
    "cooling_lost": Kind("motor and board lose this share of their cooling", "1", (0.3, 0.55, 0.8), 0.99),
    "loose_pinion": Kind(
        "the pinion slips on the motor's shaft above this force, measured at the tyres",
        "N",
        (16.0, 12.0, 8.0),
        1e5,
    ),
    "motor_resistance": Kind(
        "more resistance in the motor's phases, such as from a bad joint", "ohm", (0.003, 0.006, 0.012), 10.0
    ),
    "payload": Kind("more mass on the car", "kg", (0.4, 0.9, 1.8), 1e4),
    "intermittent_can": Kind(
        "this share of the samples is lost, in gaps of 0.1 s to 0.5 s", "1", (0.005, 0.02, 0.08), 0.9
    ),
}
_SENSORS = [name for name, kind in KINDS.items() if kind.by_field]
_FIELDS = sorted({field for name in _SENSORS for field in KINDS[name].by_field})


def _strength(value: Any, place: Place) -> str | float:
    if isinstance(value, str) and value in STRENGTHS:
        return value
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < math.inf:
        raise place.error(value, f"{', '.join(STRENGTHS)} or a number above 0 in the fault's unit")
    return float(value)


@dataclass(frozen=True)
class FaultConfig:
    """A fault of the car, from ``from_s`` on. ``strength`` is a name, or a number in the fault's unit.

    ``field`` says which one is wrong, for ``sensor_stuck`` and ``sensor_drift``.
    """

    kind: str = setting(choice(*KINDS))
    strength: str | float = setting(_strength, _MIDDLE)
    from_s: float = setting(number(0, 1e9, unit="s"), 0.0)
    field: str = setting(choice(*_FIELDS), "voltage_input")

    @property
    def value(self) -> float:
        """The strength in the fault's unit."""
        if not isinstance(self.strength, str):
            return self.strength
        kind = KINDS[self.kind]
        return kind.by_field.get(self.field, kind.strengths)[STRENGTHS.index(self.strength)]


def fault_rule(value: Any, place: Place) -> FaultConfig:
    """A fault whose strength and field its kind allows."""
    fault: FaultConfig = section(FaultConfig)(value, place)
    kind = KINDS[fault.kind]
    if kind.by_field and fault.field not in kind.by_field:
        raise place.child("field").error(fault.field, f"one of {', '.join(kind.by_field)} for {fault.kind}")
    if not kind.by_field and "field" in value:
        raise place.child("field").problem(f"only {' and '.join(_SENSORS)} have a field, got {fault.kind}")
    if fault.value > kind.most:
        unit = "" if kind.unit == "1" else f" {kind.unit}"
        raise place.child("strength").error(fault.value, f"at most {kind.most:g}{unit} for {fault.kind}")
    return fault


# A dragging brake's force falls to 1/e in this time; it grips when the motor brakes with more than this.
_BRAKE_S, _BRAKE_FROM_A = 4.0, 2.0
# A cell drops out only under load.
_CELL_FROM_A = 3.0
_CELL_EVERY_S, _CELL_S = 10.0, (0.5, 3.0)
_CAN_GAP_S = (0.1, 0.5)
_DRIFT_S = 600.0
# A drifting value keeps the resolution of its sensor.
_DECIMALS = {"voltage_input": 1, "current_motor": 2, "temperature_pcb": 1}


class Damage:
    """The car's faults: `begin` those that are due, `step` those that come and go.

    The attributes without an underscore are what the faults change; a healthy car has their first values.
    """

    def __init__(self, faults: Sequence[FaultConfig], chance: random.Random) -> None:
        self._waiting = sorted(faults, key=lambda fault: fault.from_s)
        self._chance = chance
        self._now_s = 0.0
        self.battery_resistance = self.capacity = self.radius = self.rolling = self.cooling = 1.0
        self.friction_n = self.payload_kg = self.motor_resistance_ohm = 0.0
        self.pinion_holds_n = math.inf
        self.lost_v = 0.0
        self.drag_n = 0.0
        self.silent = False
        self._brake_n = self._cell_v = self._can_share = 0.0
        self._cell_until_s = self._can_until_s = 0.0
        self._sensors: list[FaultConfig] = []
        self._kept: dict[str, Value] = {}

    def begin(self) -> bool:
        """Put the faults into force that are due; whether there was one."""
        began = False
        while self._waiting and self._waiting[0].from_s <= self._now_s:
            self._apply(self._waiting.pop(0))
            began = True
        return began

    def step(self, dt: float, motor_a: float, speed_mps: float, battery_a: float) -> None:
        """Advance by ``dt`` seconds with the motor's current, the car's speed and the battery's current."""
        self._now_s = now = self._now_s + dt
        if self._brake_n:
            brakes = motor_a * speed_mps < 0 and abs(motor_a) > _BRAKE_FROM_A
            self.drag_n = self._brake_n if brakes else self.drag_n * math.exp(-dt / _BRAKE_S)
        if self._cell_v:
            if battery_a > _CELL_FROM_A and self._chance.random() < dt / _CELL_EVERY_S:
                self._cell_until_s = now + self._chance.uniform(*_CELL_S)
            self.lost_v = self._cell_v if now < self._cell_until_s else 0.0
        if self._can_share:
            often = self._can_share / (1 - self._can_share) / (sum(_CAN_GAP_S) / 2)
            if now >= self._can_until_s and self._chance.random() < often * dt:
                self._can_until_s = now + self._chance.uniform(*_CAN_GAP_S)
            self.silent = now < self._can_until_s

    def measure(self, sample: MutableMapping[str, Value]) -> None:
        """Change the fields of a sample whose sensors are wrong."""
        for fault in self._sensors:
            value = sample.get(fault.field)
            if not isinstance(value, (int, float)):
                continue
            since_s = self._now_s - fault.from_s
            if fault.kind == "sensor_drift":
                value += fault.value * min(1.0, since_s / _DRIFT_S)
                sample[fault.field] = round(value, _DECIMALS[fault.field])
            elif since_s < fault.value:
                sample[fault.field] = self._kept.setdefault(fault.field, value)

    def _apply(self, fault: FaultConfig) -> None:
        if KINDS[fault.kind].by_field:
            self._sensors.append(fault)
        for name, changed in _CHANGES.get(fault.kind, {}).items():
            setattr(self, name, changed(getattr(self, name), fault.value))


# What a fault of a value changes, each from what it was before.
_CHANGES: Mapping[str, Mapping[str, Callable[[float, float], float]]] = {
    "worn_battery": {
        "battery_resistance": lambda before, value: before * (1 + value),
        "capacity": lambda before, value: before * max(0.01, 1 - value / 5),
    },
    "added_friction": {"friction_n": operator.add},
    "flat_tyre": {
        "radius": lambda before, value: before * (1 - value),
        "rolling": lambda before, value: before * (1 + 20 * value),
    },
    "dragging_brake": {"_brake_n": operator.add},
    "cell_dropout": {"_cell_v": operator.add},
    "cooling_lost": {"cooling": lambda before, value: before * (1 - value)},
    "loose_pinion": {"pinion_holds_n": min},
    "motor_resistance": {"motor_resistance_ohm": operator.add},
    "payload": {"payload_kg": operator.add},
    "intermittent_can": {"_can_share": lambda _, value: value},
}
