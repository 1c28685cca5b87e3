"""Driving by hand from the page.

Keys are pressed in a real Chromium, and a ROS node hears the agent's motion commands. Measured is the time
from a key press to the command; and for each way in which the page, the browser, the network or the agent can
fail while the car drives, whether its stop comes within the lease.
"""

from __future__ import annotations

import os
import signal
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from bench.load.course import LEASE_S, ROBOT, Course, Try
from bench.report import Report, Section
from bench.sections import Declared, Option
from local.figures import Spread
from testkit.chromium import Tabs
from testkit.proxy import FREEZE, PASS
from testkit.ros import python_with_rospy
from testkit.target import Say, Target
from testkit.waiting import InstrumentError

if TYPE_CHECKING:
    from playwright.sync_api import Browser, BrowserType, Page

# A hold that a slow round trip ends before the failure is no try; so many for each that counts, at most.
_HOLDS, _VOID = 60, 3
# Before the failure, for what is told of a try.
_SEEN_S = 1.0
Failed = tuple[float, Callable[[], None]]
_DRIVEN_S, _PAUSE_S, _START_MS = 0.3, 0.7, 60_000


class Driver:
    """A person with the keys Space and Up, at a page of the course."""

    def __init__(self, course: Course, tabs: Tabs, chromium: BrowserType) -> None:
        self.course, self.tabs, self._chromium = course, tabs, chromium
        self.page: Page
        self._browser: Browser
        self.connect()
        self.sit(course.server.invitation(f"#/car/{ROBOT}"))

    def connect(self) -> None:
        """Have the browser in hand, again, with the car's page if it is open."""
        self._browser = self._chromium.connect_over_cdp(self.tabs.url)
        pages = self._browser.contexts[0].pages
        self.page = next((page for page in pages if ROBOT in page.url), pages[0])

    def disconnect(self) -> None:
        """Leave the browser to itself; the keys stay pressed."""
        self._browser.close()

    def sit(self, address: str = "") -> None:
        """Open the page, and take the wheel."""
        self.page = self._browser.contexts[0].new_page()
        # Without a graphics card, smooth charts take a core.
        self.page.emulate_media(reduced_motion="reduce")
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
            free = self.page.locator(".drive[data-phase=free], .drive[data-phase=holding]")
            free.wait_for(timeout=_START_MS)
            self.page.keyboard.down("Space")
            done = self.page.locator(".drive[data-phase=driving], .drive[data-phase=over]")
            done.wait_for(timeout=_START_MS)
            if done.get_attribute("data-phase") == "driving":
                return
            time.sleep(_PAUSE_S)
        raise InstrumentError(f"the car is not driven: {self.page.locator('.drive-said').inner_text()}")

    def drive(self) -> None:
        """Drive on until commands have moved the car for a moment."""
        for _ in range(_HOLDS):
            self.hold()
            began = time.monotonic()
            self.page.keyboard.down("ArrowUp")
            with suppress(InstrumentError):
                self.course.wait(began, moving=True, within_s=1)
                time.sleep(_DRIVEN_S)
                if time.monotonic() - self.course.last_motion().at < 0.2:
                    return
        raise InstrumentError("the car does not move")

    def release(self) -> None:
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
        with suppress(InstrumentError):
            heard = driver.course.wait(before, moving=True, within_s=1)
            took.append(heard.wall_s * 1000 - float(driver.page.evaluate("pressed_ms")))
        driver.release()
    return Spread.of(took)


# Each returns when it happened, and what makes it good again.
def _hidden(driver: Driver) -> Failed:
    driver.disconnect()
    at, tab = time.monotonic(), driver.tabs.cover()

    def again() -> None:
        driver.tabs.uncover(tab)
        driver.connect()

    return at, again


def _closed(driver: Driver) -> Failed:
    at = time.monotonic()
    driver.page.close()
    return at, driver.sit


def _frozen(driver: Driver) -> Failed:
    processes, at = driver.tabs.processes(), time.monotonic()
    for pid in processes:
        os.kill(pid, signal.SIGSTOP)
    return at, lambda: driver.tabs.signal(signal.SIGCONT)


