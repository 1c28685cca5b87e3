"""Measures driving by hand from the page: `make bench-drive`.

Keys are pressed in a real Chromium, and a ROS node hears the agent's motion commands. Measured is the time
from a key press to the command; and for each way in which the page, the browser, the network or the agent can
fail while the car drives, whether its stop comes within the lease.
"""

from __future__ import annotations

import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from bench.command import made, parser, write
from bench.errors import BenchError
from bench.load.course import LEASE_S, ROBOT, Course
from bench.meters import chromium, usage
from bench.report.result import Table
from bench.ros.graph import python_with_rospy
from local.errors import LocalError
from local.figures import Spread
from local.proxy import FREEZE, PASS

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

PRESSES, TRIES = 100, 50
# A hold that a slow round trip ends before the failure is no try.
_HOLDS = 60
_DRIVEN_S, _PAUSE_S, _START_MS = 0.3, 0.7, 60_000


@dataclass(frozen=True)
class Stops:
    """The tries of one failure. ``within`` counts those whose stop came within the lease of the last command
    that moved the car, with no motion after it; ``after_ms`` is from the failure to the stop."""

    failure: str
    tries: int
    within: int
    after_ms: Spread


class Driver:
    """A person with the keys Space and Up, at a page of the course."""

    def __init__(self, course: Course, browser: Browser) -> None:
        self.course = course
        # Without a graphics card, smooth charts take a core.
        self._context = browser.new_context(viewport={"width": 1280, "height": 800}, reduced_motion="reduce")
        self.page: Page
        self.sit(course.server.invitation(f"#/car/{ROBOT}"))

    def sit(self, address: str = "") -> None:
        """Open the page, and take the wheel."""
        self.page = self._context.new_page()
        self.page.goto(address or f"{self.course.server.url}#/car/{ROBOT}")
        take = self.page.get_by_role("button", name="Take the wheel")
        take.click(timeout=_START_MS)
        self.page.evaluate(
            """() => addEventListener("keydown", ({ code, timeStamp }) => {
                 if (code === "ArrowUp") window.pressed_ms = performance.timeOrigin + timeStamp;
               }, { capture: true })"""
        )

    def hold(self) -> None:
        """Hold Space until the car may be driven."""
        for _ in range(_HOLDS):
            self.page.keyboard.up("ArrowUp")
            self.page.keyboard.up("Space")
            self.page.locator(".drive[data-phase=free]").wait_for(timeout=_START_MS)
            self.page.keyboard.down("Space")
            done = self.page.locator(".drive[data-phase=driving], .drive[data-phase=over]")
            done.wait_for(timeout=_START_MS)
            if done.get_attribute("data-phase") == "driving":
                return
            time.sleep(_PAUSE_S)
        raise BenchError(f"the car is not driven: {self.page.locator('.drive-said').inner_text()}")

    def drive(self) -> None:
        """Drive on until commands have moved the car for a moment."""
        for _ in range(_HOLDS):
            self.hold()
            began = time.monotonic()
            self.page.keyboard.down("ArrowUp")
            with suppress(BenchError):
                self.course.wait(began, moving=True, within_s=1)
                time.sleep(_DRIVEN_S)
                if time.monotonic() - self.course.last_motion().at < 0.2:
                    return
        raise BenchError("the car does not move")

    def release(self) -> None:
        """Let go of all keys."""
        for key in ("ArrowUp", "Space"):
            self.page.keyboard.up(key)
        self.course.quiet(_PAUSE_S)


def _press_ms(driver: Driver, count: int) -> Spread:
    """From the press of a key to the first command at the ROS subscriber that moves the car."""
    took: list[float] = []
    while len(took) < count:
        driver.hold()
        before = time.monotonic()
        driver.page.keyboard.down("ArrowUp")
        # A hold may end at that moment; then this was no measurement.
        with suppress(BenchError):
            heard = driver.course.wait(before, moving=True, within_s=1)
            took.append(heard.wall_s * 1000 - float(driver.page.evaluate("pressed_ms")))
        driver.release()
    return Spread.of(took)


