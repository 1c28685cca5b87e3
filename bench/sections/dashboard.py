"""The delay from the car to a PubNub subscriber, and to a painted frame in Chromium."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from typing import Any

from bench.report import Section, text
from bench.sections import Declared
from iort_contract.catalog.vesc import VESC_STREAM
from iort_station.page.page import BUILT, load_keys
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
        live={"when": "always"},
    )
    painted: list[tuple[float, float]] = []
    with (
        target.listener(bundle.robot) as listener,
        AgentProcess(bundle) as agent,
        _page(target, bundle.robot, say) as page,
    ):
        threading.Event().wait(_WARM_UP_S)
        before = len(listener.heard)
        say(f"driving for {SECONDS} s")
        if page is not None:
            page.evaluate(_WATCH, bundle.robot)
            page.wait_for_timeout(SECONDS * 1000)
            painted = page.evaluate("window.__painted")
        else:
            threading.Event().wait(SECONDS)
        if agent.process.poll() is not None:
            raise InstrumentError("the agent stopped while it was watched")
        heard_ms = [update.delay_ms for update in listener.heard[before:]]
    if not heard_ms:
        raise InstrumentError("no live update was heard")
    return report(heard_ms, [at - t / 1000 for t, at in painted])


def report(heard_ms: list[float], shown_ms: list[float]) -> Section:
    """Make the section of the delays to a subscriber, and to a frame."""
    section, thesis = Section("dashboard", "To the dashboard"), f"{THESIS['dashboard']} ms"
    section.table(
        "From the sample in the car, by this machine's one clock where the car is simulated on it",
        ["way", "median (p95)", "thesis, 2018"],
        [
            ["car to PubNub subscriber", text([heard_ms]), thesis],
            ["car to painted frame in Chromium", text([shown_ms]), thesis],
        ],
    )
    # To the subscriber it is a few milliseconds through five processes, which vary more than a frame does.
    for way, delays_ms, most, tolerance in (
        ("subscriber", heard_ms, 1.0, 8.0),
        ("pixel", shown_ms, 0.15, 2.5),
    ):
        delay = Spread.of(delays_ms)
        name, share = f"car to {way} / thesis' {_THESIS_MS} ms", delay.p50 and delay.p50 / _THESIS_MS
        section.ratio(name, share, most, tolerance=tolerance, by_machine=True)
        section.raw[way] = asdict(delay)
    section.notes.append(
        "`iort trace` tells the delay hop by hop. A painted frame is the first one after the update's that "
        "the browser has handed over; Chromium draws 60 a second without a display, so half a frame of the "
        "delay is waiting for the next."
    )
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
