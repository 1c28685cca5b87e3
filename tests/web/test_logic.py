"""The page's own tests of what it does without a browser, and what it sends as the robot reads it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from iort_contract.messages.commands import check_by, decode_command
from iort_contract.messages.video import LOOKS, decode_look
from local.deployment import ROOT


def test_the_page_passes_its_own_tests_and_the_robot_reads_what_it_sends(tmp_path):
    wire = tmp_path / "wire.json"
    done = subprocess.run(
        [Path(sys.executable).with_name("node"), "station/web/test.mjs"],
        cwd=ROOT,
        env={**os.environ, "IORT_WIRE": str(wire)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    sent = json.loads(wire.read_text())
    commands = [decode_command(json.dumps(command)) for command in sent["commands"]]
    assert {command.by for command in commands} == {"ada"}
    assert len(commands) > 100
    assert [check_by(name) for _, name in sent["names"]] == [name for _, name in sent["names"]]
    looks = json.loads(wire.with_name("wire.json.looks").read_text())
    assert {decode_look(json.dumps(look).encode()).kind for look in looks} == set(LOOKS)
