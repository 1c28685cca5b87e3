"""Live updates as this machine hears them: what is kept of one, and the newest values of every car."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from rich.table import Table
from rich.text import Text

from iort_contract.catalog.derived import Vehicle
from iort_contract.catalog.vesc import FAULTS, hottest_degc
from iort_contract.limits import GONE_S, STALE_S, ContractError
from iort_contract.messages.live import decode_live_update, silent_s
from iort_contract.tables import ROBOT, T_US

MAX_ROBOTS = 256
_STATES = {"online": "green", "stale": "yellow", "gone": "red"}


class Heard(NamedTuple):
    """An update: its delay from the car to this machine, its sample's time in microseconds, and the hops."""

    robot: str
    stream: str
    boot: str
    seq: int
    delay_ms: float
    t_us: int
    hops: Mapping[str, int]


# Takes an update, the time at which PubNub took it (0 from the broker) and the time of its arrival here, in
# microseconds. It is called in the listener's own thread.
OnUpdate = Callable[[dict[str, Any], int, int], None]


def heard_of(update: Mapping[str, Any], now_us: int) -> Heard:
    """What is kept of an update that arrives now."""
    hops = update["hops"]
    return Heard(
        robot=update[ROBOT],
        stream=update["stream"],
        boot=update["boot"],
        seq=update["seq"],
        delay_ms=(now_us - hops["sent_us"]) / 1000,
        t_us=update[T_US],
        hops=hops,
    )


class Listening:
    """What a listener hears within its ``with`` block. Updates are in `heard` in the order of their arrival,
    unless ``on_update`` takes them; `malformed` counts messages that are none."""

    def __init__(self, on_update: OnUpdate | None) -> None:
        self.heard: list[Heard] = []
        self.malformed = 0
        self._on_update = on_update

    def take(self, update: Any, pubnub_us: int) -> None:
        """Take an update that arrives now."""
        now_us = time.time_ns() // 1000
        try:
            if self._on_update is not None:
                self._on_update(update, pubnub_us, now_us)
            else:
                self.heard.append(heard_of(update, now_us))
        except (KeyError, TypeError, ValueError):
            self.malformed += 1


@dataclass
class Car:
    """The newest values of a car; times in microseconds since the epoch, by this machine's clock."""

    robot: str
    heard_us: int = 0
    taken_us: int = 0
    delay_ms: float = 0.0
    # For so long it may send nothing.
    silent_s: float = 0.0
    sample: dict[str, Any] = field(default_factory=dict)

    def state(self, now_us: int) -> str:
        """``online``, ``stale`` or ``gone``."""
        if now_us - self.heard_us > (self.silent_s + GONE_S) * 1e6:
            return "gone"
        return "stale" if now_us - self.taken_us > (self.silent_s + STALE_S) * 1e6 else "online"

    def age_s(self, now_us: int) -> float:
        return max(0.0, (now_us - self.taken_us) / 1e6)

    def number(self, name: str) -> float | None:
        """A field of the newest sample; None if it is not a number."""
        value = self.sample.get(name)
        return float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else None

    def fault(self) -> str:
        """The fault's name; empty without one."""
        code = self.number("fault_code")
        return f"{FAULTS.get(int(code), 'unknown fault')} ({code:.0f})" if code else ""


def problem(update: Any, error: ContractError) -> str:
    """Whose update is malformed, if that is known, and why."""
    known = update if isinstance(update, dict) else {}
    robot, why = known.get(ROBOT), known.get("error", str(error))
    return f"of {robot}: {why}" if isinstance(robot, str) else str(why)


class FleetWatch:
    """Takes updates in one thread, and shows them in another."""

    def __init__(self, vehicles: Mapping[str, Vehicle]) -> None:
        self._vehicles = vehicles
        self._lock = threading.Lock()
        self._cars: dict[str, Car] = {}
        self.refused, self.newest_refused = 0, ""

    def take(self, update: Any, _pubnub_us: int, now_us: int) -> None:
        """Take an update from PubNub; an invalid one is counted in `refused`, and `newest_refused`
        says whose it was."""
        try:
            heard = decode_live_update(update)
        except ContractError as error:
            self.refused += 1
            self.newest_refused = problem(update, error)
            return
        robot, live = heard.robot, heard.live
        with self._lock:
            if robot not in self._cars and len(self._cars) >= MAX_ROBOTS:
                del self._cars[min(self._cars.values(), key=lambda car: car.heard_us).robot]
            car = self._cars.setdefault(robot, Car(robot))
            car.heard_us, car.silent_s = now_us, silent_s(live.next_ms)
            # A sample's age is its age on leaving, by the car's clock, and the delay since then.
            car.delay_ms = (now_us - live.sent_us - (live.offset_us or 0)) / 1000
            in_car_us = live.sent_us - live.t_us
            car.taken_us = now_us - max(0, in_car_us) - max(0, round(car.delay_ms * 1000))
            car.sample.update(live.sample)

    def cars(self) -> list[Car]:
        """The cars by name; car2 comes before car10."""
        with self._lock:
            return sorted(self._cars.values(), key=lambda car: _natural(car.robot))

    def table(self, now_us: int, width: int) -> Table:
        """A table of ``width`` characters."""
        narrow = width < 56
        table = Table(box=None, expand=True, pad_edge=False, header_style="dim")
        columns = ["car", "state", "speed", "V"]
        if not narrow:
            columns += ["°C", "delay"]
        if width >= 90:
            columns.append("age")
        for name in columns:
            left = name in {"car", "state"}
            longest = 16 if narrow and name == "car" else None
            table.add_column(name, justify="left" if left else "right", no_wrap=True, max_width=longest)
        # The fault has the rest of the line.
        table.add_column("fault", no_wrap=True, overflow="ellipsis", style="bold red", ratio=1)
        for car in self.cars():
            state = car.state(now_us)
            cells: dict[str, Text | str] = {
                "car": Text(car.robot, style="bold" if state == "online" else "dim"),
                "state": Text(state, style=_STATES[state]),
                "speed": self._speed(car),
                "V": _figure(car.number("voltage_input"), 1),
                "°C": _figure(hottest_degc(car.sample), 0),
                "delay": f"{car.delay_ms:.0f} ms",
                "age": f"{car.age_s(now_us):.1f} s",
            }
            style = "" if state == "online" else "dim"
            table.add_row(*(cells[name] for name in columns), car.fault(), style=style)
        return table

    def _speed(self, car: Car) -> str:
        erpm = car.number("speed")
        vehicle = self._vehicles.get(car.robot)
        if erpm is None:
            return "-"
        if vehicle is None:
            return f"{erpm:.0f} erpm"
        return f"{(erpm - vehicle.speed_to_erpm_offset) / vehicle.speed_to_erpm_gain:.1f} m/s"


def _figure(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _natural(name: str) -> list[tuple[int, str]]:
    """A key that sorts car2 before car10."""
    parts = re.split(r"([0-9]+)", name)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]
