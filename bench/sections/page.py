"""The cost of the page in the browser, with 20 cars at 10 Hz.

Processor time of the page's main thread and of its worker, as shares of a processor, on the fleet's view
and on that of one car, by Chromium's own counters; and the JavaScript heap after a collection, every half
minute of the soak, with the memory of the page's process. Processor time, because on a machine that is
shared the wall clock measures the others.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
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


@dataclass(frozen=True)
class View:
    """The main thread's share of a processor over ``seconds``, and the messages a second."""

    name: str
    seconds: float
    main_thread: float
    messages_per_s: float


def run(_target: Target | None, say: Say, *, cars: int, rate: float, seconds: float, soak: float) -> Section:
    """Measure each view, then the memory for as long as the soak."""
    views, heap, process, bounds = _watched(say, cars, rate, seconds, soak)
    section = Section("page", "The page in its browser")
    section.table(
        f"The page with {cars} cars at {rate:g} Hz",
        ["view", "main thread busy", "messages/s"],
        [
            [view.name, f"{view.main_thread:.1%} of a processor", f"{view.messages_per_s:.0f}"]
            for view in views
        ],
    )
    memory = {"JavaScript heap after a collection": heap, "the page's process": process}
    rows = [[what, ", ".join(f"{mb:.1f}" for mb in figures)] for what, figures in memory.items()]
    section.table(f"Memory every {_STEP_S:.0f} s", ["of", "MB"], rows)
    for view in views:
        name = f"main thread busy, {view.name}"
        section.ratio(name, round(view.main_thread, 4), MAX_BUSY, unit="of a processor", by_machine=True)
    section.raw = {
        "cars": cars,
        "rate_hz": rate,
        "views": [asdict(view) for view in views],
        "heap_mb": heap,
        "process_mb": process,
        "bounds": bounds,
    }
    return section


def _watched(
    say: Say, cars: int, rate: float, seconds: float, soak: float
) -> tuple[list[View], list[float], list[float], Any]:
    """Return the views; heap and memory in MB every half minute of the soak; and the page's bounds."""
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
        views = []
        for name, address in (("fleet", "#/"), ("one car", "#/car/car1")):
            page.goto(url + address)
            say(f"{name}: filling the charts")
            page.wait_for_timeout(_WARM_UP_S * 1000)
            say(f"{name}: measuring for {seconds:.0f} s")
            views.append(_measure(page, probe, name, seconds))
        heap, process = [], []
        all_processes = browser.new_browser_cdp_session()
        for _ in range(int(soak / _STEP_S) + 1):
            heap.append(_heap_mb(probe))
            process.append(_process_mb(all_processes))
            say(f"memory: {heap[-1]:.1f} MB after {len(heap) * _STEP_S - _STEP_S:.0f} s")
            page.wait_for_timeout(_STEP_S * 1000)
        return views, heap, process, page.evaluate("iort.bounds")


@contextmanager
def _cars(origin: str, count: int, rate_hz: float) -> Iterator[None]:
    """Run the cars in their own process, which ends when its input does."""
    keys = ["--publish-key", _KEY, "--subscribe-key", _KEY]
    command = [sys.executable, "-m", "bench.load.cars", "--origin", origin, *keys, "--cars", str(count)]
    command += ["--rate", str(rate_hz)]
    with subprocess.Popen(command, stdin=subprocess.PIPE):
        yield


def _measure(page: Any, probe: Any, name: str, seconds: float) -> View:
    before, messages = _metrics(probe), page.evaluate("iort.received")
    began = time.monotonic()
    page.wait_for_timeout(seconds * 1000)
    took = time.monotonic() - began
    busy = _metrics(probe)["TaskDuration"] - before["TaskDuration"]
    received = page.evaluate("iort.received") - messages
    return View(name, took, busy / took, received / took)


def _metrics(probe: Any) -> dict[str, float]:
    return {each["name"]: each["value"] for each in probe.send("Performance.getMetrics")["metrics"]}


def _heap_mb(probe: Any) -> float:
    probe.send("HeapProfiler.collectGarbage")
    return float(_metrics(probe)["JSHeapUsedSize"]) / 1e6


def _process_mb(browser: Any) -> float:
    """The memory of the page's process: columns of numbers are not on the heap."""
    found = browser.send("SystemInfo.getProcessInfo")["processInfo"]
    renderers = [each for each in found if each["type"] == "renderer"]
    # The others are Chromium's spare ones.
    return machine.usage_of(max(renderers, key=lambda each: each["cpuTime"])["id"]).rss_mb


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
