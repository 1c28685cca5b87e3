"""A car with a camera, for pages: the agent's own video over a page's broker, with pictures that have their
numbers."""

from __future__ import annotations

import itertools
import json
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

from typing_extensions import Self

from iort_agent.common.threads import SystemClock
from iort_agent.mqtt.rate_limiter import RateLimiter
from iort_agent.mqtt.uplink import Link, MqttMessage, OnMessage, Uplink, matches
from iort_agent.video import Frame, Pictures
from iort_agent.video.video import Video
from iort_contract.catalog.streams import DRIVE_STREAM
from iort_contract.messages.live import LiveSample, encode_live
from iort_contract.messages.video import Show, decode_show, encode_show
from iort_contract.topics import CMD, LIVE, build_topic
from tests.unit.agent.video.rig import CONFIG, drawn
from tests.web.broker import PageBroker
from tests.web.cars import SAMPLE

RATE_HZ = 10.0
# A busy machine may be slow: what is late here is late by a test's own doing.
_CONFIG = replace(CONFIG, rate_hz=RATE_HZ, max_age_ms=4_000)
TERMS = _CONFIG.terms()


def refusing(show: Show) -> Show:
    """The answers of a car without WebRTC."""
    return Show(show.request, "refused", why="this car has no WebRTC") if show.sdp else show


def unreachable(show: Show) -> Show:
    """The answers of a car whose addresses do not reach the viewer: no connection comes about."""
    return replace(show, sdp="".join(s for s in show.sdp.splitlines(keepends=True) if "candidate" not in s))


class CameraCar:
    """Runs within its ``with`` block. Its camera takes pictures while ``sees`` is set, each as if it were
    ``late_us`` old. ``change`` changes its answers to viewers. It accepts every command, and says so."""

    def __init__(self, broker: PageBroker, robot: str = "car-1") -> None:
        self.robot, self._broker = robot, broker
        self.change: Callable[[Show], Show] = lambda show: show
        self.sees = threading.Event()
        self.sees.set()
        self.late_us = 0
        self.commands: list[dict[str, Any]] = []
        self.answers: list[tuple[str, bytes]] = []
        self._handlers: list[tuple[str, OnMessage]] = []
        self._seq = itertools.count()
        self._clock = SystemClock()
        self._ended = threading.Event()
        link = Link(robot, "iort", cast("Uplink", self), self._clock, RateLimiter(self._clock))
        self.video = Video(_CONFIG, link, Pictures(), camera=lambda: lambda: self, record=lambda *_: None)
        self._lives = threading.Thread(target=self._live, daemon=True)
        broker.on_publish.append(self._take)

    @property
    def viewers(self) -> tuple[int, int]:
        """How many look by WebRTC, and how many at pictures over the broker."""
        report = self.video.report()
        return report["viewers"], report["watchers"]

    def __enter__(self) -> Self:
        self.video.start()
        self._lives.start()
        return self

    def __exit__(self, *_error: object) -> None:
        self._ended.set()
        self.video.close()
        self._lives.join()

    # Its uplink.

    def subscribe(self, topic_filter: str, handler: OnMessage) -> None:
        self._handlers.append((topic_filter, handler))

    def publish(self, topic: str, payload: bytes, **_: object) -> None:
        if "/to-" in topic:
            payload = encode_show(self.change(decode_show(payload)))
            self.answers.append((topic, payload))
        self._broker.publish(topic, payload)

    # Its camera.

    def open(self) -> None:
        return

    def read(self, number: int, stop: threading.Event) -> Frame | None:
        if stop.wait(1 / RATE_HZ):
            return None
        while not self.sees.wait(0.02):
            if stop.is_set():
                return None
        captured_us = self._clock.now_us() - self.late_us
        return Frame(number, captured_us, self._clock.monotonic() - self.late_us / 1e6, drawn(number))

    def report(self) -> dict[str, Any]:
        return {}

    def close(self) -> None:
        return

    # Its commands and live messages.

    def _take(self, topic: str, payload: bytes) -> None:
        for topic_filter, handler in self._handlers:
            if matches(topic_filter, topic):
                handler(MqttMessage(topic, payload, self._clock.monotonic()))
        if topic.startswith(f"{CMD}/iort/{self.robot}/"):
            command = json.loads(payload)
            self.commands.append(command)
            session, by = (None, None) if command.get("ends") else (command["session"], command["by"])
            same = {name: command.get(name) for name in ("session", "seq", "by", "sent_us", "frame", "blind")}
            left_ms = 450 if session else 0
            driver = {"driver": session, "driver_by": by, "lease_left_ms": left_ms}
            self._say(DRIVE_STREAM, {**same, "outcome": "accepted", **driver})

    def _live(self) -> None:
        while not self._ended.wait(0.05):
            self._say("vesc", SAMPLE)

    def _say(self, stream: str, sample: dict[str, Any]) -> None:
        now_us = self._clock.now_us()
        live = LiveSample("0a1b2c3d", next(self._seq), now_us, now_us, sample, offset_us=0)
        self._broker.publish(build_topic(LIVE, self.robot, stream, "iort"), encode_live(live))
