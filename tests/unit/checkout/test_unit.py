"""The robot's systemd unit: it sources the robot's ROS, and becomes the agent."""

from __future__ import annotations

import re
import shlex
import subprocess
from pathlib import Path

import pytest

from testkit import ROOT

UNIT = (ROOT / "device/systemd/iort-agent.service").read_text()
AGENT = "/opt/iort/bin/iort-agent"


def start(folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Start what the unit starts, with a stand-in for the agent that tells what it got."""
    agent = folder / "iort-agent"
    agent.write_text('#!/bin/bash\necho "$$ $DISTRIBUTION $*"\n')
    agent.chmod(0o755)
    (line,) = re.findall(r"^ExecStart=(.*)$", UNIT, re.MULTILINE)
    command = [word.replace("$$", "$").replace(AGENT, str(agent)) for word in shlex.split(line)]
    with subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        output, errors = process.communicate()
    pid, _, rest = output.partition(" ")
    # systemd signals the process that it has started.
    assert int(pid) == process.pid
    return subprocess.CompletedProcess(command, process.returncode, rest, errors)


def test_without_ros_it_is_the_agent(tmp_path: Path) -> None:
    done = start(tmp_path)
    assert (done.returncode, done.stdout.split()) == (0, ["run", "--config", "/etc/iort/car.yaml"])


def test_the_robots_set_up_is_sourced(tmp_path: Path) -> None:
    setup = tmp_path / "the workspace" / "setup.bash"
    setup.parent.mkdir()
    # As ROS' own: it exports, and may end with a test that fails.
    setup.write_text('export DISTRIBUTION=humble\n[ -n "$NOTHING" ] && true\n')
    assert start(tmp_path, ROS_SETUP=str(setup)).stdout.split()[0] == "humble"


def test_a_set_up_that_is_missing_is_said_and_the_agent_runs(tmp_path: Path) -> None:
    done = start(tmp_path, ROS_SETUP="/opt/ros/none/setup.bash")
    assert done.stdout.split()[0] == "run"
    assert "/opt/ros/none/setup.bash: No such file" in done.stderr


@pytest.mark.parametrize("key", ["EnvironmentFile=-/etc/iort/environment", "User=iort", "Restart=always"])
def test_it_has_what_the_pages_say_of_it(key: str) -> None:
    assert f"\n{key}\n" in UNIT
