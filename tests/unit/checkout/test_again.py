"""The second try of tests that failed: `scripts/again.py` with a real pytest."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from scripts.again import MOST

SCRIPT = Path(__file__).parents[3] / "scripts" / "again.py"
# Each fails until it has run as often as its number says.
TESTS = """
import pathlib, pytest
@pytest.mark.parametrize(("name", "tries"), {tests})
def test_tries(name, tries):
    count = pathlib.Path(name)
    count.write_text(str(int(count.read_text()) + 1 if count.exists() else 1))
    assert int(count.read_text()) >= tries
"""


def tried(folder: Path, *tries: int) -> tuple[subprocess.CompletedProcess[str], list[int]]:
    """Run tests that pass at these tries; the answer has how often each ran."""
    names = [f"test{i}.count" for i in range(len(tries))]
    (folder / "test_tries.py").write_text(TESTS.format(tests=list(zip(names, tries, strict=True))))
    command = [sys.executable, str(SCRIPT), sys.executable, "-m", "pytest", "-q"]
    done = subprocess.run(command, cwd=folder, text=True, capture_output=True, check=False)
    return done, [int((folder / name).read_text()) for name in names]


def test_a_test_that_passes_alone_is_named(tmp_path):
    done, counts = tried(tmp_path, 1, 2, 2)
    assert (done.returncode, counts) == (0, [1, 2, 2]), done.stdout + done.stderr
    named = [f"  test_tries.py::test_tries[test{i}.count-2]" for i in (1, 2)]
    assert done.stdout.splitlines()[-2:] == named


def test_a_test_that_fails_alone_too_fails(tmp_path):
    done, counts = tried(tmp_path, 2, 3)
    assert (done.returncode, counts, "still to be mended" in done.stdout) == (1, [2, 2], False)


@pytest.mark.parametrize(("tries", "code"), [([1], 0), ([2] * (MOST + 1), 1)])
def test_no_failure_and_many_have_no_second_try(tmp_path, tries, code):
    done, counts = tried(tmp_path, *tries)
    assert (done.returncode, set(counts)) == (code, {1})
    assert (f"at most {MOST} failed tests have a second try, got {MOST + 1}" in done.stderr) == bool(code)


def test_a_run_that_did_not_end_has_no_second_try(tmp_path):
    (tmp_path / "test_a.py").write_text(
        "def test_one():\n    raise ValueError\ndef test_two():\n    raise KeyboardInterrupt\n"
    )
    command = [sys.executable, str(SCRIPT), sys.executable, "-m", "pytest", "-q"]
    done = subprocess.run(command, cwd=tmp_path, text=True, capture_output=True, check=False)
    assert (done.returncode, "again:" in done.stdout) == (pytest.ExitCode.INTERRUPTED, False)
