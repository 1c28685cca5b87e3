"""`make bench ONLY=soak` when somebody ends it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from local.deployment import ROOT
from testkit import machine
from testkit.waiting import GUARD_S, until


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler makes the clock: apt install gcc")
def test_a_bench_that_is_ended_leaves_no_process_behind(tmp_path):
    command = [
        sys.executable,
        "-m",
        "bench.run",
        "--only",
        "soak",
        "--set",
        "HOURS=1",
        "--out",
        str(tmp_path / "out"),
    ]
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    with subprocess.Popen(command, cwd=ROOT, env=environment, stderr=subprocess.PIPE, text=True) as bench:

        def running() -> dict[int, str]:
            found = {pid: _command(pid) for pid in machine.descendants(bench.pid)}
            return found if any("local.emulator.run" in one for one in found.values()) else {}

        started = until(running)
        bench.terminate()
        _, told = bench.communicate(timeout=GUARD_S)
    assert (bench.returncode, told) == (130, "")
    until(lambda: all(_command(pid) != command for pid, command in started.items()))


def _command(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/cmdline").read_text()
    except OSError:
        return ""
