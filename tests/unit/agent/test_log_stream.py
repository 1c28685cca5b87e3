"""The agent's own warnings and errors as a stream: which ones, how many, and without secrets."""

from __future__ import annotations

import logging
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Iterator

import pytest

from iort_agent.agent import Agent
from iort_agent.common.logs import Troubles
from iort_agent.config import Config
from iort_agent.errors import SourceError
from iort_agent.mqtt.dispatch import Dispatcher
from iort_agent.runtime import Runtime
from iort_agent.sources import Emit, SourceConfig
from iort_agent.spool import REJECT_NEW
from iort_agent.spool.memory import MemorySpool
from iort_contract.catalog.streams import CATALOG, LOG_STREAM
from iort_contract.messages.batch import decode_batch
from iort_contract.messages.live import decode_live
from iort_contract.topics import LIVE, RECORD, build_topic
from testkit.agent import Loopback, ManualClock

T0_S = 1_700_000_000.0


def said(
    troubles: Troubles, *lines: str, level: int = logging.WARNING, at_s: float = T0_S, **more: Any
) -> None:
    for line in lines:
        record = logging.LogRecord("iort_agent.mqtt.aws", level, __file__, 1, line, None, None)
        record.created = at_s
        for name, value in more.items():
            setattr(record, name, value)
        troubles.handle(record)


def test_a_line_is_a_sample_of_the_catalogue() -> None:
    troubles = Troubles()
    said(troubles, "connection lost")
    ((t_us, line),) = troubles.lines.take()
    assert (t_us, line) == (
        round(T0_S * 1e6),
        {"level": "warning", "logger": "iort_agent.mqtt.aws", "text": "connection lost", "left_out": 0},
    )
    assert list(line) == [field.name for field in CATALOG[LOG_STREAM].fields]
    assert troubles.lines.take() == []


def test_a_flood_is_counted_and_does_not_displace_an_error() -> None:
    troubles = Troubles()
    said(troubles, *(f"warning {i}" for i in range(1000)))
    said(troubles, "the one that matters", level=logging.ERROR)
    lines = [line for _, line in troubles.lines.take()]
    assert [line["text"] for line in lines] == [*(f"warning {i}" for i in range(20)), "the one that matters"]
    assert lines[-1]["left_out"] == 980
    said(troubles, *("again",) * 1000, at_s=T0_S + 60)
    assert len(troubles.lines.take()) == 20
    # The wall clock was set back.
    said(troubles, "before", at_s=0.0)
    assert troubles.lines.take() == []


@pytest.mark.parametrize(
    ("text", "sent"),
    [
        ("ws://lab:hunter2@10.0.0.1:9090: closed", "ws://...@10.0.0.1:9090: closed"),
        ("ws://lab:p@ss@10.0.0.1: closed", "ws://...@10.0.0.1: closed"),
        ("https://b.s3.aws.com/a.txt?X-Amz-Signature=0f&b=1 failed", "https://b.s3.aws.com/a.txt?... failed"),
        ("why? no idea", "why? no idea"),
        ("two\nlines", "two\\nlines"),
        ("x" * 5000, "x" * 997 + "..."),
    ],
)
def test_a_line_is_short_and_has_no_secrets(text: str, sent: str) -> None:
    troubles = Troubles()
    said(troubles, text)
    assert troubles.lines.take()[0][1]["text"] == sent


def test_an_exception_is_told_without_its_traceback() -> None:
    troubles = Troubles()
    error = ValueError("must be a number")
    said(troubles, "source failed", level=logging.ERROR, exc_info=(ValueError, error, None))
    assert troubles.lines.take()[0][1]["text"] == "source failed: ValueError: must be a number"


def test_other_librarys_lines_stay_in_the_robots_own_log() -> None:
    troubles = Troubles()
    said(troubles, "their business", name="rospy")
    assert troubles.lines.take() == []


class Failing(SourceConfig):
    def streams(self) -> list[str]:
        return ["vesc"]

    def describe(self) -> str:
        return "failing"

    def build(self, _clock: object) -> Failing:
        return self

    def report(self) -> dict[str, Any]:
        return {}

    def run(self, _emit: Emit, _stop: object) -> None:
        raise SourceError("the device is gone")


@contextmanager
def logging_agent(uplink: Loopback, clock: ManualClock) -> Iterator[Agent]:
    """An agent whose only source fails, and which sends what is logged."""
    troubles = Troubles()
    spool = MemorySpool(max_bytes=2000, policy=REJECT_NEW)
    config = Config("car1", "host", Path(), Path(), (Failing(),))
    logging.getLogger().addHandler(troubles)
    try:
        yield Agent(config, uplink=uplink, spool=spool, clock=clock, troubles=troubles)
    finally:
        logging.getLogger().removeHandler(troubles)


def payloads(uplink: Loopback, lane: str) -> list[bytes]:
    return [m.payload for m in uplink.published if m.topic.endswith(build_topic(lane, "car1", LOG_STREAM))]


def recorded(uplink: Loopback) -> list[Any]:
    return [text for one in payloads(uplink, RECORD) for text in decode_batch(one).columns["text"]]


def test_a_line_is_live_at_once_and_recorded() -> None:
    clock = ManualClock()
    uplink = Loopback(clock, Dispatcher())
    with logging_agent(uplink, clock) as agent:
        uplink.start()
        logging.getLogger("iort_agent.x").warning("the first")
        Runtime(agent).tick()
        (live,) = payloads(uplink, LIVE)
        assert decode_live(live).sample["text"] == "the first"
        agent.streams.flush()
        agent.record.step()
        assert recorded(uplink) == ["the first"]
        uplink.stop(10)


def test_the_last_line_of_a_run_is_recorded() -> None:
    clock = ManualClock()
    uplink = Loopback(clock, Dispatcher())
    with logging_agent(uplink, clock) as agent:
        assert Runtime(agent).run(drain_s=10) == 1
    assert recorded(uplink) == ["source failed: failing: the device is gone"]


def test_a_failing_link_adds_few_lines() -> None:
    clock, dispatcher = ManualClock(), Dispatcher()
    uplink = Loopback(clock, dispatcher)
    uplink.verdict = lambda message: "no" if message.qos else None
    with logging_agent(uplink, clock) as agent:
        runtime = Runtime(agent)
        uplink.connect()
        logging.getLogger("iort_agent.x").warning("the first")
        for _ in range(3000):
            clock.advance(0.2)
            runtime.tick()
            agent.record.step()
            dispatcher.run_pending()
    # Each refusal of a batch of lines is a warning, too.
    assert 2 < agent.streams.counts()[LOG_STREAM].samples <= 20
