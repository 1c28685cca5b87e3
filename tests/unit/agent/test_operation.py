"""What the agent reports about itself: logs, metrics, clock offset, status."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import random
import stat
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from iort_agent import status as status_server
from iort_agent.cli import main
from iort_agent.common.logs import JournalFormatter, LineFormatter, Troubles, is_journal
from iort_agent.common.state import Status, read
from iort_agent.common.threads import SystemClock
from iort_agent.config import load_config
from iort_agent.errors import AgentError, BusyError, NotRunningError
from iort_agent.lanes.pings import OffsetEstimator
from iort_agent.lanes.streams import StreamCounts
from iort_agent.metrics import AgentMetrics, Rates, rss_mb
from iort_agent.mqtt.dispatch import Dispatcher
from iort_agent.sources import FAIL, OK, WARN
from iort_agent.spool.memory import MemorySpool
from iort_agent.spool.sqlite import make_spool
from iort_agent.status import StatusServer, ask, fetch, render
from iort_agent.verbs.check import check, emergency_stop
from iort_contract.catalog.streams import AGENT_FIELDS
from iort_contract.limits import CLOCK_MAX_UNCERTAINTY_MS
from iort_contract.messages.control.driving import stick_downlink
from testkit.agent import Loopback, ManualClock


def record(level: int, text: str) -> logging.LogRecord:
    return logging.LogRecord("x", level, "f", 1, text, (), None)


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


HOSTILE = "refused\n<3>forged\r\x1b]52;c;cm0=\x07 \x9b2J \u202e\u2028\udc80 Straße"


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


def test_the_last_troubles_are_kept() -> None:
    troubles = Troubles()
    for i in range(9):
        troubles.handle(record(logging.WARNING, f"trouble {i}"))
    assert [line.text for line in troubles.last()] == [f"trouble {i}" for i in range(4, 9)]


def test_warnings_do_not_displace_errors() -> None:
    troubles = Troubles()
    troubles.handle(record(logging.ERROR, "the one that matters"))
    for i in range(9):
        troubles.handle(record(logging.WARNING, f"trouble {i}"))
    kept = [(line.level, line.text) for line in troubles.last()]
    assert kept == [("error", "the one that matters"), *(("warning", f"trouble {i}") for i in range(4, 9))]


@given(
    st.floats(-1e7, 1e7), st.lists(st.tuples(st.floats(0.2, 500), st.floats(0, 1)), min_size=1), st.randoms()
)
def test_the_offset_is_within_its_uncertainty(
    true_ms: float, trips: list[tuple[float, float]], chance: random.Random
) -> None:
    clock = ManualClock()
    offset = OffsetEstimator(clock)
    for trip_ms, share in trips:
        sent = clock.monotonic()
        # The cloud stamps in whole milliseconds, at any time on the way.
        stamp_ms = int(clock.now_us() / 1000 + trip_ms * share + true_ms)
        clock.advance(trip_ms / 1000)
        offset.add(sent, clock.monotonic(), stamp_ms)
        clock.advance(chance.random())
    found = offset.estimate()
    assert found is not None
    assert abs(found.offset_ms - true_ms) <= found.uncertainty_ms + 0.51
    assert found.uncertainty_ms >= min(trip_ms for trip_ms, _ in trips) / 2


def test_the_offset_is_right_at_once_after_the_clock_is_set() -> None:
    clock = ManualClock()
    offset = OffsetEstimator(clock)
    assert offset.estimate() is None
    sent = clock.monotonic()
    clock.advance(0.01)
    offset.add(sent, clock.monotonic(), clock.now_us() // 1000 - 5)
    before = offset.estimate()
    clock.set_wall(clock.now_us() - 3_600_000_000)
    after = offset.estimate()
    assert before is not None
    assert after is not None
    assert after.offset_ms - before.offset_ms == pytest.approx(3_600_000)


def test_the_shortest_round_trip_is_used_until_it_is_old() -> None:
    clock = ManualClock()
    offset = OffsetEstimator(clock)
    for trip_ms in (10, 2, 200):
        sent = clock.monotonic()
        clock.advance(trip_ms / 1000)
        offset.add(sent, clock.monotonic(), clock.now_us() // 1000)
    found = offset.estimate()
    assert found is not None
    assert found.uncertainty_ms == pytest.approx(1.5, abs=0.02)
    clock.advance(60)
    aged = offset.estimate()
    assert aged is not None
    assert aged.uncertainty_ms == pytest.approx(4.5, abs=0.02), "the clocks may have drifted by 3 ms"


def test_an_uncertain_offset_is_not_used() -> None:
    clock = ManualClock()
    offset = OffsetEstimator(clock)
    assert offset.known_us() is None
    for trip_s, known in ((1.5, False), (0.9, True), (8, True)):
        sent = clock.monotonic()
        stamp_ms = clock.now_us() // 1000 + 60_000
        clock.advance(trip_s)
        offset.add(sent, clock.monotonic(), stamp_ms)
        assert (offset.known_us() is not None) == known
    known_us = offset.known_us()
    assert known_us is not None
    assert abs(known_us - 60_000_000) <= CLOCK_MAX_UNCERTAINTY_MS * 1000
    clock.advance(86_400)
    assert offset.known_us() is None, "two oscillators drift apart"


def test_a_contradicting_round_trip_replaces_the_best_one() -> None:
    """While a computer sleeps, its monotonic clock stops and its wall clock goes on."""
    clock = ManualClock()
    offset = OffsetEstimator(clock)
    slept_us = 0
    for trip_s in (0.002, 0.3):
        sent = clock.monotonic()
        clock.advance(trip_s)
        offset.add(sent, clock.monotonic(), (clock.now_us() + slept_us) // 1000)
        slept_us += 600_000_000
    found = offset.estimate()
    assert found is not None
    assert found.offset_ms == pytest.approx(600_000, abs=found.uncertainty_ms)


def test_a_sample_of_the_agent_has_the_contracts_fields() -> None:
    clock = ManualClock()
    spool, uplink = MemorySpool(max_bytes=1000), Loopback(clock, Dispatcher())
    metrics = AgentMetrics(clock=clock, spool=spool, uplink=uplink, offset=OffsetEstimator(clock))
    spool.put("vesc", "0badcafe", 0, b"x" * 100, samples=1)
    uplink.connect()
    clock.advance(2)
    values = metrics.sample(100)
    assert list(values) == list(AGENT_FIELDS)
    assert values["samples_per_s"] == 50
    assert (values["backlog_batches"], values["backlog_bytes"], values["connects"]) == (1, 100, 1)
    assert values["clock_offset_ms"] is None
    clock.advance(1)
    assert metrics.sample(100)["samples_per_s"] == 0
    assert 1 < rss_mb() < 10_000


def test_rates_and_silence() -> None:
    clock = ManualClock()
    rates, counts = Rates(clock), {"vesc": StreamCounts(samples=0)}
    counts["vesc"].samples = 50
    clock.advance(1)
    rates.update(counts)
    assert (rates.per_s["vesc"], rates.silent_s("vesc")) == (50, 0)
    for _ in range(7):
        clock.advance(1)
        rates.update(counts)
    assert (rates.per_s["vesc"], rates.silent_s("vesc")) == (0, 7)


def test_only_the_owner_may_open_the_socket_and_it_is_removed_at_the_end(tmp_path: Path) -> None:
    path = tmp_path / "agent.sock"
    server = StatusServer(path, lambda: {"pid": 7})
    before = os.umask(0)
    try:
        server.start()
    finally:
        os.umask(before)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert fetch(path) == fetch(path) == {"pid": 7}
    second = StatusServer(path, dict)
    with pytest.raises(AgentError, match=r"already running.*process 7"):
        second.start()
    server.stop()
    assert not path.exists()
    with pytest.raises(AgentError, match="no agent is running"):
        fetch(path)


def test_a_status_of_another_version_is_not_a_stopped_agent(tmp_path: Path) -> None:
    path = tmp_path / "agent.sock"
    server = StatusServer(path, lambda: {"pid": 7})
    server.start()
    try:
        with pytest.raises(AgentError, match="of another version") as raised:
            ask(path)
        assert not isinstance(raised.value, NotRunningError)
    finally:
        server.stop()


def test_a_long_path_works(tmp_path: Path) -> None:
    folder = tmp_path / ("x" * 100)
    folder.mkdir()
    server = StatusServer(folder / "agent.sock", lambda: {"pid": 1})
    server.start()
    assert fetch(folder / "agent.sock") == {"pid": 1}
    server.stop()
    assert not list(folder.iterdir())


def test_the_socket_of_a_killed_agent_is_replaced(tmp_path: Path) -> None:
    import socket

    path = tmp_path / "agent.sock"
    with socket.socket(socket.AF_UNIX) as left:
        left.bind(str(path))
    server = StatusServer(path, lambda: {"pid": 1})
    server.start()
    assert fetch(path) == {"pid": 1}
    server.stop()


def test_an_agent_that_is_too_busy_to_answer_is_no_stopped_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import socket

    monkeypatch.setattr(status_server, "_TIMEOUT_S", 0.01)
    path = tmp_path / "agent.sock"
    with socket.socket(socket.AF_UNIX) as busy:
        busy.bind(str(path))
        busy.listen()
        with pytest.raises(BusyError, match="has not answered"):
            ask(path)
        # A second agent would take its connection.
        with pytest.raises(BusyError):
            StatusServer(path, dict).start()
    assert path.exists()


@pytest.mark.parametrize("name", ["x" * 120, "no/such/folder/agent.sock"])
def test_an_agent_runs_without_a_socket(name: str, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    server = StatusServer(tmp_path / name, dict)
    server.start()
    server.stop()
    assert "set status_socket" in caplog.text


def test_a_file_in_place_of_the_socket_is_kept(tmp_path: Path) -> None:
    file = tmp_path / "agent.sock"
    file.write_text("precious")
    server = StatusServer(file, dict)
    server.start()
    server.stop()
    assert file.read_text() == "precious"


def test_status_and_check_by_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    import socket

    from tests.unit.agent.test_agent import config_file

    def unknown(*_: object, **__: object) -> None:
        raise socket.gaierror("Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)

    file = config_file(tmp_path, "{type: sim}")
    assert main(["status", "--config", str(file)]) == 1
    assert "no agent is running" in capsys.readouterr().err
    assert main(["check", "--config", str(file), "--json"]) == 1
    findings = {one["what"]: one for one in json.loads(capsys.readouterr().out)}
    assert findings["certificate"]["level"] == "fail"
    assert findings["key's mode"]["level"] == "warn"
    assert findings["key's mode"]["todo"].startswith("chmod 600 ")
    assert findings["queue"]["text"].startswith(f"{tmp_path}/car1.queue.db, ")
    assert findings["record lane"]["level"] == "ok"
    assert findings["name"]["level"] == "fail"


def test_a_closed_output_is_not_an_error(tmp_path: Path) -> None:
    from tests.unit.agent.test_agent import Rig, config_file, drive

    rig = Rig(drive)
    assert rig.runtime.run(drain_s=10) == 0
    config = config_file(tmp_path, "{type: sim}")
    server = StatusServer(tmp_path / "agent.sock", rig.status)
    server.start()
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing) as output:
        command = [sys.executable, "-m", "iort_agent.cli", "status", "--config", str(config)]
        done = subprocess.run(command, stdout=output, stderr=subprocess.PIPE, text=True, check=False)
    server.stop()
    assert (done.stderr, done.returncode) == ("", 1)


@contextlib.contextmanager
def unprivileged() -> Iterator[None]:
    """Drop root's right to write everywhere."""
    if os.geteuid() != 0:
        yield
        return
    nobody = 65534
    os.setresuid(nobody, nobody, 0)
    try:
        yield
    finally:
        os.setresuid(0, 0, 0)


