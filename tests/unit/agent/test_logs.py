"""The agent's log: its lines, the latest ones for the status, and its own ones as a stream."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Iterator

import pytest

from iort_agent.agent import Agent
from iort_agent.common.logs import JournalFormatter, LineFormatter, Troubles, is_journal, set_level
from iort_agent.config import Config
from iort_agent.errors import SourceError
from iort_agent.mqtt.dispatch import Dispatcher
from iort_agent.runtime import Runtime
from iort_agent.spool import REJECT_NEW
from iort_contract.catalog.streams import CATALOG, LOG_STREAM
from iort_contract.messages.batch import decode_batch
from iort_contract.messages.live import decode_live
from iort_contract.topics import LIVE, RECORD, build_topic
from testkit.agent import Loopback, ManualClock, MemorySpool
from tests.unit.agent.test_agent import Script

T0_S = 1_700_000_000.0
HOSTILE = "refused\n<3>forged\r\x1b]52;c;cm0=\x07 \x9b2J \u202e\u2028\udc80 Straße"


def record(level: int, text: str, at_s: float = T0_S, **more: Any) -> logging.LogRecord:
    made = logging.LogRecord("iort_agent.mqtt.aws", level, __file__, 1, text, None, None)
    vars(made).update(created=at_s, **more)
    return made


def said(
    *lines: str, level: int = logging.WARNING, troubles: Troubles | None = None, **more: Any
) -> Troubles:
    troubles = troubles or Troubles()
    for line in lines:
        troubles.handle(record(level, line, **more))
    return troubles


@pytest.mark.parametrize(
    ("level", "prefix"),
    [(logging.ERROR, "<3>"), (logging.WARNING, "<4>"), (logging.INFO, "<6>"), (10, "<7>")],
)
def test_journald_reads_the_level_of_every_line(level: int, prefix: str) -> None:
    failed = record(level, "a")
    error = ValueError("one\ntwo")
    failed.exc_info = (ValueError, error, None)
    lines = JournalFormatter("%(message)s").format(failed).split("\n")
    assert lines[0] == f"{prefix}a"
    assert all(line.startswith(f"{prefix}  ") for line in lines[1:])
    assert lines[-2:] == [f"{prefix}  ValueError: one", f"{prefix}  two"]


def test_foreign_text_cannot_start_a_line_or_control_the_terminal() -> None:
    shown = r"refused\n<3>forged\r\x1b]52;c;cm0=\x07 \x9b2J \u202e\u2028\udc80 Straße"
    said = record(logging.WARNING, HOSTILE)
    assert JournalFormatter("%(message)s").format(said) == f"<4>{shown}"
    assert LineFormatter("%(message)s").format(said) == shown
    troubles = Troubles()
    troubles.emit(said)
    assert troubles.last()[0].text == shown
    # With the agent's set-up, for any logger.
    set_up = "import logging; from iort_agent.common.logs import set_up; set_up('info')"
    program = f"{set_up}; logging.warning({HOSTILE!r})"
    command = [sys.executable, "-X", "utf8", "-c", program]
    done = subprocess.run(command, capture_output=True, encoding="utf-8", check=True)
    assert done.stderr.count("\n") == 1
    assert done.stderr.endswith(f"WARNING {shown}\n")


def test_the_journal_is_recognized_by_its_stream(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with (tmp_path / "journal").open("w") as file:
        monkeypatch.setattr(sys, "stderr", file)
        status = os.fstat(file.fileno())
        monkeypatch.setenv("JOURNAL_STREAM", f"{status.st_dev}:{status.st_ino}")
        assert is_journal()
        monkeypatch.setenv("JOURNAL_STREAM", f"{status.st_dev}:{status.st_ino + 1}")
        assert not is_journal()


@pytest.mark.parametrize(("level", "told"), [("info", False), ("debug", True)])
def test_a_viewers_addresses_are_told_to_who_debugs_alone(level: str, told: bool) -> None:
    root = logging.getLogger()
    before = root.level
    try:
        set_level(level)
        assert logging.getLogger("aioice.ice").isEnabledFor(logging.INFO) == told
        assert logging.getLogger("aioice.ice").isEnabledFor(logging.WARNING)
    finally:
        root.setLevel(before)
        logging.getLogger("aioice").setLevel(logging.NOTSET)


def test_the_last_troubles_are_kept_and_warnings_do_not_displace_errors() -> None:
    troubles = said("the one that matters", level=logging.ERROR)
    said(*(f"trouble {i}" for i in range(9)), troubles=troubles, at_s=T0_S + 1)
    kept = [(line.level, line.text) for line in troubles.last()]
    assert kept == [("error", "the one that matters"), *(("warning", f"trouble {i}") for i in range(4, 9))]


def test_a_line_is_a_sample_of_the_catalogue() -> None:
    troubles = said("connection lost")
    ((t_us, line),) = troubles.lines.take()
    assert (t_us, line) == (
        round(T0_S * 1e6),
        {"level": "warning", "logger": "iort_agent.mqtt.aws", "text": "connection lost", "left_out": 0},
    )
    assert list(line) == [field.name for field in CATALOG[LOG_STREAM].fields]
    assert troubles.lines.take() == []


def test_a_flood_is_counted_and_does_not_displace_an_error() -> None:
    troubles = said(*(f"warning {i}" for i in range(1000)))
    said("the one that matters", level=logging.ERROR, troubles=troubles)
    lines = [line for _, line in troubles.lines.take()]
    assert [line["text"] for line in lines] == [*(f"warning {i}" for i in range(20)), "the one that matters"]
    assert lines[-1]["left_out"] == 980
    said(*("again",) * 1000, at_s=T0_S + 60, troubles=troubles)
    assert len(troubles.lines.take()) == 20
    # The wall clock was set back.
    said("before", at_s=0.0, troubles=troubles)
    assert troubles.lines.take() == []


@pytest.mark.parametrize(
    ("text", "more", "sent"),
    [
        ("ws://lab:hunter2@10.0.0.1:9090: closed", {}, ["ws://...@10.0.0.1:9090: closed"]),
        ("ws://lab:p@ss@10.0.0.1: closed", {}, ["ws://...@10.0.0.1: closed"]),
        ("https://b.s3.aws.com/a.txt?X-Amz-Signature=0f&b=1 no", {}, ["https://b.s3.aws.com/a.txt?... no"]),
        ("why? no idea", {}, ["why? no idea"]),
        ("two\nlines", {}, ["two\\nlines"]),
        ("x" * 5000, {}, ["x" * 997 + "..."]),
        # Without its traceback.
        (
            "failed",
            {"exc_info": (ValueError, ValueError("no number"), None)},
            ["failed: ValueError: no number"],
        ),
        # Other libraries' lines stay in the robot's own log.
        ("their business", {"name": "rospy"}, []),
    ],
)
def test_a_line_that_is_sent_is_the_agents_own_short_and_has_no_secrets(
    text: str, more: dict[str, Any], sent: list[str]
) -> None:
    assert [line["text"] for _, line in said(text, **more).lines.take()] == sent


def fail(*_: object) -> None:
    raise SourceError("the device is gone")


@contextmanager
def logging_agent(uplink: Loopback, clock: ManualClock) -> Iterator[Agent]:
    """An agent whose only source fails, and which sends what is logged."""
    troubles = Troubles()
    spool = MemorySpool(max_bytes=2000, policy=REJECT_NEW)
    config = Config("car1", "host", Path(), Path(), (Script(fail),))
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
        Runtime(agent).tick_slowly()
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
    assert recorded(uplink) == ["source failed: script: the device is gone"]


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
            runtime.tick_slowly()
            agent.record.step()
            dispatcher.run_pending()
    # Each refusal of a batch of lines is a warning, too.
    assert 2 < agent.streams.counts()[LOG_STREAM].samples <= 20
