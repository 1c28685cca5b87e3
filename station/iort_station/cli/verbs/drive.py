"""`iort drive`: drive a car by the keys of a terminal."""

from __future__ import annotations

import os
import re
import select
import sys
import termios
import tty
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Annotated

import typer
from rich.live import Live
from rich.table import Table
from rich.text import Text

from iort_contract.messages.commands import (
    DRIVE_MAX_AGE_MS,
    DRIVE_MAX_RTT_MS,
)
from iort_station.cli.console import out
from iort_station.cli.options import Blind, Robot, examples, option
from iort_station.cloud import Cloud
from iort_station.errors import StationError, UsageError
from iort_station.fleet import stopping
from iort_station.fleet.driving import Driver, Phase, Stick
from iort_station.fleet.seat import TICK_US, Seat, driver_of, monotonic_us

# The keys of `iort drive` as a stick with a dead man's switch.
#
# A terminal tells no release of a key, only repetitions while it is held, and only of the key that was
# pressed last. So a key counts as held until its repetitions fail to come. The car then stops.

# The longest usual time from a press to its first repetition, and several times the time between two.
FIRST_US, NEXT_US = 700_000, 200_000
_SPEED = {"w": 1.0, "up": 1.0, "s": -1.0, "down": -1.0}
_STEERING = {"a": 1.0, "left": 1.0, "d": -1.0, "right": -1.0}
_ARROWS = {"A": "up", "B": "down", "C": "right", "D": "left"}
_ESCAPE = "\x1b"
# A key, which may be a sequence of characters, and the beginning of one.
_KEY = re.compile(r"\x1b(?:\[[0-?]*[ -/]*|O)([@-~])|(.)", re.DOTALL)
_BEGUN = re.compile(r"\x1b(?:\[[0-?]*[ -/]*|O)?\Z")
# Keys that come at once: more of them have waited on their way, and may have been let go since.
_AT_ONCE = 5


def keys_of(text: str) -> tuple[list[str], str]:
    """The keys in what a terminal sent: letters in lower case, and arrows by their names; and the rest, which
    is the beginning of a key. A key that is a sequence of characters is none of these characters."""
    begun = _BEGUN.search(text)
    end = begun.start() if begun is not None else len(text)
    return [_key(found) for found in _KEY.finditer(text, 0, end)], text[end:]


def _key(found: re.Match[str]) -> str:
    final, letter = found.groups()
    if letter is not None:
        return str(letter).lower()
    return _ARROWS.get(final, _ESCAPE) if len(found[0]) == len("\x1b[A") else _ESCAPE


def moves(key: str) -> bool:
    """Whether a key moves the stick."""
    return key in _SPEED or key in _STEERING


class Keys:
    """The stick that the keys make. Times are microseconds of a monotonic clock."""

    def __init__(self) -> None:
        self._speed = self._steering = 0.0
        self._until_us = self._steering_until_us = 0
        self._last = ""
        self._deaf_until_us = 0

    def arrived(self, keys: Sequence[str], now_us: int) -> None:
        """Note that these keys came at once. If they have waited, let go, and take none until they fail to
        come: whoever held them may have let go while the network stood still."""
        if sum(map(moves, keys)) > _AT_ONCE:
            self.let_go()
            self._deaf_until_us = now_us + NEXT_US

    def press(self, key: str, now_us: int) -> bool:
        """Take a key or its repetition; whether it moves the stick."""
        if not moves(key):
            return False
        if self.late(now_us):
            self._deaf_until_us = now_us + NEXT_US
            return True
        repeated = key == self._last and self.held(now_us)
        if not self.held(now_us):
            self._speed = self._steering = 0.0
        self._last, self._until_us = key, now_us + (NEXT_US if repeated else FIRST_US)
        if key in _SPEED:
            self._speed = _SPEED[key]
        else:
            self._steering, self._steering_until_us = _STEERING[key], self._until_us
        return True

    def late(self, now_us: int) -> bool:
        """Whether keys are not taken, because they came late."""
        return now_us < self._deaf_until_us

    def let_go(self) -> None:
        self._until_us = 0

    def held(self, now_us: int) -> bool:
        return now_us < self._until_us

    def stick(self, now_us: int) -> Stick:
        """Where the stick is. The speed stays while the terminal repeats another key, which steers."""
        if not self.held(now_us):
            return Stick()
        return Stick(self._speed, self._steering if now_us < self._steering_until_us else 0.0)


commands = typer.Typer()
_SHOWN_US = 100_000
_USUAL_MPS = 1.0
_FASTER = 1.25
_HELP = "w s a d or arrows: drive   space: stop   + -: top speed   t: take over   e: emergency stop   q: quit"


@commands.command("drive", epilog=examples("drive car7", "drive car7 --max-speed 0.5"))
def drive(
    context: typer.Context,
    robot: Robot,
    max_speed: Annotated[
        float | None, option("The top speed in m/s; at most the car's own limit.", min=0.01)
    ] = None,
    by: Annotated[str | None, option("Who drives, as others see it. Default: the user.")] = None,
    blind: Blind = False,
) -> None:
    """Drive a car by the keys of this terminal, until q.

    The car moves while a key is held: by w a s d or the arrows. It stops when the key's repetitions stop, and
    when round trip or newest sample are too old. It needs the right to drive (docs/how-to/drive.md). A
    terminal shows no picture: a car with a camera is driven so with --blind alone.
    """
    if not (sys.stdin.isatty() and out.is_terminal):
        raise UsageError("iort drive needs a terminal with a keyboard")
    cloud = context.obj.cloud()
    driver = driver_of(cloud, robot, by=by, top_mps=max_speed or _USUAL_MPS, blind=blind)
    seat = _Seat(cloud, robot, driver)
    with seat.broker, _raw_keys(), Live(console=out, auto_refresh=False, transient=True) as live:
        try:
            seat.run(live)
        except KeyboardInterrupt:
            pass
        finally:
            seat.leave()


