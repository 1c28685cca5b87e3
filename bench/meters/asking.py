"""Asks questions as the agent does, over a connection of its own."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from bench.errors import BenchError
from bench.meters.round_trips import Connected
from iort_agent.common.state import ClockOffset
from iort_agent.control.questions import Questions
from iort_agent.errors import AskError
from iort_agent.files.upload import downloader, make_uploader
from iort_contract.messages.requests.ask import NO_DATA
from iort_station.fleet.robots import Bundle

_WAIT_S = 60.0
# Asks by name and body; raises `AskError`.
Ask = Callable[[str, Mapping[str, Any]], Mapping[str, Any]]


@contextmanager
def asking(bundle: Bundle) -> Iterator[Ask]:
    """A connected robot that asks. Its clock is the cloud's."""
    with Connected(bundle) as robot:
        link, config = robot.link(), robot.config
        uploader = make_uploader(link, root_ca=config.root_ca, rate_kb_s=0)
        offset = ClockOffset(0.0, 1.0)
        questions = Questions(link, uploader, download=downloader(config.root_ca), offset=lambda: offset)
        deadline, pause = time.monotonic() + _WAIT_S, threading.Event()
        while not questions.ready():
            if time.monotonic() > deadline:
                raise BenchError(f"{config.robot} did not hear its answers within {_WAIT_S:g} s")
            pause.wait(0.02)  # the uplink gives no notice of it
        yield lambda name, body: questions.ask(name, body, _WAIT_S)


def round_trips_ms(ask: Ask, name: str, *, count: int, rate_hz: float) -> list[float]:
    """The round trips of a question, in milliseconds, also where the cloud has no data for an answer."""
    values, pause, began = [], threading.Event(), time.perf_counter()
    for number in range(count):
        pause.wait(max(0.0, began + number / rate_hz - time.perf_counter()))
        sent = time.perf_counter()
        try:
            ask(name, {})
        except AskError as error:
            if error.reason != NO_DATA:
                raise BenchError(f"the question {name} was refused: {error}") from error
        values.append((time.perf_counter() - sent) * 1000)
    return values
