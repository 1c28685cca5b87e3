"""The agent's figures and status: the socket, the text for a person, and `iort-agent check`."""

from __future__ import annotations

import contextlib
import copy
import json
import os
import socket
import stat
import subprocess
import sys
from pathlib import Path
from typing import Any, Iterator

import pytest
import yaml

from iort_agent import status as status_module
from iort_agent.cli import main
from iort_agent.common.state import Status, read
from iort_agent.common.threads import SystemClock
from iort_agent.config import load_config
from iort_agent.errors import AgentError, BusyError, NotRunningError
from iort_agent.lanes.pings import OffsetEstimator
from iort_agent.lanes.streams import StreamCounts
from iort_agent.metrics import AgentMetrics, Rates, rss_mb
from iort_agent.mqtt.dispatch import Dispatcher
from iort_agent.sources import FAIL, OK, WARN
from iort_agent.spool.sqlite import make_spool
from iort_agent.status import StatusServer, ask, fetch, render
from iort_agent.verbs.check import check, emergency_stop
from iort_contract.catalog.streams import AGENT_FIELDS
from iort_contract.messages.commands import stick_downlink
from testkit.agent import Loopback, ManualClock, MemorySpool
from testkit.waiting import GUARD_S
from tests.unit.agent.test_agent import Rig, config_file, drive


