"""Takes the pictures in docs/images: `make screenshots`, or with `ONLY=video` those of driving by sight.

On the embedded cloud: one real agent drives a simulated car through everything, and other cars are
published to PubNub's stand-in as Lambda 1 would, so that there is a fleet to see, with a fault, a car that
is gone, poses and accelerations. A second agent drives a healthy car, for `iort plot`."""

from __future__ import annotations

import io
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from bench.load.cars import SimulatedCar, drive
from bench.proof.fleet import drive_of
from bench.proof.judging import analysed
from iort_agent.sources.sim.driver import HALL
from iort_agent.sources.sim.vehicle import VehicleConfig
from iort_analysis.evaluation import evaluate
from iort_analysis.process import analyse
from iort_analysis.samples.blocks import Block
from iort_contract.catalog.derived import F1TENTH
from iort_contract.catalog.streams import POSE_STREAM
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.cloud import IOT
from iort_contract.messages.analysis import AnalysedDrive, DriveKey
from iort_contract.messages.commands import DRIVE_TYPE
from iort_station import data
from iort_station.cloud import Cloud
from iort_station.data import findings
from iort_station.data.runs import laps_of_runs, runs
from iort_station.fleet import robots
from iort_station.kept import CLOUD
from iort_station.page import motion
from iort_station.page.answers import actions, answers, downloads, keyed_actions
from iort_station.page.server import PageServer
from iort_station.times import iso
from local.cloud import EmbeddedCloud
from testkit import ROOT, chromium
from testkit.car import AgentProcess

OUT = ROOT / "docs" / "images"
DRIVE_S = 100
_REAL, _HEALTHY = "car1", "car12"
_FLEET = 10
_FAULTY, _STOPS, _SENSES = 4, 7, 1
# What the analysis finds in the real car, and the drives of the healthy one before.
_FAULT = {"kind": "worn_battery", "strength": "strong"}
_EARLIER, _EARLIER_S = 8, 180.0
_DAY_US = 86_400_000_000
LAPTOP, PHONE = (1280, 800), (390, 844)
VIEWS = {
    "fleet": "#/",
    "car": "#/car/car2",
    "history": f"#/history/{_REAL}",
    "compare": "#/compare",
    "insights": f"#/insights/{_REAL}",
    "alarms": "#/alarms",
    "cloudwatch": "#/cloudwatch",
}
VIDEO, _SEEN, _HOLDS, _AHEAD_MS = "video", "car7", 20, 2_000
# A car that is driven by its camera's picture.
_SIGHT = {
    "sources": [{"type": "sim", "rate_hz": 50, "pace": 0.1}],
    "ping": {"rate_hz": 5},
    "video": {"source": {"type": "sim"}},
    "downlink": {
        "cmd": {
            "drive": {
                "topic": "/drive",
                "type": DRIVE_TYPE,
                "partial": True,
                "motion": {"lease_s": 0.5, "stop": {"drive": {"speed": 0.0}}},
            }
        },
        "drive": {"command": "drive", "speed": "drive.speed", "steering": "drive.steering_angle"},
    },
}
_PLOTTED = "speed_mps,current_motor,voltage_input"
_FILL_S = 65.0
_SETTLE_MS = 4_000
# The laps of a whole run, beside everything else.
_LAPS_MS = 90_000


