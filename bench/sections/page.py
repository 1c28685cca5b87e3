"""The cost of the page in the browser, with 20 cars at 10 Hz.

Processor time of the page's main thread, as shares of a processor, on the fleet's view and on that of one
car, by Chromium's own counters; and the JavaScript heap after a collection, every half minute of the soak,
with the memory of the page's process. Processor time, because on a machine that is shared the wall clock
measures the others.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from bench.load.cars import RATE_HZ
from bench.report import Report, Section
from bench.sections import Declared, Option
from iort_station.fleet.robots import F1TENTH
from iort_station.page.server import PageServer
from local.pubnub import PubNubStandIn
from testkit import chromium, machine
from testkit.target import Say, Target

# Share of a processor; the rest stays free for the user of the machine.
MAX_BUSY = 0.30
_WARM_UP_S = 35.0  # until the charts' 30 s are full
_STEP_S = 30.0
_KEY = "bench"


def run(_target: Target | None, say: Say, *, cars: int, rate: float, seconds: float, soak: float) -> Section:
    """Measure each view, then the memory for as long as the soak."""
    section = Section("page", "The page in its browser")
    with ExitStack() as stack:
        pubnub = stack.enter_context(PubNubStandIn(publish_key=_KEY, subscribe_key=_KEY))
        vehicles = {f"car{i + 1}": F1TENTH for i in range(cars)}
        server = PageServer(
            namespace="iort", subscribe_key=_KEY, origin=pubnub.origin, tls=False, vehicles=vehicles
        )
        url = stack.enter_context(server).url
        stack.enter_context(_cars(pubnub.origin, cars, rate))
        browser = stack.enter_context(chromium.opened())
        page = browser.new_page(viewport={"width": 1440, "height": 900})
        page.goto(url)
        probe = page.context.new_cdp_session(page)
        probe.send("Performance.enable", {"timeDomain": "threadTicks"})
        rows = []
        for view, address in (("fleet", "#/"), ("one car", "#/car/car1")):
            page.goto(url + address)
            say(f"{view}: filling the charts")
            page.wait_for_timeout(_WARM_UP_S * 1000)
            say(f"{view}: measuring for {seconds:.0f} s")
            busy, messages_per_s = _measure(page, probe, seconds)
            rows.append([view, f"{busy:.1%} of a processor", f"{messages_per_s:.0f}"])
            name = f"main thread busy, {view}"
            section.ratio(name, busy, MAX_BUSY, unit="of a processor", by_machine=True)
        head = ["view", "main thread busy", "messages/s"]
        section.table(f"The page with {cars} cars at {rate:g} Hz", head, rows)
        memory_mb: dict[str, list[float]] = {
            "JavaScript heap after a collection": [],
            "the page's process": [],
        }
        processes = browser.new_browser_cdp_session()
        for step in range(int(soak / _STEP_S) + 1):
            for of, mb in zip(memory_mb.values(), (_heap_mb(probe), _process_mb(processes)), strict=True):
                of.append(mb)
            say(f"memory after {step * _STEP_S:.0f} s")
            page.wait_for_timeout(_STEP_S * 1000)
        rows = [[of, ", ".join(f"{mb:.1f}" for mb in values)] for of, values in memory_mb.items()]
        section.table(f"Memory every {_STEP_S:.0f} s", ["of", "MB"], rows)
        section.raw = {"memory_mb": memory_mb, "bounds": page.evaluate("iort.bounds")}
    return section


@contextmanager
def _cars(origin: str, count: int, rate_hz: float) -> Iterator[None]:
    """Run the cars in their own process, which ends when its input does."""
    command = [sys.executable, "-m", "bench.load.cars", "--origin", origin, "--key", _KEY]
    command += ["--cars", str(count), "--rate", str(rate_hz)]
    with subprocess.Popen(command, stdin=subprocess.PIPE):
        yield


def _measure(page: Any, probe: Any, seconds: float) -> tuple[float, float]:
    """The main thread's share of a processor over ``seconds``, and the messages a second."""
    before, messages = _metrics(probe), page.evaluate("iort.received")
    began = time.monotonic()
    page.wait_for_timeout(seconds * 1000)
    took = time.monotonic() - began
    busy = _metrics(probe)["TaskDuration"] - before["TaskDuration"]
    return busy / took, (page.evaluate("iort.received") - messages) / took


def _metrics(probe: Any) -> dict[str, float]:
    return {each["name"]: each["value"] for each in probe.send("Performance.getMetrics")["metrics"]}


def _heap_mb(probe: Any) -> float:
    probe.send("HeapProfiler.collectGarbage")
    return float(_metrics(probe)["JSHeapUsedSize"]) / 1e6


def _process_mb(browser: Any) -> float:
    """The memory of the page's process: columns of numbers are not on the heap."""
    processes = browser.send("SystemInfo.getProcessInfo")["processInfo"]
    # The others are Chromium's spare ones.
    renderers = (process for process in processes if process["type"] == "renderer")
    busiest = max(renderers, key=lambda process: process["cpuTime"])
    return machine.usage_of(busiest["id"]).rss_mb


SECTION = Declared(
    "the page in Chromium, with many cars",
    run,
    (
        Option("CARS", int, 20, "cars"),
        Option("RATE", float, RATE_HZ, "Hz, of each car"),
        Option("SECONDS", float, 30.0, "of each view"),
        Option("SOAK", float, 300.0, "seconds of watching the memory"),
    ),
    Report("page", "The page in its browser", "make bench ONLY=page"),
    cloud=False,
)
