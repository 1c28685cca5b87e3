"""`make destroy`: schedules are off first, and what only needs time is tried again."""

from __future__ import annotations

import sys

import boto3
import pytest
from moto import mock_aws

from iort_station.cloud import Cloud
from scripts import destroy

KEPT = "iort-fleet | 3 | 10:00:00 | DELETE_FAILED        | AWS::IoT::Policy | Policy (Policy) attached"
FILLED = "iort-storage | 3 | 10:00:00 | DELETE_FAILED | AWS::S3::Bucket | Files (Files) not empty"
OTHER = "iort-fleet | 3 | 10:00:00 | DELETE_FAILED | AWS::IAM::Role | Role (Role) in use"


class Around:
    """A deployment that notes what is asked of it."""

    def __init__(self, *, empty=True):
        self.done, self._empty = [], empty

    def pause(self):
        self.done.append("pause")

    def resume(self):
        self.done.append("resume")

    def is_empty(self):
        self.done.append("look")
        return self._empty

    def empty(self):
        self.done.append("empty")


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
    assert destroy.destroy(cdk(3, KEPT), waited.append, Around()) == 0
    assert waited == [destroy.AGAIN_S] * 3
    assert cdk.calls() == ["destroy --all", *["destroy --all --force"] * 3]
    said = capfd.readouterr().err
    assert said.count(KEPT) == 3
    assert "again in 30 s, 12 times at most" in said


def test_destroy_gives_up_after_six_minutes(cdk):
    waited = []
    assert destroy.destroy(cdk(99, KEPT), waited.append, Around()) == 1
    assert sum(waited) == 360
    assert len(cdk.calls()) == destroy.TRIES


@pytest.mark.parametrize(("failures", "said", "status"), [(99, OTHER, 1), (0, "", 0)])
def test_any_other_result_ends_destroy_at_once(cdk, failures, said, status):
    waited = []
    assert destroy.destroy(cdk(failures, said), waited.append, Around()) == status
    assert (waited, len(cdk.calls())) == ([], 1)


def test_the_schedules_are_off_meanwhile_and_on_again_where_they_stand(cdk):
    around = Around()
    assert destroy.destroy(cdk(99, OTHER), [].append, around) == 1
    assert around.done == ["pause", "look", "resume"]


def test_a_bucket_with_files_is_not_emptied_unasked(cdk, capsys):
    around = Around(empty=False)
    assert destroy.destroy(cdk(0, ""), [].append, around) == 1
    assert around.done == ["pause", "look", "resume"]
    assert "iort files empty" in capsys.readouterr().err


def test_what_came_into_the_bucket_since_is_deleted_and_destroy_goes_on(cdk):
    around, waited = Around(), []
    command = cdk(2, FILLED)
    assert destroy.destroy(command, waited.append, around) == 0
    assert around.done == ["pause", "look", "empty", "empty", "resume"]
    assert waited == []
    assert cdk.calls() == ["destroy --all", *["destroy --all --force"] * 2]


@mock_aws
def test_the_deployments_schedules_alone_are_switched():
    client = boto3.client("scheduler", region_name="eu-west-1")
    role = "arn:aws:iam::123456789012:role/schedules"
    target = {"Arn": "arn:aws:lambda:eu-west-1:123456789012:function:archive", "RoleArn": role, "Input": "{}"}
    for name, state in {"iort-a": "ENABLED", "iort-b": "DISABLED", "lab2-a": "ENABLED"}.items():
        client.create_schedule(
            Name=name,
            State=state,
            ScheduleExpression="cron(15 * * * ? *)",
            FlexibleTimeWindow={"Mode": "OFF"},
            Target=target,
        )

    def states():
        return {one["Name"]: one["State"] for one in client.list_schedules()["Schedules"]}

    deployment = destroy.Deployment(Cloud(region="eu-west-1"))
    deployment.pause()
    assert states() == {"iort-a": "DISABLED", "iort-b": "DISABLED", "lab2-a": "ENABLED"}
    assert client.get_schedule(Name="iort-a")["ScheduleExpression"] == "cron(15 * * * ? *)"
    deployment.resume()
    assert states() == {"iort-a": "ENABLED", "iort-b": "DISABLED", "lab2-a": "ENABLED"}
    deployment.pause()
    client.delete_schedule(Name="iort-a")
    deployment.resume()
    assert "iort-a" not in states()
    assert deployment.is_empty(), "there is no bucket"
