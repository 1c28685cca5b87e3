"""`make demo` as a user runs it: figures, exit status, clear errors, and no leftovers."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

from local.demo import read
from local.deployment import ROOT
from testkit.waiting import until
from tests.local.conftest import invoke
from tests.recordings import recording

TIMEOUT_S = 400


def demo(folder: Path, *arguments: str, terminal: int | None = None) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "local.demo", "--folder", str(folder), *arguments],
        cwd=ROOT,
        stdin=subprocess.DEVNULL if terminal is None else terminal,
        stdout=subprocess.PIPE if terminal is None else terminal,
        stderr=subprocess.STDOUT,
        text=True,
    )


class Terminal:
    """A terminal for one process, and the output so far."""

    def __init__(self, start: Callable[[int], subprocess.Popen[str]]) -> None:
        self._ours, theirs = os.openpty()
        self.process = start(theirs)
        os.close(theirs)
        self.text = ""
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        # Linux fails the read when the other end is closed.
        with suppress(OSError):
            while piece := os.read(self._ours, 65536):
                self.text += piece.decode(errors="replace")


def processes_of(folder: Path) -> list[str]:
    """Return the command lines of processes whose command or environment has the folder."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            text = (process / "environ").read_bytes() + (process / "cmdline").read_bytes()
            alive = (process / "stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
        except OSError:
            continue
        if alive and int(process.name) != os.getpid() and str(folder).encode() in text:
            found.append((process / "cmdline").read_bytes().replace(b"\0", b" ").decode())
    return found


def test_the_figures_match_the_recording(tmp_path):
    bag, report = recording("f1tenth-motor-servo.bag"), tmp_path / "report.json"
    run = demo(tmp_path / "local", "--bag", str(bag), "--duration", "20", "--report", str(report))
    output, _ = run.communicate(timeout=TIMEOUT_S)
    assert run.returncode == 0, output
    figures = json.loads(report.read_text())
    # The recording's clock runs at 49.99 Hz.
    assert figures["samples_sent"] == pytest.approx(1000, abs=3)
    assert figures["samples_sent"] == figures["samples_stored"] == figures["samples_summarized"]
    assert figures["samples_lost"] == 0
    assert 0 < figures["live_received"] <= figures["live_published"]
    for spread in (*figures["rtt_ms"].values(), figures["car_to_dashboard_ms"]):
        assert 0 < spread["p50"] <= spread["p95"]
    assert "car to dashboard" in output
    until(lambda: not processes_of(tmp_path))


@pytest.mark.heavy
def test_the_demo_runs_until_ctrl_c_and_leaves_no_process(tmp_path):
    folder = tmp_path / "local"
    terminal = Terminal(lambda theirs: demo(folder, "--duration", "1", terminal=theirs))
    first = terminal.process
    try:
        until(lambda: "The car drives on" in terminal.text)
        # `iort findings` links to it.
        assert f"{json.loads((folder / 'cloud.json').read_text())['page']}#/" in terminal.text
        second = demo(folder)
        output, _ = second.communicate(timeout=TIMEOUT_S)
        assert second.returncode == 2
        assert (
            f"already running in {folder}" in output.replace("\n", " ").replace("  ", " ")
            or str(first.pid) in output
        )
        assert str(first.pid) in output
        assert processes_of(folder)
        # What the documentation tries on the demo's car.
        triggered = invoke(folder, "recorder", "add", "fast", "--robots", "car1", "--when", "speed > 1e6")
        assert "car1: fast: accepted" in triggered.stdout
    finally:
        first.send_signal(signal.SIGINT)
        first.wait(TIMEOUT_S)
    assert first.returncode == 0, terminal.text
    until(lambda: "nothing is left running" in terminal.text)
    until(lambda: not processes_of(folder))


@pytest.fixture
def refusal(monkeypatch, capsys):
    """What the demo says of wrong options: `refusal("--duration", "-3")`."""

    def ask(*arguments: object) -> str:
        monkeypatch.setattr(sys, "argv", ["demo", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            read()
        assert ended.value.code == 2
        return capsys.readouterr().err

    return ask


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--duration", "-3"), "DURATION must be over 0 and at most 86400 s, got -3"),
        (("--duration", "soon"), "DURATION must be over 0 and at most 86400 s, got soon"),
        (("--bag", "no/such.bag"), "BAG must exist, got no/such.bag"),
        (("--report", "no/such/folder/r.json"), "REPORT must be in an existing folder"),
        (("--report", "."), "REPORT must be a file, got the folder ."),
        (("--faults", "flat_tire"), "FAULTS: kind: must be one of worn_battery"),
        (("--faults", "payload:huge"), "FAULTS: strength: must be weak, middle, strong or a number"),
        (("--port", "70000"), "PORT must be 1 to 65535, got 70000"),
    ],
)
def test_wrong_use_is_reported_at_once(refusal, arguments, said):
    assert said in refusal(*arguments)


def test_without_ros2_the_demo_says_what_to_source(refusal, monkeypatch):
    monkeypatch.delenv("PYTHONPATH", raising=False)
    said = refusal("--ros2")
    assert "ROS2=1 needs a ROS 2 of this Python" in said
    assert "`source /opt/ros/" in said
    assert "No module named 'rclpy'" in said


def test_a_car_in_a_ros2_graph_plays_no_recording(refusal, tmp_path):
    assert "ROS2 are of a simulated car: give no BAG" in refusal("--ros2", "--bag", tmp_path)


def test_an_error_names_the_busy_port(refusal):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert f"PORT must be free, got {port}" in refusal("--port", port)


@pytest.mark.parametrize("content", [b"not a bag", b"", b"#ROSBAG V2.0\n" + bytes(500)])
def test_an_invalid_recording_is_rejected_at_once(refusal, tmp_path, content):
    bag = tmp_path / "x.bag"
    bag.write_bytes(content)
    assert str(bag) in refusal("--bag", bag)


def test_an_error_lists_the_topics_of_a_recording_without_vesc(refusal, tmp_path):
    store = get_typestore(Stores.ROS1_NOETIC)
    with Writer(tmp_path / "other.bag") as writer:
        text = store.types["std_msgs/msg/Float64"](data=1.0)
        connection = writer.add_connection("/servo", "std_msgs/msg/Float64", typestore=store)
        writer.write(connection, 1, store.serialize_ros1(text, "std_msgs/msg/Float64"))
    assert "/servo" in refusal("--bag", tmp_path / "other.bag")


@pytest.mark.heavy
@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGKILL])
def test_no_process_remains_after_a_hangup_or_a_kill(tmp_path, number):
    folder = tmp_path / "local"
    run = demo(folder, "--duration", "600")
    until((folder / "agent.log").exists)
    run.send_signal(number)
    run.communicate(timeout=TIMEOUT_S)
    assert run.returncode == (130 if number == signal.SIGHUP else -number)
    until(lambda: not processes_of(folder))