def _hidden(driver: Driver) -> Callable[[], None]:
    other = driver.page.context.new_page()
    other.bring_to_front()

    def again() -> None:
        other.close()
        driver.page.bring_to_front()

    return again


def _closed(driver: Driver) -> Callable[[], None]:
    driver.page.close()
    return driver.sit


def _frozen(_driver: Driver) -> Callable[[], None]:
    browser = [pid for pid in usage.descendants(os.getpid()) if "chrom" in _program(pid)]
    for pid in browser:
        os.kill(pid, signal.SIGSTOP)

    def again() -> None:
        for pid in browser:
            os.kill(pid, signal.SIGCONT)

    return again


def _cut(driver: Driver) -> Callable[[], None]:
    proxy = driver.course.proxy
    proxy.mode = FREEZE

    def again() -> None:
        proxy.mode = PASS
        # The page opens a new connection.
        proxy.reset()

    return again


def _killed(driver: Driver) -> Callable[[], None]:
    driver.course.kill_agent()
    return driver.course.start_agent


FAILURES: dict[str, Callable[[Driver], Callable[[], None]]] = {
    "tab hidden": _hidden,
    "tab closed": _closed,
    "browser frozen (SIGSTOP)": _frozen,
    "network cut": _cut,
    "agent killed (SIGKILL)": _killed,
}


def _program(pid: int) -> str:
    with suppress(OSError):
        return Path(f"/proc/{pid}/comm").read_text()
    return ""


def _stops(driver: Driver, failure: str, tries: int, progress: Callable[[str], None]) -> Stops:
    course, within, after_ms = driver.course, 0, []
    for done in range(tries):
        driver.drive()
        failed_at = time.monotonic()
        again = FAILURES[failure](driver)
        with suppress(BenchError):
            stop = course.wait(failed_at, moving=False, within_s=LEASE_S * 6)
            after_ms.append((stop.at - failed_at) * 1000)
            course.quiet(LEASE_S)
            last = course.last_motion()
            within += last.at < stop.at <= max(last.at, failed_at) + LEASE_S
        again()
        with suppress(Exception):  # a page that is closed or still frozen has no keys
            driver.release()
        progress(f"{failure}: {within} of {done + 1}")
    return Stops(failure, tries, within, Spread.of(after_ms))


def main() -> None:
    """Measure and print; exit status 1 if a stop came too late."""
    arguments = parser(__doc__)
    arguments.add_argument("--tries", type=int, default=TRIES, help="tries of each failure")
    arguments.add_argument("--presses", type=int, default=PRESSES, help="measured key presses")
    arguments.add_argument("--only", choices=[*FAILURES], nargs="*", default=[*FAILURES])
    options = arguments.parse_args()
    console = Console()
    try:
        with (
            tempfile.TemporaryDirectory() as folder,
            chromium.opened() as browser,
            Course(python_with_rospy(), Path(folder)) as course,
        ):
            driver = Driver(course, browser)
            console.print(f"{options.presses} key presses ...")
            press_ms = _press_ms(driver, options.presses)
            found = [
                _stops(driver, failure, options.tries, lambda text: console.print(f"  {text}", style="dim"))
                for failure in options.only
            ]
    except (BenchError, LocalError) as error:
        sys.exit(f"bench-drive: {error}")
    _table(press_ms, found).show(console)
    written: dict[str, Any] = {"press_ms": asdict(press_ms), "stops": [asdict(one) for one in found]}
    write(options.json, {**made(), "lease_ms": LEASE_S * 1000, **written})
    sys.exit(1 if any(one.within < one.tries for one in found) else 0)


def _table(press_ms: Spread, found: list[Stops]) -> Table:
    rows = [["key press to command at the ROS subscriber", press_ms.text(0), ""]]
    rows += [[f"stop, {one.failure}", f"{one.within} of {one.tries}", one.after_ms.text(0)] for one in found]
    return Table(
        "Driving by hand", ["figure", "measured", f"stop after, lease {LEASE_S * 1000:.0f} ms"], rows
    )


if __name__ == "__main__":
    main()
