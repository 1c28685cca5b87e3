"""The examples of docs/reference/iort.md, on the embedded cloud."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

from local.deployment import ROOT
from tests.local.conftest import recorded

PAGE = (ROOT / "docs" / "reference" / "iort.md").read_text()
(BLOCK,) = re.findall(r"The tests run these:\n\n```sh\n(.*?)```", PAGE, re.DOTALL)


def test_every_example_works(embedded, bundle, iort, tmp_path, monkeypatch):
    drive = {
        "topic": "/drive",
        "type": "ackermann_msgs/AckermannDriveStamped",
        "partial": True,
        "motion": {"stop": {"drive": {"speed": 0.0}}},
    }
    car = bundle(sources=[{"type": "sim", "rate_hz": 50}], downlink={"cmd": {"drive": drive}})
    monkeypatch.chdir(tmp_path)
    agent = subprocess.Popen([Path(sys.executable).parent / "iort-agent", "run", "--config", car.config])
    try:
        recorded(embedded, car.robot, "vesc")
        for line in BLOCK.splitlines():
            if line.startswith("iort audit"):  # What is still in the car counts as missing.
                agent.terminate()
                agent.wait(30)
            said = iort(*shlex.split(line.replace("car7", car.robot), comments=True)[1:])
            assert said.exit_code == 0, f"{line}: {said.output}"
    finally:
        agent.terminate()
        agent.wait(30)
    assert {"ride.parquet", "speed.png", "ride.mcap"} <= {path.name for path in tmp_path.iterdir()}
