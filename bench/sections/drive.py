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
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from bench.load.course import LEASE_S, ROBOT, Course, Heard, Try
from bench.report import Report, Section
from bench.sections import Declared, Option
from local.figures import Spread
from local.network.proxy import FREEZE, PASS
from testkit.chromium import Tabs
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


@dataclass(frozen=True)
class Stops:
    """The tries of one failure.

    ``within`` counts those whose stop came within the lease of the last command that moved the car, with no
    motion after it. ``after_ms`` is from the failure to the stop. ``latest_ms`` is the longest time to a
    stop, from the failure or from the last command that moved the car, whichever was later.
    """

    failure: str
    tries: int
    within: int
    after_ms: Spread
    latest_ms: float


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


def _stops(
    driver: Driver, failure: str, tries: int, progress: Callable[[str], None]
) -> tuple[Stops, list[Try]]:
    """The figures of all tries, and those that failed."""
    course = driver.course
    done: list[Try] = []
    for _ in range(tries * _VOID):
        driver.drive()
        began = time.monotonic() - _SEEN_S
        failed_at, again = FAILURES[failure](driver)
        failed = Heard(failed_at, time.time() - (time.monotonic() - failed_at), 0.0)
        with suppress(InstrumentError):
            course.wait(failed_at, moving=False, within_s=LEASE_S * 6)
            course.quiet(LEASE_S)
        heard = [one for one in course.heard if one.at >= began]
        again()
        with suppress(Exception):  # a page that is closed or still frozen has no keys
            driver.release()
        one = Try(failure, len(done) + 1, failed, heard, LEASE_S)
        if not one.driven:
            progress(f"{failure}: the car stood when it came: no try")
            continue
        done.append(one)
        within = sum(not each.why for each in done)
        progress(f"{failure}: {within} of {len(done)}" + (f": {one.why}" if one.why else ""))
        if len(done) == tries:
            break
    else:
        raise InstrumentError(
            f"{failure}: the car stood in {tries * _VOID - len(done)} of {tries * _VOID} tries"
        )
    after_ms = [(one.first.at - one.failed.at) * 1000 for one in done if one.first is not None]
    latest_s = max((one.late_s for one in done if one.late_s is not None), default=0.0)
    missed = [one for one in done if one.why]
    spread = Spread.of(after_ms)
    return Stops(failure, tries, tries - len(missed), spread, round(latest_s * 1000, 1)), missed


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
        press_ms, stops = _press_ms(driver, presses), list[Stops]()
        for failure in [part] if part else FAILURES:
            each, missed = _stops(driver, failure, tries, say)
            stops.append(each)
            for one in missed:
                story = "; ".join(one.lines(course.cloud, ROBOT))
                section.notes.append(f"Try {one.number} of {one.failure}: {story}")
    rows = [["key press to command at the ROS subscriber", press_ms.text(0), ""]]
    for each in stops:
        after = f"{each.after_ms.text(0)}, at most {each.latest_ms:.0f}"
        rows.append([f"stop, {each.failure}", f"{each.within} of {each.tries}", after])
        late = each.tries - each.within
        section.ratio(f"{each.failure}: stops after the lease", late, 0, unit=f"of {each.tries}")
    lease = f"stop after, lease {LEASE_S * 1000:.0f} ms"
    section.table("Driving by hand", ["figure", "measured", lease], rows)
    section.raw = {"press_ms": asdict(press_ms), "stops": [asdict(one) for one in stops]}
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