class _Seat(Seat):
    """A seat with the keys of this terminal."""

    def __init__(self, cloud: Cloud, robot: str, driver: Driver) -> None:
        super().__init__(cloud, robot, driver)
        self._urgent = cloud.urgent()
        self._keys, self._begun = Keys(), ""
        self._stop_asked = False

    def run(self, live: Live) -> None:
        """Drive until the driver quits."""
        due_us = shown_us = monotonic_us()
        while self._take_keys(max(0, due_us - monotonic_us()) / 1e6):
            now_us = monotonic_us()
            if now_us < due_us:
                continue
            # After a pause of this process, what was due is not made up for.
            due_us = max(due_us + TICK_US, now_us)
            self._tick(now_us)
            if now_us >= shown_us:
                shown_us = now_us + _SHOWN_US
                live.update(self._shown(now_us), refresh=True)

    def _take_keys(self, wait_s: float) -> bool:
        """Wait for keys, and take them; False to quit."""
        readable, _, _ = select.select([sys.stdin], [], [], wait_s)
        text = os.read(sys.stdin.fileno(), 1024).decode(errors="replace") if readable else ""
        if readable and not text:
            return False  # the terminal has closed
        keys, self._begun = keys_of(self._begun + text)
        self._keys.arrived(keys, monotonic_us())
        for key in keys:
            if key == "q":
                return False
            self._press(key, monotonic_us())
        return True

    def _press(self, key: str, now_us: int) -> None:
        driver = self.driver
        if self._keys.press(key, now_us):
            return
        if key == " ":
            self._keys.let_go()
        elif key in "+=":
            driver.top_mps = min(driver.top_mps * _FASTER, driver.limits.max_speed_mps)
        elif key == "-":
            driver.top_mps /= _FASTER
        elif key == "t":
            driver.takeover = not driver.takeover
        elif key == "e":
            self._stop(now_us)

    def _stop(self, now_us: int) -> None:
        """Stop in an emergency; raises `StationError` if that fails."""
        self._keys.let_go()
        # The broker is faster than the shadow.
        self._tick(now_us)
        failed = stopping.stop(self._urgent, [self._robot], by=self.driver.by)
        if failed:
            raise StationError(f"the emergency stop of {self._robot} has failed: {failed[self._robot]}")
        self._stop_asked = True

    def _tick(self, now_us: int) -> None:
        self.tick(held=self._keys.held(now_us), stick=self._keys.stick(now_us), now_us=now_us)

    def _shown(self, now_us: int) -> Table:
        driver = self.driver
        rows = Table(box=None, show_header=False, pad_edge=False)
        rows.add_column(style="dim")
        rows.add_column()
        stick = driver.stick if driver.phase is Phase.DRIVING else None
        speed = f"{stick.speed * driver.top_mps:+.2f}" if stick else "0"
        steering = f"{stick.steering * driver.limits.max_steering_rad:+.2f}" if stick else "0"
        late = self._keys.late(now_us)
        rows.add_row(self._robot, Text("let go: the keys came late", style="red") if late else _state(driver))
        rows.add_row(
            "speed",
            f"{speed} m/s of {driver.top_mps:.2f}; the car's limit is {driver.limits.max_speed_mps:g}",
        )
        rows.add_row("steering", f"{steering} rad")
        rows.add_row("round trip", _ms(driver.rtt_us, DRIVE_MAX_RTT_MS))
        rows.add_row("newest sample", _ms(driver.age_us(now_us), DRIVE_MAX_AGE_MS))
        if driver.unsighted:
            rows.add_row("picture", Text("none: you drive blind", style="yellow"))
        if self._stop_asked:
            confirms = f"asked for; `iort stop {self._robot}` tells whether the car has confirmed it"
            rows.add_row("emergency stop", Text(confirms, style="red"))
        rows.add_row("", Text(_HELP, style="dim"))
        return rows


def _state(driver: Driver) -> Text:
    if driver.phase is Phase.OVER:
        return Text(f"let go: {driver.reason}", style="red")
    if driver.phase is Phase.DRIVING:
        return Text("you drive", style="bold green")
    if driver.phase is Phase.HOLDING:
        if driver.mine:
            return Text("you hold the car: it stands until you drive or quit", style="bold green")
        return Text("the car does not hear you: others, or a planner on board, may drive it", style="red")
    if driver.phase is Phase.STARTING:
        return Text("waiting for the car", style="yellow")
    text = f"{driver.driver} drives" if driver.driver and not driver.mine else "hold a key to drive"
    return Text(f"{text}; the next hold takes over" if driver.takeover else text)


def _ms(us: int | None, most: int) -> Text:
    if us is None:
        return Text("-")
    return Text(f"{us / 1000:.0f} ms", style="red" if us > most * 1000 else "")


@contextmanager
def _raw_keys() -> Iterator[None]:
    """Give each key at once, without showing it."""
    before = termios.tcgetattr(sys.stdin)
    tty.setcbreak(sys.stdin)
    try:
        yield
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)
