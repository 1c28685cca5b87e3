"""The bridge beside the page's own link: the delay from a sample to a viewer, and the bridge's processor time
a message, of one car at the live lane's full rate."""

from __future__ import annotations

import asyncio
import json
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

from aiohttp import ClientSession, WSMsgType

from bench.report import Report, Section, spread, text
from bench.sections import Declared, Option
from bench.sections.command import options_of
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.limits import LIVE_MAX_RATE_HZ
from iort_contract.messages.live import decode_live
from iort_contract.topics import LIVE
from iort_station.fleet import viewing
from iort_station.fleet.broker import Broker
from iort_station.fleet.roles import Role
from testkit import machine
from testkit.car import AgentProcess
from testkit.target import Say, Target
from testkit.waiting import until

_WARM_UP_S = 3.0
_TOPIC = f"/iort/{VESC_STREAM}"
_WAYS = {"link": "the page's link: MQTT 5 over WebSocket", "bridge": "`iort bridge`, Foxglove's protocol"}


class _Heard:
    """When messages came, by their samples' times, in microseconds."""

    def __init__(self) -> None:
        self.here_us: dict[str, dict[int, int]] = {way: {} for way in _WAYS}

    def take(self, way: str, t_us: int) -> None:
        self.here_us[way].setdefault(t_us, time.time_ns() // 1000)


def run(target: Target, say: Say, *, seconds: float) -> Section:
    """Drive one car at 50 Hz, and listen both ways at once."""
    source = {"type": "sim", "stream": VESC_STREAM, "rate_hz": 50, "pose": {"rate_hz": 0}}
    robot = target.robot("bench-bridge", sources=[source])
    heard, cloud = _Heard(), target.cloud
    link = Broker(
        cloud,
        Role(cloud),
        filters=[f"{LIVE}/{cloud.namespace}/{robot.robot}/{VESC_STREAM}"],
        on_message=lambda _, message: heard.take("link", decode_live(message).t_us),
    )
    with link, AgentProcess(robot), viewing.Viewer(cloud, [robot.robot], broker=True):
        until(lambda: heard.here_us["link"], "the first live message")
        with _bridge(target, robot.robot) as (bridge, url), _client(url, heard):
            until(lambda: heard.here_us["bridge"], "the first message of the bridge")
            threading.Event().wait(_WARM_UP_S)
            say(f"both ways side by side for {seconds:g} s")
            began_us, cpu_s = time.time_ns() // 1000, machine.usage_of(bridge.pid).cpu_s
            threading.Event().wait(seconds)
            ended_us, used_s = time.time_ns() // 1000, machine.usage_of(bridge.pid).cpu_s - cpu_s
            rss_mb = machine.usage_of(bridge.pid).rss_mb
    both = heard.here_us["link"].keys() & heard.here_us["bridge"].keys()
    within = [t_us for t_us in sorted(both) if began_us < heard.here_us["bridge"][t_us] <= ended_us]
    delays = {way: [(heard.here_us[way][t_us] - t_us) / 1000 for t_us in within] for way in _WAYS}
    return report(delays, used_s, rss_mb, seconds)


@contextmanager
def _bridge(target: Target, robot: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    iort = [str(Path(sys.executable).parent / "iort"), *options_of(target)]
    command = [*iort, "bridge", robot, "--live", "iot", "--port", "0", "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            yield process, json.loads(process.stdout.readline())["url"]
        finally:
            process.terminate()


@contextmanager
def _client(url: str, heard: _Heard) -> Iterator[None]:
    """A client that subscribes to the car's VESC."""
    loop = asyncio.new_event_loop()

    async def listen() -> None:
        async with (
            ClientSession() as session,
            session.ws_connect(url, protocols=["foxglove.sdk.v1"]) as client,
        ):
            async for message in client:
                if message.type is WSMsgType.BINARY and message.data[0] == 1:
                    heard.take("bridge", struct.unpack_from("<Q", message.data, 5)[0] // 1000)
                elif (
                    message.type is WSMsgType.TEXT and (told := json.loads(message.data))["op"] == "advertise"
                ):
                    ids = [one["id"] for one in told["channels"] if one["topic"] == _TOPIC]
                    wanted = [{"id": one, "channelId": one} for one in ids]
                    await client.send_json({"op": "subscribe", "subscriptions": wanted})

    task = loop.create_task(listen())
    thread = threading.Thread(target=loop.run_until_complete, args=(asyncio.wait([task]),))
    thread.start()
    try:
        yield
    finally:
        loop.call_soon_threadsafe(task.cancel)
        thread.join()
        loop.close()


def report(delays: dict[str, list[float]], used_s: float, rss_mb: float, seconds: float) -> Section:
    """Make the section of the delays and the processor time."""
    count = len(delays["bridge"])
    section = Section("bridge", "The bridge beside the page's link")
    section.table(
        f"One car's VESC at {LIVE_MAX_RATE_HZ:g} Hz, the same messages both ways",
        ["way", "from the sample to the viewer"],
        [[name, text([delays[way]], digits=1)] for way, name in _WAYS.items()],
    )
    section.table(
        "The bridge's process",
        ["messages", "processor time a message", "share of a processor", "memory"],
        [
            [
                f"{count}",
                f"{used_s / max(1, count) * 1000:.2f} ms",
                f"{used_s / seconds:.1%}",
                f"{rss_mb:.0f} MB",
            ]
        ],
    )
    added = [there - here for here, there in zip(delays["link"], delays["bridge"], strict=True)]
    p95 = spread([added]).p95
    section.ratio("added by the bridge, p95", p95, 50.0, unit="ms", tolerance=2.5, by_machine=True)
    section.ratio("share of a processor", used_s / seconds, 0.1, tolerance=2.5, by_machine=True)
    section.raw = {"delay_ms": {way: asdict(spread([of])) for way, of in delays.items()}, "cpu_s": used_s}
    return section


SECTION = Declared(
    "the bridge's delay and processor time, beside the page's link",
    run,
    (Option("SECONDS", float, 30.0, "of both ways side by side"),),
    Report("bridge", "The bridge beside the page's link", "make bench ONLY=bridge"),
    dollars=0.001,
)
