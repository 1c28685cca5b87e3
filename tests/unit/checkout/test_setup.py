"""scripts/setup.py: which steps run again."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from scripts import setup
from scripts.setup import SetupError, Step, run

_STEP = Step("step", "a step", ("input",), ("touch ran", "grep -q good input"))


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder in place of the checkout, with an environment and the step's input."""
    monkeypatch.setattr(setup, "ROOT", tmp_path)
    monkeypatch.setattr(setup, "STAMPS", tmp_path / "build" / "setup")
    (tmp_path / ".venv").mkdir()
    (tmp_path / "input").write_text("good")
    return tmp_path


def _ran(checkout: Path) -> bool:
    (checkout / "ran").unlink(missing_ok=True)
    run(_STEP, 0.0)
    return (checkout / "ran").exists()


def test_a_step_runs_again_only_if_its_input_has_changed(checkout: Path) -> None:
    assert [_ran(checkout), _ran(checkout)] == [True, False]
    (checkout / "input").write_text("also good")
    assert [_ran(checkout), _ran(checkout)] == [True, False]


def test_a_step_that_failed_half_way_runs_again_with_the_input_of_its_last_success(checkout: Path) -> None:
    _ran(checkout)
    (checkout / "input").write_text("bad")
    with pytest.raises(SetupError):
        run(_STEP, 0.0)
    # As after `git switch` to another branch and back.
    (checkout / "input").write_text("good")
    assert _ran(checkout)


def test_every_command_runs_the_cdk_on_the_environments_node() -> None:
    command = ["make", "--silent", "--eval", "node: ; @echo $$JSII_NODE", "node"]
    done = subprocess.run(command, cwd=setup.ROOT, text=True, capture_output=True, check=True)
    assert done.stdout.strip() == str(setup.ROOT / ".venv" / "bin" / "node")