@contextlib.contextmanager
def serving(path: Path, status: dict[str, Any]) -> Iterator[None]:
    server = StatusServer(path, lambda: status)
    server.start()
    try:
        yield
    finally:
        server.stop()


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A busy machine answers late."""
    monkeypatch.setattr(status_module, "_TIMEOUT_S", GUARD_S)


@pytest.fixture
def no_names(monkeypatch: pytest.MonkeyPatch) -> None:
    """No name server answers."""

    def unknown(*_: object, **__: object) -> None:
        raise socket.gaierror("Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)


@pytest.fixture(scope="module")
def ended() -> dict[str, Any]:
    rig = Rig(drive)
    assert rig.runtime.run(drain_s=10) == 0
    return rig.status()


@pytest.fixture
def state(ended: dict[str, Any]) -> dict[str, Any]:
    """The status of an agent that has recorded 500 samples."""
    return copy.deepcopy(ended)


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
    clock.advance(1.5)
    rates.update(counts)
    assert (rates.per_s["vesc"], rates.silent_s("vesc")) == (33.33, 0)
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
    with pytest.raises(AgentError, match=r"already running.*process 7"):
        StatusServer(path, dict).start()
    with pytest.raises(AgentError, match="of another version") as raised:
        ask(path)
    assert not isinstance(raised.value, NotRunningError)
    server.stop()
    assert not path.exists()
    with pytest.raises(AgentError, match="no agent is running"):
        fetch(path)


def test_a_long_path_works_and_the_socket_of_a_killed_agent_is_replaced(tmp_path: Path) -> None:
    folder = tmp_path / ("x" * 100)
    folder.mkdir()
    for path in (folder / "agent.sock", tmp_path / "agent.sock"):
        if path.parent == tmp_path:
            with socket.socket(socket.AF_UNIX) as left:
                left.bind(str(path))
        with serving(path, {"pid": 1}):
            assert fetch(path) == {"pid": 1}
    assert not list(folder.iterdir())


def test_an_agent_that_is_too_busy_to_answer_is_no_stopped_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(status_module, "_TIMEOUT_S", 0.01)
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
    with serving(file, {}):
        pass
    assert file.read_text() == "precious"


@pytest.mark.usefixtures("no_names")
def test_status_and_check_by_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
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


def test_a_closed_output_is_not_an_error(tmp_path: Path, state: dict[str, Any]) -> None:
    config = config_file(tmp_path, "{type: sim}")
    reading, writing = os.pipe()
    os.close(reading)
    with serving(tmp_path / "agent.sock", state), os.fdopen(writing) as output:
        command = [sys.executable, "-m", "iort_agent.cli", "status", "--config", str(config)]
        done = subprocess.run(command, stdout=output, stderr=subprocess.PIPE, text=True, check=False)
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


@pytest.mark.usefixtures("no_names")
def test_a_read_only_queue_is_found_and_the_agent_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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


@pytest.mark.parametrize(
    ("more", "level"), [((), WARN), ((yaml.safe_dump({"downlink": stick_downlink()}),), OK)]
)
def test_a_robot_that_no_stop_stops_is_found_before_one_is_needed(
    tmp_path: Path, more: tuple[str, ...], level: str
) -> None:
    finding = emergency_stop(load_config(config_file(tmp_path, "{type: sim}", *more)))
    assert finding.level == level


def text_of(state: dict[str, Any]) -> str:
    return render(read(Status, json.loads(json.dumps(state))))


def lines_of(state: dict[str, Any], *heads: str) -> list[str]:
    return [line for line in text_of(state).splitlines() if line.split(" ")[0] in heads]


def test_status_of_an_agent_for_a_person(state: dict[str, Any]) -> None:
    text = text_of(state)
    for part in ("robot     car1", "stream    vesc: ", "500 samples", "source    script: played"):
        assert part in text
    assert "NOT connected" in text
    assert lines_of(state, "files", "topic", "share") == []
    # A stream of the agent's own has its own pace.
    state["streams"] = {name: {**state["streams"]["vesc"], "silent_s": 60} for name in ("vesc", "account")}
    assert [line.split()[1] for line in text_of(state).splitlines() if "SILENT" in line] == ["vesc:"]


def test_status_shows_files_and_a_robot_over_its_share(state: dict[str, Any]) -> None:
    state["over_share"] = {"since_ms": 1_700_000_000_000, "last_ms": 1_700_000_060_000, "batches": 40}
    state["files"] = {
        "waiting": 2, "uploaded": 1, "sent_bytes": 1_234_567, "current": "drive.bag",
        "current_bytes": 8_388_608, "last_error": "drive.bag: refused: not today", "large": None,
    }  # fmt: skip
    assert lines_of(state, "share", "files") == [
        "files     2 waiting, 1 uploaded, 1,234,567 bytes sent, now drive.bag (8,388,608 bytes)",
        *lines_of(state, "share"),
    ]
    assert "40 batch(es) over this robot's share of the cloud, the last at 22:14:20Z" in text_of(state)
    assert "last error: drive.bag: refused: not today" in text_of(state)


def test_status_shows_the_counts_of_the_sources(state: dict[str, Any]) -> None:
    state["sources"] = [
        {"source": "bag ride.csv", "rows": 168, "skipped": {"columns": 100, "time": 40}, "bad_cells": {},
         "clock_back": 53, "columns_left_out": ["note", "gnss lat"]},
        {"source": "ROS 1", "/tf": {"messages": 7, "silent": True, "left_out": {"a.b": 2}, "odd": 0}},
        {"source": "VESC", "samples": 0},
        {"source": "ROS 1 topics",
         "/scan": {"messages": 201, "silent": False, "left_out": {}, "undecodable": 201},
         "/imu": {"messages": 9, "silent": False, "left_out": {}},
         "/lost": {"messages": 3, "silent": True, "left_out": {"ranges": 3}, "malformed": 1},
         "waits": "another node took the name"},
    ]  # fmt: skip
    lines = [
        "source    bag ride.csv: rows 168, clock_back 53, columns_left_out note gnss lat",
        "          skipped: columns 100, time 40",
        "source    ROS 1",
        "topic     /tf: 7 messages, SILENT; 2 left out a.b",
        "source    VESC",
        "source    ROS 1 topics: waits another node took the name",
        "topic     /scan: 201 messages; 201 undecodable",
        "topic     /lost: 3 messages, SILENT; 3 left out ranges; 1 malformed",
    ]
    assert "\n".join(lines) in text_of(state)