def main() -> None:
    """Drive, look, and write one picture a view, theme and width; and what `iort plot` draws. An argument
    ``video`` takes only those of driving by sight."""
    with ExitStack() as stack:
        # Open the browser first: without it nothing else is needed.
        browser = stack.enter_context(chromium.opened())
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        embedded = stack.enter_context(EmbeddedCloud(folder / "local"))
        cloud = embedded.cloud
        _by_sight(browser, cloud, folder)
        if sys.argv[1:] == [VIDEO]:
            return
        stack.enter_context(_driving(embedded, folder))
        server = PageServer(
            namespace=cloud.namespace,
            **embedded.keys.reading(),
            vehicles={f"car{i + 1}": robots.F1TENTH for i in range(_FLEET + 2)},
            answers=answers(cloud, HALL),
            track=HALL,
            downloads=downloads(cloud),
            open_actions=actions(cloud),
            actions=keyed_actions(cloud),
        )
        stack.enter_context(server)
        pages = {
            "laptop": _page(browser, server.invitation(), LAPTOP, ratio=1),
            "phone": _page(browser, server.invitation(), PHONE, ratio=2),
        }
        # Wait until the charts are full and CloudWatch has a minute of metrics.
        threading.Event().wait(_FILL_S)
        _analyse(cloud)
        _plot(folder / "local" / CLOUD)
        for view, address in {**VIEWS, "compare": _compared(cloud)}.items():
            on_phone = "light" if view in {"car", "cloudwatch"} else "dark"
            for name, device, theme in (
                ("dark", "laptop", "dark"),
                ("light", "laptop", "light"),
                ("phone", "phone", on_phone),
            ):
                _look(pages[device], server.url + address, theme)
                _write(OUT / f"{view}-{name}.webp", pages[device].screenshot())


def _page(browser: Any, url: str, size: tuple[int, int], *, ratio: int) -> Any:
    width, height = size
    page = browser.new_page(
        viewport={"width": width, "height": height}, device_scale_factor=ratio, has_touch=ratio > 1
    )
    page.goto(url)
    return page


def _look(page: Any, address: str, theme: str) -> None:
    """Open another view of the same page, which keeps its data."""
    page.emulate_media(color_scheme=theme)
    page.goto(address)
    if "/history/" in address:
        _scrub(page)
    if "/compare" in address:
        page.wait_for_selector("#part-lap option:nth-child(2)", state="attached", timeout=_LAPS_MS)
    if address.endswith("/cloudwatch"):
        page.wait_for_selector("#dashboard option", state="attached")
        page.select_option("#minutes", "15")
        page.wait_for_selector(".widget canvas")
    page.wait_for_timeout(_SETTLE_MS)


def _scrub(page: Any) -> None:
    page.get_by_role("button", name="Last 1 min").click()
    page.wait_for_selector(".scrub")
    page.wait_for_timeout(2_000)
    slider = page.locator(".scrub")
    half = int(slider.get_attribute("max") or 0) * 6 // 10
    slider.evaluate(f"(node) => {{ node.value = {half}; node.dispatchEvent(new Event('input')) }}")


def _by_sight(browser: Any, cloud: Cloud, folder: Path) -> None:
    """Drive a car by its camera's picture, in each theme and width."""
    from playwright.sync_api import TimeoutError as LateError  # noqa: PLC0415 - only this command needs it

    bundle = robots.add(cloud, _SEEN, out=folder, settings=_SIGHT)
    server = PageServer(
        namespace=cloud.namespace,
        **motion.reaching(cloud, IOT),
        vehicles={_SEEN: robots.F1TENTH},
        answers=answers(cloud, HALL),
        track=HALL,
        open_actions=actions(cloud),
        actions=keyed_actions(cloud),
    )
    looks = ("dark", LAPTOP, 1, "dark"), ("light", LAPTOP, 1, "light"), ("phone", PHONE, 2, "dark")
    for name, size, ratio, theme in looks:
        # Each time from the start, where it sees along the track.
        with server, AgentProcess(bundle, drain_s=0.0):
            page = _page(browser, server.invitation(f"#/car/{_SEEN}"), size, ratio=ratio)
            page.emulate_media(color_scheme=theme)
            page.get_by_role("button", name="Take the wheel").click()
            page.wait_for_selector(".sight[data-state=live]")
            for _ in range(_HOLDS):
                page.keyboard.down("Space")
                with suppress(LateError):
                    page.wait_for_selector(".drive[data-phase=driving]", timeout=_SETTLE_MS)
                    break
                page.keyboard.up("Space")
            page.keyboard.down("ArrowUp")
            page.wait_for_timeout(_AHEAD_MS)
            page.locator(".sight").scroll_into_view_if_needed()
            _write(OUT / f"{VIDEO}-{name}.webp", page.screenshot())
            page.close()


