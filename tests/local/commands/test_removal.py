"""A deployment is taken down as docs/how-to/take-down.md says, beside another one in the same account."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import pytest
from botocore.exceptions import ClientError

from iort_contract.messages.files import FILES_PREFIX
from iort_station.fleet import identity, registry, robots
from local.deployment import deploy
from scripts import destroy
from testkit.waiting import until
from tests.local.conftest import invoke


@pytest.fixture(scope="module")
def lab(embedded, tmp_path_factory):
    """Make a second deployment in the embedded account, which the test removes."""
    folder = tmp_path_factory.mktemp("lab")
    cloud = replace(embedded.cloud, namespace="lab")
    deploy(cloud, folder, lambda _step: None)
    cloud.save(folder / "cloud.json")
    return cloud, folder / "cloud.json"


def destroyed(cloud, noun):
    """Delete a stack; return whether it is gone, and the obstacles."""
    formation, name = cloud.client("cloudformation"), f"{cloud.namespace}-{noun}"
    formation.delete_stack(StackName=name)

    def status():
        try:
            said = formation.describe_stacks(StackName=name)["Stacks"][0]["StackStatus"]
        except ClientError:
            return "GONE"
        return said if said != "DELETE_IN_PROGRESS" else ""

    if until(status) == "GONE":
        return True, ""
    events = formation.describe_stack_events(StackName=name)["StackEvents"]
    failed = [event for event in events if event["ResourceStatus"] == "DELETE_FAILED"]
    return False, " ".join(event.get("ResourceStatusReason", "") for event in failed)


@pytest.mark.heavy
def test_a_teardown_leaves_other_deployments_untouched(embedded, bundle, lab, tmp_path):
    cloud, description = lab
    kept = bundle()
    for name in ("lab-car1", "lab-car2"):
        robots.add(cloud, name, out=tmp_path)
    identity.register(cloud, "lab-expected")
    identity.claim(cloud, None, out=tmp_path / "claim", lasting=True)
    bucket = cloud.output("storage", "FilesBucket")
    cloud.client("s3").put_object(Bucket=bucket, Key=f"{FILES_PREFIX}lab-car1/drive.bag", Body=b"drive")

    iort = partial(invoke, description.parent)
    scheduler, deployment = cloud.client("scheduler"), destroy.Deployment(cloud)

    def states():
        pages = scheduler.get_paginator("list_schedules").paginate()
        return {one["Name"]: one["State"] for page in pages for one in page["Schedules"]}

    before = states()
    deployment.pause()
    assert {name for name, state in states().items() if state != before[name]} == {
        name for name in before if name.startswith("lab-")
    }
    assert not deployment.is_empty()
    deployment.resume()
    assert states() == before
    # Delete a stack before the stacks whose outputs it uses.
    for noun in ("monitoring", "ingest"):
        assert destroyed(cloud, noun) == (True, ""), noun
    gone, why = destroyed(cloud, "fleet")
    assert not gone, "the stack can be deleted although robots have the policy, so the command is not needed"
    assert "lab-robot" in why
    assert "lab-claim" in why

    asked = iort("robots", "remove", "--all")
    assert str(asked.exception).startswith("Remove 3 robots and every lasting claim? Nobody can answer")
    assert {row["robot"] for row in registry.listed(cloud)} == {"lab-car1", "lab-car2", "lab-expected"}

    done = iort("robots", "remove", "--all", "--yes")
    assert done.exit_code == 0, done.output
    assert done.output.splitlines() == [
        *(f"{name} is removed" for name in ("lab-car1", "lab-car2", "lab-expected")),
        "lasting claims revoked: 1",
    ]
    assert list(registry.listed(cloud)) == []
    again = iort("robots", "remove", "--all", "--yes")
    assert (again.exit_code, again.output) == (0, "lasting claims revoked: 0\n")

    assert iort("files", "empty", "--yes").exit_code == 0
    for noun in ("fleet", "analysis", "archive", "processing", "quarantine", "storage"):
        assert destroyed(cloud, noun) == (True, ""), noun

    assert registry.get(embedded.cloud, kept.robot)
    (certificate,) = identity.certificates(embedded.cloud, kept.robot)
    assert certificate.status == "ACTIVE"
