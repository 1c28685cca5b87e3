"""The delay from the car to a PubNub subscriber, hop by hop, and to a painted frame in Chromium."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from typing import Any

from bench.report import Section, text
from bench.sections import Declared
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.page import PUBNUB_ORIGIN
from iort_station.operations import audit, trace
from iort_station.page.page import BUILT, load_keys
from iort_station.page.pubnub import Listener
from iort_station.page.server import PageServer
from local.figures import THESIS, Spread
from testkit import chromium
from testkit.car import AgentProcess
from testkit.target import Say, Target
from testkit.waiting import InstrumentError

SECONDS = 24
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
    bundle = target.robot(
        "bench-dashboard",
        sources=[{"type": "sim", "stream": VESC_STREAM, "rate_hz": 50, "pose": {"rate_hz": 0}}],
        metrics={"every_s": 1},
        live={"when": "always"},
        ping={"rate_hz": 1},
    )
    pubnub = load_keys(target.cloud)
    updates: list[trace.Times] = []
    listener = Listener(
        robot=bundle.robot,
        namespace=target.cloud.namespace,
        on_update=lambda update, at, here: updates.append(trace.times(update, at, here)),
        **pubnub.reading(),
    )
    painted: list[tuple[float, float]] = []
    with listener, trace.pubnub_clock(pubnub.origin or PUBNUB_ORIGIN, tls=pubnub.tls) as ask:
        here = trace.clock_of(ask, lambda: time.time_ns() // 1000)
        with AgentProcess(bundle) as agent, _page(target, bundle.robot, say) as page:
            threading.Event().wait(_WARM_UP_S)
            updates.clear()
            say(f"driving for {SECONDS} s")
            if page is not None:
                page.evaluate(_WATCH, bundle.robot)
                page.wait_for_timeout(SECONDS * 1000)
                painted = page.evaluate("window.__painted")
            else:
                threading.Event().wait(SECONDS)
            if agent.process.poll() is not None:
                raise InstrumentError("the agent stopped while it was watched")
            heard = list(updates)
        figures = audit.last_figures(target.cloud, bundle.robot)
    if not heard:
        raise InstrumentError("no live update was heard")
    hops = trace.trace(heard, here_to_pubnub=here, car_uncertainty_ms=figures.get("clock_uncertainty_ms"))
    heard_ms = [(update.here_us - update.sample_us) / 1000 for update in heard]
    return report(hops, heard_ms, [at - t / 1000 for t, at in painted])


def report(hops: trace.Trace, heard_ms: list[float], shown_ms: list[float]) -> Section:
    """Make the section of the hops and the delays."""
    section, thesis = Section("dashboard", "To the dashboard"), f"{THESIS['dashboard']} ms"
    section.table(
        "From the sample in the car, by this machine's one clock where the car is simulated on it",
        ["way", "median (p95)", "thesis, 2018"],
        [
            ["car to PubNub subscriber", text([heard_ms]), thesis],
            ["car to painted frame in Chromium", text([shown_ms]), thesis],
        ],
    )
    rows = []
    for hop in [*hops.hops, hops.whole]:
        doubt = "not known" if hop.uncertainty_ms is None else f"{hop.uncertainty_ms:.2f} ms"
        rows.append([hop.name, f"{hop.p50_ms:.2f} ms", f"{hop.p95_ms:.2f} ms", doubt])
    section.table("Hop by hop", ["hop", "median", "p95", "clocks may falsify it by"], rows)
    # To the subscriber it is a few milliseconds through five processes, which vary more than a frame does.
    for way, delays_ms, most, tolerance in (
        ("subscriber", heard_ms, 1.0, 8.0),
        ("pixel", shown_ms, 0.15, 2.5),
    ):
        took = Spread.of(delays_ms).p50
        name, share = f"car to {way} / thesis' {_THESIS_MS} ms", took and took / _THESIS_MS
        section.ratio(name, share, most, tolerance=tolerance, by_machine=True)
    section.notes.append(
        "A painted frame is the first one after the update's that the browser has handed over; Chromium "
        "draws 60 a second without a display, so half a frame of the delay is waiting for the next."
    )
    section.raw = {
        "hops": asdict(hops),
        "subscriber_ms": asdict(Spread.of(heard_ms)),
        "painted_ms": asdict(Spread.of(shown_ms)),
    }
    return section


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


SECTION = Declared("from the car to a subscriber and to a painted frame", run, dollars=0.001)
