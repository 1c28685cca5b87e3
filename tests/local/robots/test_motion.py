"""The emergency stop and who drives, from the operator to a simulated car and back, on the embedded cloud."""

from __future__ import annotations

import fcntl
import os
import select
import signal
import struct
import subprocess
import sys
import termios
from pathlib import Path
from typing import Any

from iort_contract.messages.shadow import decode_reported
from iort_station import data
from iort_station.cloud import EMBEDDED
from iort_station.operations import audit
from local.demo import DOWNLINK
from testkit.waiting import reached, until
from tests.local.data.drives import Agent
from tests.local.robots.test_shadow import Shadow

_KEY_S = 0.05
# Characters of what `iort drive` shows at a time, about.
_FRAME = 2_000
FORWARDS = '{"drive": {"speed": 9.0}}'


def test_a_car_is_driven_stopped_and_released_and_the_stop_outlives_the_agent(embedded, bundle, iort):
    car = bundle(sources=[{"type": "sim", "rate_hz": 50}], downlink=DOWNLINK)
    robot, shadow = car.robot, Shadow(embedded, car.robot)

    def send():
        return iort("send", robot, "drive", FORWARDS, "--lease-ms", "1000")

    with Agent(car):
        until(lambda: decode_reported(shadow.reported()).drive)
        assert decode_reported(shadow.reported()).drive.max_speed_mps == 2.0
        # On a slow machine a command may come too late.
        until(lambda: "has accepted drive" in send().output)
        until(lambda: iort("stop", robot).stdout == f"{robot}: stopped\n")
        refused = until(lambda: "emergency stop" in str((one := send()).exception) and one)
        assert refused.exit_code == 1
    assert iort("stop", robot).stdout == f"{robot}: stopped\n", "as it said before it ended"
    with Agent(car):
        until(lambda: "emergency stop" in str(send().exception))
        until(lambda: iort("stop", robot, "--release").stdout == f"{robot}: released\n")
        until(lambda: "has accepted drive" in send().output)
    until(lambda: list(audit.batches(embedded.cloud, robot, "drive")))
    told = data.query(embedded.cloud, robot, "drive", "-1h", "now")
    outcomes = list(told.columns["outcome"])
    assert {"accepted", "stopped", "emergency_stop"} <= set(outcomes)
    assert max(speed for speed in told.columns["speed"] if speed is not None) == 2.0, "car.yaml's limit"


class Terminal:
    """A command on a terminal of its own."""

    def __init__(self, *command: object) -> None:
        self._keys, theirs = os.openpty()
        fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 100, 0, 0))
        self.process = subprocess.Popen(
            list(map(str, command)), stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True
        )
        os.close(theirs)
        self.shown = ""

    def hold(self, key: str, text: str) -> bool:
        """Press the key once more, as its repetition does; whether the text is shown. A hold that a slow
        machine has ended is let go."""
        if "let go" not in self.shown:
            os.write(self._keys, key.encode())
        if select.select([self._keys], [], [], _KEY_S)[0]:
            self.shown = (self.shown + os.read(self._keys, 65_536).decode(errors="replace"))[-_FRAME:]
        assert self.process.poll() is None, self.shown
        return text in self.shown

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        os.close(self._keys)


def test_a_car_is_driven_by_keys_and_stops_when_the_terminal_freezes(embedded, bundle):
    car = bundle(sources=[{"type": "sim", "rate_hz": 50}], downlink=DOWNLINK)
    shadow = Shadow(embedded, car.robot)
    iort = [Path(sys.executable).parent / "iort", "--embedded", embedded.folder / EMBEDDED.name]
    with Agent(car):
        until(lambda: decode_reported(shadow.reported()).drive)
        terminal = Terminal(*iort, "drive", car.robot, "--by", "anna", "--max-speed", "0.5")
        try:
            until(lambda: terminal.hold("w", "you drive"), poll_s=_KEY_S / 5)

            def frozen() -> data.Result | None:
                """Freeze it while it drives; a slow machine may have let go just before."""
                terminal.shown = ""
                until(lambda: terminal.hold("w", "+0.50 m/s"), poll_s=_KEY_S / 5)
                terminal.process.send_signal(signal.SIGSTOP)
                until(lambda: list(audit.batches(embedded.cloud, car.robot, "drive")))
                if reached(lambda: ended_while_driving(embedded, car.robot), within_s=30.0):
                    return ended_while_driving(embedded, car.robot)
                terminal.process.send_signal(signal.SIGCONT)
                return None

            told = until(frozen)
        finally:
            terminal.close()
    assert set(told.columns["by"]) == {"anna"}
    passed = accepted(told)
    assert told.columns["speed"][passed[0]] == 0, "a hold begins at a standstill"
    last, after = passed[-1], passed[-1] + 1
    # The lease is half a second; the frozen terminal never goes on.
    assert told.times_us[after] - told.times_us[last] < 30_000_000


def accepted(told: data.Result) -> list[int]:
    return [i for i, outcome in enumerate(told.columns["outcome"]) if outcome == "accepted"]


def ended_while_driving(embedded: Any, robot: str) -> data.Result | None:
    """What passed, once the car has been stopped after a command to move."""
    told = data.query(embedded.cloud, robot, "drive", "-1h", "now")
    passed, outcomes = accepted(told), list(told.columns["outcome"])
    if not passed or told.columns["speed"][passed[-1]] == 0:
        return None
    return told if outcomes[passed[-1] + 1 :][:1] == ["stopped"] else None