def test_a_read_only_queue_is_found_and_the_agent_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import socket

    from tests.unit.agent.test_agent import config_file

    def unknown(*_: object, **__: object) -> None:
        raise socket.gaierror("Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    # By a relative path, because only their owner may enter the folders above.
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "kept"
    folder.mkdir()
    file = config_file(tmp_path, "{type: sim}", "queue: {path: kept/queue.db}")
    config = load_config(Path(file.name))
    assert FAIL not in {one.level for one in check(config, Path("agent.sock")) if one.what == "queue"}
    tmp_path.chmod(0o755)
    folder.chmod(0o555)
    with unprivileged():
        findings = {one.what: one for one in check(config, Path("agent.sock"))}
        spool = make_spool(config.queue, SystemClock())
        spool.put("vesc", "0badcafe", 0, b"x", samples=1)
        (kept, alarm) = spool.next(0), spool.alarm
        spool.close()
    assert findings["queue"].level == FAIL
    assert findings["queue"].text == "kept may not be written"
    assert kept is not None
    assert "kept in memory only" in (alarm or "")


def test_status_of_an_agent_for_a_person() -> None:
    from tests.unit.agent.test_agent import Rig, drive

    rig = Rig(drive)
    assert rig.runtime.run(drain_s=10) == 0
    state = rig.status()
    text = render(read(Status, json.loads(json.dumps(state))))
    assert "robot     car1" in text
    assert "stream    vesc: " in text
    assert "500 samples" in text
    # A stream of the agent's own has its own pace.
    streams = {name: {**state["streams"]["vesc"], "silent_s": 60} for name in ("vesc", "account")}
    marked = [
        line for line in render(read(Status, {**state, "streams": streams})).splitlines() if "SILENT" in line
    ]
    assert [line.split()[1] for line in marked] == ["vesc:"]
    assert "source    script: played" in text
    assert "NOT connected" in text
    assert "files " not in text
    assert "topic " not in text
    state["sources"] = [
        {
            "source": "ROS 1 topics /scan, /imu, /lost",
            "/scan": {"messages": 201, "silent": False, "left_out": {}, "undecodable": 201},
            "/imu": {"messages": 9, "silent": False, "left_out": {}},
            "/lost": {"messages": 3, "silent": True, "left_out": {"ranges": 3}, "malformed": 1},
            "waits": "another node took the name",
        }
    ]
    topics = [line for line in render(read(Status, state)).splitlines() if line.startswith("topic ")]
    assert topics == [
        "topic     /scan: 201 messages; 201 undecodable",
        "topic     /lost: 3 messages, SILENT; 3 left out ranges; 1 malformed",
    ]
    state["files"] = {
        "waiting": 2, "uploaded": 1, "sent_bytes": 1_234_567, "current": "drive.bag",
        "current_bytes": 8_388_608, "last_error": "drive.bag: refused: not today", "large": None,
    }  # fmt: skip
    text = render(read(Status, state))
    line = "files     2 waiting, 1 uploaded, 1,234,567 bytes sent, now drive.bag (8,388,608 bytes)"
    assert line in text
    assert "last error: drive.bag: refused: not today" in text


def test_status_says_that_the_robot_is_over_its_share() -> None:
    from tests.unit.agent.test_agent import Rig, drive

    rig = Rig(drive)
    assert rig.runtime.run(drain_s=10) == 0
    state = rig.status()
    assert "\nshare " not in render(read(Status, state))
    state["over_share"] = {"since_ms": 1_700_000_000_000, "last_ms": 1_700_000_060_000, "batches": 40}
    assert "share     40 batch(es) over this robot's share of the cloud, the last at 22:14:20Z" in render(
        read(Status, state)
    )


def test_status_shows_the_counts_of_the_sources() -> None:
    from tests.unit.agent.test_agent import Rig, drive

    rig = Rig(drive)
    assert rig.runtime.run(drain_s=10) == 0
    state = rig.status()
    state["sources"] = [
        {"source": "bag ride.csv", "rows": 168, "skipped": {"columns": 100, "time": 40}, "bad_cells": {},
         "clock_back": 53, "columns_left_out": ["note", "gnss lat"], "gnss_ahead_ms": None},
        {"source": "ROS 1", "/tf": {"messages": 7, "silent": True, "left_out": {"a.b": 2}, "odd": 0}},
        {"source": "VESC", "samples": 0},
    ]  # fmt: skip
    lines = [
        "source    bag ride.csv: rows 168, clock_back 53, columns_left_out note gnss lat",
        "          skipped: columns 100, time 40",
        "source    ROS 1",
        "topic     /tf: 7 messages, SILENT; 2 left out a.b",
        "source    VESC",
    ]
    assert "\n".join(lines) in render(read(Status, state))


@pytest.mark.parametrize(
    ("more", "level"), [((), WARN), ((yaml.safe_dump({"downlink": stick_downlink()}),), OK)]
)
def test_a_robot_that_no_stop_stops_is_found_before_one_is_needed(
    tmp_path: Path, more: tuple[str, ...], level: str
) -> None:
    from tests.unit.agent.test_agent import config_file

    finding = emergency_stop(load_config(config_file(tmp_path, "{type: sim}", *more)))
    assert finding.level == level