@contextmanager
def _driving(cloud: EmbeddedCloud, folder: Path) -> Iterator[None]:
    """Run the real agent and the other cars until the block ends."""
    source = {"type": "sim", "rate_hz": 50, "duration_s": DRIVE_S * 3}
    settings = {"ping": {"rate_hz": 2}, "live": {"when": "always"}}
    bundles = [
        robots.add(cloud.cloud, name, out=folder, settings={**settings, "sources": [{**source, **more}]})
        for name, more in ((_REAL, {"faults": [_FAULT]}), (_HEALTHY, {}))
    ]
    cars = [SimulatedCar(f"car{i + 2}", i + 2, senses=i + 1 == _SENSES) for i in range(_FLEET)]
    stop = threading.Event()
    driving = threading.Thread(target=drive, args=(cars, cloud.keys, stop))
    events = [
        threading.Timer(30, lambda: setattr(cars[0], "fault_code", 4)),
        threading.Timer(32, lambda: setattr(cars[0], "fault_code", 0)),
        threading.Timer(50, lambda: setattr(cars[_FAULTY], "fault_code", 5)),
        threading.Timer(55, lambda: cars.pop(_STOPS)),
    ]
    with ExitStack() as agents:
        for bundle in bundles:
            agents.enter_context(AgentProcess(bundle, drain_s=0.0))
        driving.start()
        for event in events:
            event.start()
        try:
            yield
        finally:
            for event in events:
                event.cancel()
            stop.set()
            driving.join()


def _analyse(cloud: Cloud) -> None:
    """Analyse what the real car has driven so far, after simulated drives of the same car."""
    run = runs(cloud, _REAL, count=1)["runs"][0]
    streams = {}
    for name in (VESC_STREAM, POSE_STREAM):
        read = data.query(cloud, _REAL, name, run["from_us"], run["to_us"])
        streams[name] = Block(read.times_us, dict(read.columns))
    result = analyse(DriveKey(_REAL, run["from_us"], run["run"]), streams, F1TENTH)
    earlier = [
        analysed(
            replace(
                drive_of(2, number, seconds=_EARLIER_S),
                key=DriveKey(_REAL, run["from_us"] - (_EARLIER - number) * _DAY_US, f"{number:08x}"),
                vehicle=VehicleConfig(charge=0.97 - number / 100),
            )
        ).result
        for number in range(_EARLIER)
    ]
    table = findings.findings_table(cloud)
    for one in (*earlier, result):
        mined = one.mined
        table.put_drive(
            AnalysedDrive(
                one.drive, one.end_us, "screenshots", one.samples, mined.estimates, mined.missing, one.repairs
            )
        )
    for finding in evaluate([result], [one.measured for one in earlier], []):
        table.put_finding(finding)


def _compared(cloud: Cloud) -> str:
    """The address of the real car's first and last complete lap, over distance."""
    (run,) = laps_of_runs(cloud, _REAL, None, None, count=1)
    laps = run.mined.tables["laps"]
    parts = []
    for row in (0, -1):
        start_us = int(laps["start_us"][row])
        parts.append(f"{_REAL}/{iso(start_us)}/{iso(start_us + int(laps['time_s'][row] * 1e6))}")
    return f"#/compare?runs={','.join(parts)}&stream={VESC_STREAM}&x=distance"


def _plot(cloud: Path) -> None:
    """Have `iort plot` draw the two real cars."""
    iort = str(Path(sys.executable).with_name("iort"))
    what = ["plot", _HEALTHY, VESC_STREAM, "--with", _REAL, "--last", "1m", "--fields", _PLOTTED]
    out = ["--force", "--out", str(OUT / "plot.png")]
    subprocess.run([iort, "--embedded", str(cloud), *what, *out], check=True)


def _write(path: Path, png: bytes) -> None:
    """Write the picture without loss, in half the bytes."""
    from PIL import Image  # noqa: PLC0415 - only this command needs it

    with Image.open(io.BytesIO(png)) as image:
        image.save(path, lossless=True, method=6)


if __name__ == "__main__":
    main()