def _cut(driver: Driver) -> Failed:
    at, proxy = time.monotonic(), driver.course.proxy
    proxy.mode = FREEZE

    def again() -> None:
        proxy.mode = PASS
        # The page opens a new connection.
        proxy.reset()

    return at, again


def _killed(driver: Driver) -> Failed:
    at = time.monotonic()
    driver.course.kill_agent()
    return at, driver.course.start_agent


FAILURES: dict[str, Callable[[Driver], Failed]] = {
    "tab hidden": _hidden,
    "tab closed": _closed,
    "browser frozen (SIGSTOP)": _frozen,
    "network cut": _cut,
    "agent killed (SIGKILL)": _killed,
}


def _tries(driver: Driver, failure: str, tries: int, say: Say) -> list[Try]:
    """So many tries of a failure. Raises `InstrumentError` where the car stood too often when it came."""
    course, done = driver.course, list[Try]()
    for _ in range(tries * _VOID):
        driver.drive()
        began = time.monotonic() - _SEEN_S
        failed_at, again = FAILURES[failure](driver)
        with suppress(InstrumentError):
            course.wait(failed_at, moving=False, within_s=LEASE_S * 6)
            course.quiet(LEASE_S)
        each = Try(failed_at, [heard for heard in course.heard if heard.at >= began])
        again()
        with suppress(Exception):  # a page that is closed or still frozen has no keys
            driver.release()
        if not each.driven:
            say(f"{failure}: the car stood when it came: no try")
            continue
        done.append(each)
        good = sum(not one.why for one in done)
        say(f"{failure}: {good} of {len(done)}" + (f": {each.why}" if each.why else ""))
        if len(done) == tries:
            return done
    raise InstrumentError(f"{failure}: the car stood in too many of {tries * _VOID} tries")


def run(_target: Target | None, say: Say, *, tries: int, presses: int, part: str) -> Section:
    """Measure key presses, then each failure so often."""
    try:
        from playwright.sync_api import sync_playwright  # noqa: PLC0415 - only who has a browser needs it
    except ImportError as error:
        raise InstrumentError("playwright is not installed: run `make setup`") from error
    if part and part not in FAILURES:
        raise InstrumentError(f"PART={part}: allowed is one of {', '.join(FAILURES)}")
    section = Section("drive", "Driving by hand")
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder,
        sync_playwright() as play,
        Tabs(Path(folder)) as tabs,
        Course(python_with_rospy(), Path(folder)) as course,
    ):
        driver = Driver(course, tabs, play.chromium)
        say(f"{presses} key presses")
        press_ms = _press_ms(driver, presses)
        done = {failure: _tries(driver, failure, tries, say) for failure in ([part] if part else FAILURES)}
    rows = [["key press to command at the ROS subscriber", press_ms.text(0), ""]]
    for failure, of_failure in done.items():
        stopped = [one.first.at - one.failed_at for one in of_failure if one.first is not None]
        after = Spread.of([seconds * 1000 for seconds in stopped])
        latest_ms = max((one.late_s for one in of_failure if one.late_s is not None), default=0.0) * 1000
        missed = [one for one in of_failure if one.why]
        stops = f"{tries - len(missed)} of {tries}"
        rows.append([f"stop, {failure}", stops, f"{after.text(0)}, at most {latest_ms:.0f}"])
        section.ratio(f"{failure}: stops after the lease", len(missed), 0, unit=f"of {tries}")
        section.notes += [f"{failure}: {one.story()}" for one in missed]
        section.raw[failure] = {"after_ms": asdict(after), "latest_ms": latest_ms}
    lease = f"stop after, lease {LEASE_S * 1000:.0f} ms"
    section.table("Driving by hand", ["figure", "measured", lease], rows)
    section.raw["press_ms"] = asdict(press_ms)
    return section


SECTION = Declared(
    "driving by hand from the page, with ROS 1",
    run,
    (
        Option("TRIES", int, 50, "tries of each failure"),
        Option("PRESSES", int, 100, "measured key presses"),
        Option("PART", str, "", f"one failure alone: {', '.join(FAILURES)}"),
    ),
    Report("drive", "Driving by hand", "make bench ONLY=drive"),
    cloud=False,
)
