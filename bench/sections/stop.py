"""The emergency stop under full overload.

A simulated car drives on the embedded cloud. Three tabs of one real Chromium wait for the past, and other
clients hold more answers than the page's server works on at a time. Then stop is pressed in a fourth tab.
Measured is the time from the press until the server takes it, until it has answered, and until the page shows
the car's own word.
"""

from __future__ import annotations

import http.client
import threading
import time
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, cast

from typing_extensions import Self

from bench.report import Report, Section
from bench.sections import Declared, Option
from iort_station.fleet import stopping
from iort_station.page import motion
from iort_station.page.answers import actions, answers, keyed_actions
from iort_station.page.requests import Handler
from iort_station.page.server import PageServer
from local.figures import Spread
from testkit import chromium
from testkit.car import AgentProcess
from testkit.target import Say, Target
from testkit.waiting import until

if TYPE_CHECKING:
    from playwright.sync_api import Page

_WORDS = {
    "taken": "the server takes it",
    "answered": "the server has answered",
    "shown": "the page shows the car's word",
}
# What is fast enough for a stop.
WITHIN_MS = 300
_ROBOT = "car1"
_TABS, _CLIENTS, _RANGES = 3, 40, 6
_START_S = 60.0
_HELD = ("history", "rejected", "runs")
# Notes when the button was pressed, and when the page first says that the car stands.
_WATCH = """(robot) => {
  const words = document.querySelector(".stop-words");
  document.querySelector(".stop-press").addEventListener("click", ({ timeStamp }) => {
    window.pressed_ms = performance.timeOrigin + timeStamp;
    window.shown_ms = undefined;
    const look = () => {
      const stands = words.textContent.includes(`Emergency stop: ${robot} stands`);
      if (stands) window.shown_ms = performance.timeOrigin + performance.now();
      else requestAnimationFrame(look);
    };
    look();
  }, { capture: true });
}"""


class Course:
    """The page's server, with answers that are held, and the times at which it took and answered stops."""

    def __init__(self, target: Target) -> None:
        self._target, self.cloud = target, target.cloud
        self._exit = ExitStack()
        self._go = threading.Event()
        self.taken_ms: list[float] = []
        self.answered_ms: list[float] = []

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            stack.enter_context(AgentProcess(self._target.robot(_ROBOT), drain_s=0.0))
            keyed = keyed_actions(self.cloud)
            self.server = stack.enter_context(
                PageServer(
                    namespace=self.cloud.namespace,
                    **motion.reaching(self.cloud, "iot"),
                    answers={**answers(self.cloud), **dict.fromkeys(_HELD, self._hold)},
                    open_actions=actions(self.cloud),
                    actions={**keyed, "stop": self._timed(keyed["stop"])},
                )
            )
            stack.callback(self._go.set)
            self._exit = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._exit.close()

    def overload(self) -> None:
        """Have other clients hold answers until the end."""
        for _ in range(_CLIENTS):
            threading.Thread(target=self._ask, daemon=True).start()

    def release(self) -> None:
        """Let the car move again."""
        stopping.release(self.cloud, [_ROBOT], by="bench")
        until(lambda: not self._motion().asked and not self._motion().stopped, "the release", _START_S)

    def ready(self) -> bool:
        """Whether the car has said that a stop ends its motion."""
        return self._motion().stoppable is True

    def _motion(self) -> stopping.Motion:
        return stopping.motion(self.cloud, [_ROBOT])[_ROBOT]

    def _ask(self) -> None:
        connection = http.client.HTTPConnection("127.0.0.1", self.server.port)
        with suppress(OSError, http.client.HTTPException):  # the server ends with the bench
            connection.request("GET", f"/{_HELD[1]}.json")
            connection.getresponse().read()

    def _hold(self, _asked: Mapping[str, str]) -> Mapping[str, Any]:
        self._go.wait()
        return {"robots": {}}

    def _timed(self, stop: Handler) -> Handler:
        def timed(asked: Mapping[str, str]) -> Mapping[str, Any]:
            self.taken_ms.append(time.time() * 1000)
            answer = cast("Mapping[str, Any]", stop(asked))  # it waits for no robot
            self.answered_ms.append(time.time() * 1000)
            return answer

        return timed


def _past(server: PageServer) -> str:
    ranges = [f"{_ROBOT}/2026-05-04T1{i}:00:00.000Z/2026-05-04T1{i}:01:00.000Z" for i in range(_RANGES)]
    return f"{server.url}#/compare?runs={','.join(ranges)}"


def _press(course: Course, page: Page) -> dict[str, float]:
    """Press stop once, and let the car move again; the milliseconds until each of `_WORDS`."""
    before = len(course.answered_ms)
    page.locator(".stop-press").click()
    until(lambda: len(course.answered_ms) > before, "the answer", _START_S)
    # Not playwright's own waiting: the page's policy forbids what that evaluates.
    until(lambda: page.evaluate("window.shown_ms !== undefined"), "the car's word", _START_S)
    pressed, shown = (float(page.evaluate(name)) for name in ("pressed_ms", "shown_ms"))
    course.release()
    page.locator(".stop-stands").wait_for(state="hidden", timeout=_START_S * 1000)
    times = {"taken": course.taken_ms[before], "answered": course.answered_ms[before], "shown": shown}
    return {name: ms - pressed for name, ms in times.items()}


def run(target: Target, say: Say, *, tries: int) -> Section:
    """Press stop so often while everything else is overloaded."""
    took: dict[str, list[float]] = {name: [] for name in _WORDS}
    with chromium.opened() as browser, Course(target) as course:
        until(course.ready, "the car", _START_S)
        context = browser.new_context()
        page = context.new_page()
        page.goto(course.server.invitation())
        page.locator(".stop-press").wait_for(timeout=_START_S * 1000)
        for _ in range(_TABS):
            context.new_page().goto(_past(course.server))
        course.overload()
        page.bring_to_front()
        page.evaluate(_WATCH, _ROBOT)
        for number in range(1, tries + 1):
            for name, ms in _press(course, page).items():
                took[name].append(ms)
            say(f"{number}: " + ", ".join(f"{name} {values[-1]:.0f} ms" for name, values in took.items()))
    section, rows = Section("stop", "Stop under full overload"), []
    for name, values in took.items():
        within = f"{sum(value <= WITHIN_MS for value in values)} of {tries}"
        rows.append([_WORDS[name], within, f"{Spread.of(values).text(0)}, at most {max(values):.0f}"])
        section.raw[name] = {**asdict(Spread.of(values)), "most": max(values)}
    section.table(f"{tries} presses", ["from the press until", f"within {WITHIN_MS} ms", "ms"], rows)
    late = sum(value > WITHIN_MS for value in took["taken"])
    section.ratio(f"stops that the server took after {WITHIN_MS} ms", late, 0, unit=f"of {tries}")
    return section


SECTION = Declared(
    "the emergency stop under full overload",
    run,
    (Option("TRIES", int, 20, "presses of the stop"),),
    Report("stop", "The emergency stop", "make bench ONLY=stop"),
)
