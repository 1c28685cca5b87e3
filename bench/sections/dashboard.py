"""The delay from the car to a PubNub subscriber, hop by hop, and to a painted frame in Chromium."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from typing import Any

from bench import plots
from bench.report import Section, spread, text
from bench.sections import Declared
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.page import PUBNUB_ORIGIN
from iort_station.operations import audit, trace
from iort_station.page.page import BUILT, load_keys
from iort_station.page.pubnub import Listener
from iort_station.page.server import PageServer
from local.figures import THESIS
from testkit import chromium
from testkit.car import AgentProcess
from testkit.target import Say, Target
from testkit.waiting import InstrumentError

ROBOT = "bench-dashboard"
SECONDS = 24
_CHUNKS = 3
_WARM_UP_S = 3.0
_THESIS_MS = 300
# After the frame that shows an update has been handed over, in the page's own clock, which is the
# machine's: [time of the sample, in microseconds; time of the frame, in milliseconds].
_WATCH = """robot => {
  const seen = window.__painted = [];
  let last = -1;
  const now = () => performance.timeOrigin + performance.now();
  const look = () => {
    const received = window.iort.received;
    if (received !== last) {
      last = received;
      const update = window.iort.robots[robot]?.streams?.vesc;
      if (update) requestAnimationFrame(() => {
        const after = new MessageChannel();
        after.port1.onmessage = () => seen.push([update.t, now()]);
        after.port2.postMessage(0);
      });
    }
    requestAnimationFrame(look);
  };
  requestAnimationFrame(look);
}"""


def run(target: Target, say: Say) -> Section:
    """Drive one car at 50 Hz, its live lane at 10 Hz, and watch it as an operator does."""
    section = Section("dashboard", "To the dashboard")
    bundle = target.robot(
        ROBOT,
        sources=[{"type": "sim", "stream": VESC_STREAM, "rate_hz": 50, "pose": {"rate_hz": 0}}],
        metrics={"every_s": 1},
        live={"when": "always"},
        ping={"rate_hz": 1},
    )
    pubnub = load_keys(target.cloud)
    found: list[trace.Times] = []
    listener = Listener(
        robot=bundle.robot,
        namespace=target.cloud.namespace,
        on_update=lambda update, at, here: found.append(trace.times(update, at, here)),
        **pubnub.reading(),
    )
    painted: list[tuple[float, float]] = []
    with listener, trace.pubnub_clock(pubnub.origin or PUBNUB_ORIGIN, tls=pubnub.tls) as ask:
        here = trace.clock_of(ask, lambda: time.time_ns() // 1000)
        with AgentProcess(bundle) as agent, _page(target, bundle.robot, say) as page:
            threading.Event().wait(_WARM_UP_S)
            found.clear()
            say(f"driving for {SECONDS} s")
            if page is not None:
                page.evaluate(_WATCH, bundle.robot)
                page.wait_for_timeout(SECONDS * 1000)
                painted = [(float(t), float(at)) for t, at in page.evaluate("window.__painted")]
            else:
                threading.Event().wait(SECONDS)
            if agent.process.poll() is not None:
                raise InstrumentError("the agent stopped while it was watched")
            updates = list(found)
        figures = audit.last_figures(target.cloud, bundle.robot)
    if not updates:
        raise InstrumentError("no live update was heard")
    hops = trace.trace(updates, here_to_pubnub=here, car_uncertainty_ms=figures.get("clock_uncertainty_ms"))
    heard = [(one.here_us - one.sample_us) / 1000 for one in updates]
    shown = [at - t / 1000 for t, at in painted]
    _report(section, hops, heard, shown)
    return section


def _report(section: Section, hops: trace.Trace, heard: list[float], shown: list[float]) -> None:
    to_subscriber, to_pixel = spread(_chunks(heard)), spread(_chunks(shown))
    thesis = f"{THESIS['dashboard']} ms"
    section.table(
        "From the sample in the car, by this machine's one clock where the car is simulated on it",
        ["way", "median (p95, p99; range of the medians of three stretches)", "thesis, 2018"],
        [
            ["car to PubNub subscriber", text(_chunks(heard)), thesis],
            [
                "car to painted frame in Chromium",
                to_pixel.text() if to_pixel else "no Chromium here",
                thesis,
            ],
        ],
    )
    rows = [
        [
            hop.name,
            f"{hop.p50_ms:.2f} ms",
            f"{hop.p95_ms:.2f} ms",
            "not known" if hop.uncertainty_ms is None else f"{hop.uncertainty_ms:.2f} ms",
        ]
        for hop in [*hops.hops, hops.whole]
    ]
    section.table("Hop by hop", ["hop", "median", "p95", "clocks may falsify it by"], rows)
    curves = {"PubNub subscriber": heard, "painted frame": shown}
    section.plot("dashboard", "From the sample in the car", plots.cdf(curves))
    # To the subscriber it is a few milliseconds through five processes, which vary more than a frame does.
    for way, found, most, tolerance in (
        ("subscriber", to_subscriber, 1.0, 8.0),
        ("pixel", to_pixel, 0.15, 2.5),
    ):
        share = round(found.p50 / _THESIS_MS, 4) if found else None
        name = f"car to {way} / thesis' {_THESIS_MS} ms"
        section.ratio(name, share, most, tolerance=tolerance, by_machine=True)
    section.notes.append(
        "A painted frame is the first one after the update's that the browser has handed over; Chromium "
        "draws 60 a second without a display, so half a frame of the delay is waiting for the next."
    )
    section.raw = {
        "hops": asdict(hops),
        "subscriber_ms": asdict(to_subscriber) if to_subscriber else None,
        "painted_ms": asdict(to_pixel) if to_pixel else None,
    }


def _chunks(values: list[float]) -> list[list[float]]:
    size = max(1, -(-len(values) // _CHUNKS))
    return [values[i : i + size] for i in range(0, len(values), size)]


@contextmanager
def _page(target: Target, robot: str, say: Say) -> Iterator[Any]:
    """Yield the live page in a real browser, or None without a browser or a built page."""
    if chromium.found() is None or not (BUILT / "index.html").is_file():
        say("no Chromium, or the page is not built: measured to the subscriber only")
        yield None
        return
    server = PageServer(namespace=target.cloud.namespace, **load_keys(target.cloud).reading())
    with server as page_server, chromium.opened() as browser:
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        page.goto(page_server.url)
        page.wait_for_function(
            "robot => window.iort?.robots[robot]?.streams?.vesc", arg=robot, timeout=60_000
        )
        yield page


SECTION = Declared("from the car to a subscriber and to a painted frame", run)
