"""REQUIRE_ALL=1 makes every skip but that of a missing ROS 2 a failure, and changes no other result."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from stacks.settings import ROOT
from testkit.waiting import GUARD_S

MODULES = {
    "test_skips.py": """
import pytest
def test_good(): pass
def test_skipped(): pytest.skip("no Chromium")
def test_robot(): pytest.skip("no ROS 2 is sourced or in /opt/ros")
@pytest.mark.skip(reason="no recording")
def test_marked(): pass
@pytest.mark.xfail(strict=True)
def test_expected(): assert False
""",
    "test_module.py": """
import pytest
pytest.importorskip("there_is_no_such_module")
""",
}


@pytest.mark.parametrize(
    ("require", "code", "counts"),
    [
        ("", 0, ["1 passed", "4 skipped", "1 xfailed"]),
        ("0", 0, ["4 skipped"]),
        (
            "1",
            1,
            [
                "1 passed",
                "1 skipped",
                "1 failed",
                "2 errors",
                "1 xfailed",
                "no Chromium",
                "no recording",
                "REQUIRE_ALL",
            ],
        ),
    ],
)
def test_a_skip_is_a_failure_with_require_all(tmp_path, require, code, counts):
    for name, text in MODULES.items():
        (tmp_path / name).write_text(text)
    flags = ["-p", "tests.conftest", "-p", "no:cacheprovider", "--rootdir", tmp_path]
    if require == "1":
        # An error during collection would end the run before the tests.
        flags.append("--continue-on-collection-errors")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *flags, tmp_path],
        cwd=ROOT,
        env={**os.environ, "REQUIRE_ALL": require},
        capture_output=True,
        text=True,
        check=False,
        timeout=GUARD_S,
    )
    assert done.returncode == code, done.stdout
    for count in counts:
        assert count in done.stdout
    assert "ROS 2: 1 test left out, since no ROS 2 is sourced or in /opt/ros" in done.stdout.splitlines()
