"""Looks at many cars in Chromium and counts at the broker what each look costs.

On the embedded cloud, over AWS IoT's WebSocket, with real agents: nobody looks; the fleet; one car; two
viewers of it; a page that is killed; and a connection with 200 ms of delay that drops every 20 s.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from bench.report import Report, Section
from bench.sections import Declared, Option
from iort_contract.cloud import VIEWER
from iort_contract.limits import LIVE_MAX_RATE_HZ
from iort_contract.messages.live import VIEW_LEASE_MS
from iort_contract.topics import LIVE, parse_topic
from iort_station.cloud import Cloud
from iort_station.fleet import robots
from iort_station.fleet.broker import Broker
from iort_station.fleet.roles import Role
from iort_station.page import motion
from iort_station.page.answers import actions, answers
from iort_station.page.server import PageServer
from local.network.proxy import Proxy
from testkit import chromium
from testkit.car import AgentProcess
from testkit.target import Say, Target
from testkit.waiting import InstrumentError, until

_STREAM = "vesc"
_WATCHED = "car1"
# Two messages of an idle car.
_COUNTED_S = 20.0
# A watched car is never silent for so long.
_SILENT_S = 2.0
_FAR_S, _LATENCY_S, _DROPS_S = 65.0, 0.2, 20.0
_LAPTOP = {"width": 1440, "height": 900}


@dataclass
class Look:
    """What one look costs: messages a second of the watched car, and of each other one on average."""

    what: str
    watched_hz: float
    others_hz: float
    note: str = ""


class Counted:
    """Counts the live messages of each car at the broker."""

    def __init__(self, cloud: Cloud) -> None:
        self._lock = threading.Lock()
        self._cars: Counter[str] = Counter()
        self._newest: dict[str, float] = {}
        self.broker = Broker(
            cloud,
            Role(cloud, VIEWER),
            filters=[f"{LIVE}/{cloud.namespace}/+/{_STREAM}"],
            on_message=self._take,
        )

    def _take(self, topic: str, _payload: bytes) -> None:
        robot = parse_topic(topic).robot
        with self._lock:
            self._cars[robot] += 1
            self._newest[robot] = time.monotonic()

    def silent_s(self, robot: str) -> float:
        """The time since the newest message of a car."""
        with self._lock:
            return time.monotonic() - self._newest.get(robot, 0.0)

    def over(self, seconds: float) -> Counter[str]:
        """The messages of each car in the next seconds."""
        with self._lock:
            before = Counter(self._cars)
        threading.Event().wait(seconds)
        with self._lock:
            return self._cars - before


def run(target: Target, say: Say, *, cars: int, pictures: Path | None) -> Section:
    """Take each look, and say what it cost."""
    looks = _looks(target, say, cars, pictures)
    section = Section("look", "Looking at cars")
    section.table(
        f"{cars} cars, messages a second and stream at the broker",
        ["look", "watched car", "each other car", "note"],
        [[look.what, f"{look.watched_hz:.2f}", f"{look.others_hz:.2f}", look.note] for look in looks],
    )
    section.raw = {"looks": [asdict(look) for look in looks]}
    return section


def _looks(target: Target, say: Say, cars: int, pictures: Path | None) -> list[Look]:
    cloud = target.cloud
    with ExitStack() as stack:
        browser = stack.enter_context(chromium.opened())
        say(f"starting {cars} agents")
        source = {"type": "sim", "stream": _STREAM, "rate_hz": LIVE_MAX_RATE_HZ}
        for i in range(cars):
            car = target.robot(f"car{i + 1}", sources=[source], live={"when": "watched"})
            stack.enter_context(AgentProcess(car, drain_s=0.0))
        counted = Counted(cloud)
        stack.enter_context(counted.broker)
        server = stack.enter_context(_served(cloud))
        looking = _Looking(browser, server.url, counted, say, cars=cars, pictures=pictures)
        until(lambda: len(counted.over(1.0)) > 0, "a car", 60)
        return [
            looking.at("nobody looks", None),
            looking.at("the fleet", "#/"),
            *looking.one_car(),
            looking.killed(),
            _far(browser, cloud, say),
        ]


class _Looking:
    """Opens pages, and counts meanwhile."""

    def __init__(
        self, browser: Any, url: str, counted: Counted, say: Say, *, cars: int, pictures: Path | None
    ) -> None:
        self._browser, self._url, self._counted, self._say = browser, url, counted, say
        self._cars, self._pictures = cars, pictures

    def at(self, what: str, view: str | None) -> Look:
        """Look at a view with one page; at none, the page is closed."""
        with ExitStack() as stack:
            if view is None:
                return self._count(what, None)
            page = stack.enter_context(self._page(view))
            threading.Event().wait(2)
            return self._count(what, page)

    def one_car(self) -> Iterator[Look]:
        """Look at one car, with a second viewer, and go one after the other."""
        with self._page("#/alarms") as first:
            until(lambda: first.evaluate(f"iort.robots.{_WATCHED} !== undefined"), "the car", 30)
            _sleeps(self._counted)
            before, began = self._counted.silent_s(_WATCHED), time.monotonic()
            first.goto(f"{self._url}#/car/{_WATCHED}")
            until(lambda: self._counted.silent_s(_WATCHED) < before, "the car to wake", 10, poll_s=0.01)
            woke_ms = (time.monotonic() - began) * 1000
            yield self._count("one car", first, f"awake after {woke_ms:.0f} ms")
            with self._page(f"#/car/{_WATCHED}") as second:
                first.goto(f"{self._url}#/alarms")
                yield self._count("one car, and the first of two viewers leaves", second)
        slept_s = _sleeps(self._counted)
        yield self._count("the second one closes its page", None, f"idle after {slept_s:.1f} s")

    def killed(self) -> Look:
        """Kill the process of a page that looks at the car."""
        with self._page(f"#/car/{_WATCHED}"):
            threading.Event().wait(2)
            session = self._browser.new_browser_cdp_session()
            processes = session.send("SystemInfo.getProcessInfo")["processInfo"]
            for process in processes:
                if process["type"] == "renderer":
                    os.kill(process["id"], signal.SIGKILL)
            slept_s = _sleeps(self._counted)
        if slept_s > VIEW_LEASE_MS / 1000 + 2:
            raise InstrumentError(f"a killed page held its car awake for {slept_s:.1f} s")
        return self._count("its process is killed", None, f"idle after {slept_s:.1f} s")

    @contextmanager
    def _page(self, view: str) -> Iterator[Any]:
        context = self._browser.new_context(viewport=_LAPTOP)
        page = context.new_page()
        page.goto(f"{self._url}{view}")
        until(lambda: page.evaluate("window.iort?.link") == "live", "the page to connect", 30)
        try:
            yield page
        finally:
            context.close()

    def _count(self, what: str, page: Any, note: str = "") -> Look:
        self._say(f"counting for {_COUNTED_S:.0f} s: {what}")
        counted = self._counted.over(_COUNTED_S)
        if page is not None:
            note = "; ".join(filter(None, (note, page.inner_text("#awake"), page.inner_text("#count"))))
            if self._pictures is not None:
                self._pictures.mkdir(parents=True, exist_ok=True)
                page.screenshot(path=self._pictures / f"{what.replace(' ', '-').replace(',', '')}.png")
        watched = counted.pop(_WATCHED, 0)
        others = sum(counted.values()) / max(1, self._cars - 1)
        return Look(what, watched / _COUNTED_S, others / _COUNTED_S, note)


def _far(browser: Any, cloud: Cloud, say: Say) -> Look:
    """Look at the car over a slow connection that drops, and note the longest time without a message."""
    say(f"looking for {_FAR_S:.0f} s over a slow connection that drops")
    relay = int(cloud.websocket_url.rpartition(":")[2].partition("/")[0])
    with Proxy("127.0.0.1", relay, latency_s=_LATENCY_S) as proxy:
        far = replace(cloud, websocket=f"ws://127.0.0.1:{proxy.port}/mqtt")
        with _served(far) as server:
            page = browser.new_page(viewport=_LAPTOP)
            page.goto(f"{server.url}#/car/{_WATCHED}")
            until(lambda: page.evaluate(f"iort.robots.{_WATCHED}?.state") == "live", "the car", 30)
            proxy.reset_every(_DROPS_S)
            end, longest_s, began = time.monotonic() + _FAR_S, 0.0, page.evaluate("iort.received")
            while time.monotonic() < end:
                longest_s = max(longest_s, page.evaluate(f"iort.robots.{_WATCHED}.silent_s"))
                page.wait_for_timeout(50)
            heard = (page.evaluate("iort.received") - began) / _FAR_S
            delay = page.evaluate(f"iort.robots.{_WATCHED}.delay_ms.median?.total")
            page.close()
    note = f"heard by the page, {len(proxy.attempts)} connections, longest silence {longest_s:.1f} s"
    return Look("200 ms and a drop every 20 s", heard, 0.0, f"{note}, median delay {delay:.0f} ms")


def _sleeps(counted: Counted) -> float:
    """Wait until the watched car sends no more than an idle one; return how long it went on, in seconds."""
    began = time.monotonic()
    until(lambda: counted.silent_s(_WATCHED) > _SILENT_S, "the car to sleep", 60, poll_s=0.01)
    return max(0.0, time.monotonic() - began - counted.silent_s(_WATCHED))


def _served(cloud: Cloud) -> PageServer:
    return PageServer(
        namespace=cloud.namespace,
        **motion.reaching(cloud, "iot"),
        vehicles={_WATCHED: robots.F1TENTH},
        answers=answers(cloud),
        open_actions=actions(cloud),
    )


SECTION = Declared(
    "cars in Chromium, and what each look costs at the broker",
    run,
    (Option("CARS", int, 20, "agents"), Option("PICTURES", Path, None, "a folder for a screenshot of each")),
    Report("look", "Looking at cars", "make bench ONLY=look"),
)
