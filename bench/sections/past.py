"""The frames of the page's past over an hour of 50 Hz, while the viewer drags and hovers.

A frame is the time from one animation frame of the browser to the next; without a display there are 60 a
second at most. The processor time of the page's main thread is beside it: it varies less than frames on a
machine that others use.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import asdict
from itertools import pairwise
from typing import Any

from bench.load import stored_drive
from bench.report import Report, Section
from bench.sections import Declared, Option
from iort_agent.sources.sim.driver import HALL
from iort_contract.catalog.streams import POSE_STREAM
from iort_contract.catalog.vesc import VESC_STREAM
from iort_station.page.answers import answers
from iort_station.page.page import load_keys
from iort_station.page.server import PageServer
from iort_station.times import iso
from local.figures import Spread
from testkit import chromium
from testkit.car import RATE_HZ
from testkit.target import Say, Target

HOUR_S = 3600
# 60 frames a second, and what a clock adds.
MAX_FRAME_MS = 17.0
# The rest of a frame is the compositor's.
MAX_BUSY_MS = 12.0
PANELS = {
    "the usual panels": "",
    "all panels": "map:pose:speed,speed~pose/x~current_motor,xy:speed:current_motor,voltage_input,"
    "current_motor,current_input,duty_cycle,temperature_pcb,table:vesc",
}
_WIDTH, _HEIGHT = 1440, 900
_LOADED_MS, _SETTLED_MS = 60_000, 1_000
# Positions of the pointer from one edge to the other; the browser takes one a frame.
_STEPS = 60
_WATCH = """() => {
  const frames = (window.__frames = []);
  const look = (at) => {
    frames.push(at);
    if (window.__frames === frames) requestAnimationFrame(look);
  };
  requestAnimationFrame(look);
}"""
_TAKE = "() => { const frames = window.__frames; window.__frames = undefined; return frames; }"
Box = dict[str, float]


def run(target: Target, say: Say, *, seconds: float) -> Section:
    """Store the hour, and move in each way over each set of panels."""
    robot = target.robot("bench-past").robot
    say(f"storing an hour of {RATE_HZ} Hz")
    from_us = _store(target, robot)
    server = PageServer(
        namespace=target.cloud.namespace,
        **load_keys(target.cloud).reading(),
        answers=answers(target.cloud, HALL),
        track=HALL,
    )
    section, rows = Section("past", "The page's past"), []
    with server as served, chromium.opened() as browser:
        for panels, fields in PANELS.items():
            page = browser.new_page(viewport={"width": _WIDTH, "height": _HEIGHT})
            more = f"&fields={fields}" if fields else ""
            ends = f"from={iso(from_us)}&to={iso(from_us + HOUR_S * 1_000_000)}"
            page.goto(f"{served.url}#/history/{robot}?stream={VESC_STREAM}&{ends}{more}")
            probe = page.context.new_cdp_session(page)
            probe.send("Performance.enable", {"timeDomain": "threadTicks"})
            for way, move in WAYS.items():
                say(f"{panels}: {way}")
                frames_ms, busy_ms, load = measure(page, probe, move, seconds)
                spread = Spread.of(frames_ms)
                fps = 1000 * len(frames_ms) / sum(frames_ms)
                rows.append([panels, way, spread.text(1), f"{fps:.1f}", f"{busy_ms:.1f} ms", f"{load:.1f}"])
                name = f"a frame while {way}, {panels}, p50"
                section.ratio(name, spread.p50, MAX_FRAME_MS, unit="ms", tolerance=2.0, by_machine=True)
                section.raw[f"{panels}, {way}"] = {**asdict(spread), "fps": fps, "busy_ms": busy_ms}
            page.close()
    most = max(each["busy_ms"] for each in section.raw.values())
    name = "main thread a frame, in the way that takes most"
    section.ratio(name, most, MAX_BUSY_MS, unit="ms", tolerance=2.0, by_machine=True)
    head = ["panels", "way", "frame", "frames/s", "main thread a frame", "load of the machine"]
    section.table(f"An hour of {RATE_HZ} Hz in {_WIDTH}x{_HEIGHT}, without a GPU", head, rows)
    return section


def _store(target: Target, robot: str) -> int:
    """Store the car's samples and its way; returns when they begin."""
    samples = stored_drive.simulated(HOUR_S * RATE_HZ)
    poses = stored_drive.simulated(HOUR_S * RATE_HZ, POSE_STREAM)
    at_once = [(t_us, pose) for (t_us, _), (_, pose) in zip(samples, poses, strict=True)]
    stored_drive.store(target, robot, samples)
    stored_drive.store(target, robot, at_once, POSE_STREAM)
    return samples[0][0]


def measure(
    page: Any, probe: Any, move: Callable[[Any, float], None], seconds: float
) -> tuple[list[float], float, float]:
    """The frames, the main thread's processor time a frame, both in milliseconds, and the machine's load."""
    page.locator(".history-note", has_text="samples in").wait_for(timeout=_LOADED_MS)
    page.wait_for_timeout(_SETTLED_MS)
    move(page, _SETTLED_MS / 1000)
    page.evaluate(_WATCH)
    before = _busy_s(probe)
    move(page, seconds)
    busy_s = _busy_s(probe) - before
    at = page.evaluate(_TAKE)
    page.mouse.up()
    page.mouse.move(0, 0)
    frames_ms = [after - before for before, after in pairwise(at)]
    return frames_ms, 1000 * busy_s / len(frames_ms), os.getloadavg()[0]


def _busy_s(probe: Any) -> float:
    metrics = {each["name"]: each["value"] for each in probe.send("Performance.getMetrics")["metrics"]}
    return float(metrics["TaskDuration"])


def _swept(page: Any, box: Box, seconds: float) -> None:
    """Move the pointer over a box, from edge to edge and back."""
    y, inset = box["y"] + box["height"] / 2, 4
    ends = box["x"] + box["width"] - inset, box["x"] + inset
    until, turn = time.monotonic() + seconds, 0
    while time.monotonic() < until:
        page.mouse.move(ends[turn % 2], y, steps=_STEPS)
        turn += 1


def _box(page: Any, selector: str) -> Box:
    place = page.locator(selector).first
    page.mouse.up()
    place.scroll_into_view_if_needed()
    box: Box = place.bounding_box()
    page.mouse.move(box["x"] + 4, box["y"] + box["height"] / 2)
    return box


_CHART = ".panel[data-lines] .u-over"


def _drag_playhead(page: Any, seconds: float) -> None:
    box = _box(page, ".scrub")
    page.mouse.down()
    _swept(page, box, seconds)


def _hover_chart(page: Any, seconds: float) -> None:
    _swept(page, _box(page, _CHART), seconds)


def _hover_way(page: Any, seconds: float) -> None:
    _swept(page, _box(page, ".panel.map .u-over"), seconds)


def _pan(page: Any, seconds: float) -> None:
    """Pan by the wheel, to and fro by half the hour at most."""
    box = _box(page, _CHART)
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    until, turn = time.monotonic() + seconds, 0
    while time.monotonic() < until:
        for _ in range(_STEPS):
            page.mouse.wheel(box["width"] / 2 / _STEPS * (-1 if turn % 2 else 1), 0)
        turn += 1


WAYS = {
    "dragging the playhead": _drag_playhead,
    "panning": _pan,
    "hovering over a chart": _hover_chart,
    "hovering over the trajectory": _hover_way,
}

SECTION = Declared(
    "frames of the page's past while the viewer drags and hovers",
    run,
    (Option("SECONDS", float, 8.0, "of each way"),),
    Report("past", "The page's past in its browser", "make bench ONLY=past"),
)
