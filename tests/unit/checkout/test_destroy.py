"""`make destroy` right after the removal of the last robot: AWS keeps its policy for up to five minutes."""

from __future__ import annotations

import sys

import pytest

from scripts import destroy

KEPT = "iort-fleet | 3 | 10:00:00 | DELETE_FAILED        | AWS::IoT::Policy | Policy (Policy) attached"
OTHER = "iort-storage | 3 | 10:00:00 | DELETE_FAILED | AWS::S3::Bucket | Files (Files) not empty"


@pytest.fixture
def cdk(tmp_path):
    """A fake command that fails this often with this text; `calls` has the arguments of each call."""
    calls = tmp_path / "calls"

    def command(failures, said):
        script = tmp_path / "cdk.py"
        script.write_text(
            "import sys, pathlib\n"
            f"calls = pathlib.Path({str(calls)!r})\n"
            "before = calls.read_text().splitlines() if calls.exists() else []\n"
            "calls.write_text('\\n'.join([*before, ' '.join(sys.argv[1:])]))\n"
            f"if len(before) < {failures}:\n"
            f"    sys.exit({said!r})\n"
        )
        return [sys.executable, str(script), "destroy", "--all"]

    command.calls = lambda: calls.read_text().splitlines()
    return command


def test_destroy_retries_while_the_policy_exists_and_asks_once(cdk, capfd):
    waited = []
    assert destroy.destroy(cdk(3, KEPT), waited.append) == 0
    assert waited == [destroy.AGAIN_S] * 3
    assert cdk.calls() == ["destroy --all", *["destroy --all --force"] * 3]
    said = capfd.readouterr().err
    assert said.count(KEPT) == 3
    assert "again in 30 s, 12 times at most" in said


def test_destroy_gives_up_after_six_minutes(cdk):
    waited = []
    assert destroy.destroy(cdk(99, KEPT), waited.append) == 1
    assert sum(waited) == 360
    assert len(cdk.calls()) == destroy.TRIES


@pytest.mark.parametrize(("failures", "said", "status"), [(99, OTHER, 1), (0, "", 0)])
def test_any_other_result_ends_destroy_at_once(cdk, failures, said, status):
    waited = []
    assert destroy.destroy(cdk(failures, said), waited.append) == status
    assert (waited, len(cdk.calls())) == ([], 1)
