"""Every parameter that may be changed in a deployment: no update is refused by CloudFormation or loses
data."""

from __future__ import annotations

import json
import re
import shlex
from collections import defaultdict
from collections.abc import Iterator
from typing import Any

import boto3
import pytest
from moto import mock_aws

from iort_contract.archive import ARCHIVE_PREFIX
from stacks.settings import CONTEXT_KEYS, ROOT
from stacks.variations import FLIPS, KEY, NOT_FLIPPED, VARIATIONS
from tests.stacks.templates import create_only, identity, is_replaced

Templates = dict[str, dict[str, Any]]

# Resources whose data is lost if they are replaced or deleted.
LOST_IF_REPLACED = {"AWS::DynamoDB::Table", "AWS::S3::Bucket", "AWS::SQS::Queue", "AWS::KMS::Key"}


def troubles(before: Templates, after: Templates) -> Iterator[str]:
    """The faults of an update from one deployment to the other. A stack that is in only one of them
    is created, or stays as it is."""
    for stack in before.keys() & after.keys():
        imported = {
            name for other, template in before.items() if other != stack for name in imports(template)
        }
        for export in sorted((exports(before[stack]) - exports(after[stack])) & imported):
            yield f"{stack}: export {export} goes while others import it"
        old, new = before[stack]["Resources"], after[stack]["Resources"]
        named = {identity(one): logical_id for logical_id, one in old.items()}
        for logical_id, one in new.items():
            if identity(one) is not None and named.get(identity(one), logical_id) != logical_id:
                yield f"{stack}: {logical_id} is made while {named[identity(one)]} has its name"
        for logical_id, one in old.items():
            replaced = logical_id in new and is_replaced(one, new[logical_id])
            if replaced and identity(one) is not None and identity(one) == identity(new[logical_id]):
                yield f"{stack}: {logical_id} is replaced under its own name"
            gone = logical_id not in new or replaced
            # A resource that is retained when it leaves its stack is not lost.
            kept = logical_id not in new and one.get("DeletionPolicy") == "Retain"
            if gone and not kept and one["Type"] in LOST_IF_REPLACED and one["Type"] != "AWS::KMS::Key":
                yield f"{stack}: {logical_id} is lost"


def exports(template: dict[str, Any]) -> set[str]:
    return {one["Export"]["Name"] for one in template.get("Outputs", {}).values() if "Export" in one}


def imports(value: Any) -> Iterator[str]:
    if isinstance(value, dict):
        if "Fn::ImportValue" in value:
            yield value["Fn::ImportValue"]
        for one in value.values():
            yield from imports(one)
    elif isinstance(value, list):
        for one in value:
            yield from imports(one)


def test_every_parameter_has_a_flip_or_an_exception():
    flipped = {name for flip in FLIPS.values() for name in flip}
    assert flipped | KEY.keys() | NOT_FLIPPED == CONTEXT_KEYS


@pytest.mark.parametrize("flip", FLIPS)
def test_a_parameter_may_be_changed_and_changed_back(deployment, flip):
    base, changed = deployment().templates, deployment(**FLIPS[flip]).templates
    assert base != changed
    assert list(troubles(base, changed)) == []
    assert list(troubles(changed, base)) == []


def test_a_named_resource_is_never_replaced(deployment):
    """In any two deployments of a namespace, with any parameters."""
    given: dict[str, set[str]] = defaultdict(set)
    for settings in VARIATIONS.values():
        if "namespace" not in settings:
            for template in deployment(**settings).templates.values():
                for one in template["Resources"].values():
                    if identity(one) is not None:
                        given[str(identity(one))].add(json.dumps(create_only(one), sort_keys=True))
    assert {name: values for name, values in given.items() if len(values) > 1} == {}
    assert any(name.startswith("AWS::IoT::TopicRule") for name in given)


def test_a_customer_key_is_added_at_once_and_removed_in_two_steps(deployment):
    def templates(**given):
        return deployment(**given).templates

    base, kept, used = templates(), templates(keep_customer_key=True), templates(**KEY)
    assert list(troubles(base, used)) == []
    assert list(troubles(used, kept)) == []
    assert list(troubles(kept, used)) == []
    assert list(troubles(kept, base)) == []
    both = templates(**KEY, keep_customer_key=True)
    assert both == used
    # One step fails: CloudFormation refuses it, and encrypted data would lose its key.
    refused = list(troubles(used, base))
    assert refused
    assert all("goes while others import it" in one for one in refused)


TABLE = {"Type": "AWS::DynamoDB::Table", "Properties": {"TableName": "a", "BillingMode": "x"}}
RULE = {"Type": "AWS::IoT::TopicRule", "Properties": {"RuleName": "r"}}
MAPPING = {
    "Type": "AWS::Lambda::EventSourceMapping",
    "Properties": {"FunctionName": "f", "EventSourceArn": "a", "StartingPosition": "LATEST"},
}
NAMED_WITHIN = {
    "Type": "AWS::CloudFront::ResponseHeadersPolicy",
    "Properties": {"ResponseHeadersPolicyConfig": {"Name": "h"}},
}
DURABLE = {"Type": "AWS::Lambda::Function", "Properties": {"FunctionName": "f", "DurableConfig": {}}}
QUEUE = {"Type": "AWS::SQS::Queue", "Properties": {"FifoQueue": True, "QueueName": "q"}}


def of(**resources: Any) -> Templates:
    return {"s": {"Resources": resources}}


@pytest.mark.parametrize(
    ("before", "after", "trouble"),
    [
        (of(T=TABLE), of(), "s: T is lost"),
        (of(T=TABLE), of(T={**TABLE, "Properties": {"TableName": "b"}}), "s: T is lost"),
        (of(T=TABLE), of(T={**TABLE, "Properties": {**TABLE["Properties"], "BillingMode": "y"}}), None),
        (of(R=RULE), of(Other=RULE), "s: Other is made while R has its name"),
        (of(R=RULE), of(), None),
        (
            of(Q=QUEUE),
            of(Q={**QUEUE, "Properties": {**QUEUE["Properties"], "FifoQueue": False}}),
            "s: Q is replaced under its own name",
        ),
        (of(M=MAPPING), of(Other=MAPPING), "s: Other is made while M has its name"),
        (
            of(M=MAPPING),
            of(M={**MAPPING, "Properties": {**MAPPING["Properties"], "StartingPosition": "TRIM_HORIZON"}}),
            "s: M is replaced under its own name",
        ),
        (of(H=NAMED_WITHIN), of(Other=NAMED_WITHIN), "s: Other is made while H has its name"),
        (
            of(F=DURABLE),
            of(F={**DURABLE, "Properties": {"FunctionName": "f", "DurableConfig": {"ExecutionTimeout": 1}}}),
            "s: F is replaced under its own name",
        ),
    ],
)
def test_a_refused_or_lossy_update_is_found(before, after, trouble):
    found = list(troubles(before, after))
    assert (trouble in found) if trouble else found == []


# The stages dev and prod: the deletion of data, and encryption with a customer key.

# Resources with data: prod retains them, dev deletes them.
HOLDS_DATA = {
    "AWS::DynamoDB::Table",
    "AWS::KMS::Key",
    "AWS::Logs::LogGroup",
    "AWS::S3::Bucket",
    "AWS::SQS::Queue",
}


def holding_data(app):
    return [
        resource
        for template in app.templates.values()
        for resource in template["Resources"].values()
        if resource["Type"] in HOLDS_DATA
    ]


def test_prod_retains_data(production):
    for resource in holding_data(production):
        assert (resource["DeletionPolicy"], resource["UpdateReplacePolicy"]) == ("Retain", "Retain"), resource
    for table in production.resources("AWS::DynamoDB::Table").values():
        assert table["DeletionProtectionEnabled"]
        assert table["PointInTimeRecoverySpecification"] == {"PointInTimeRecoveryEnabled": True}
    assert production.protected == set(production.templates)


# The commands of docs/how-to/restore.md bring back what was deleted and what was replaced.

PAGE = (ROOT / "docs/how-to/restore.md").read_text()
OBJECT_KEY = f"{ARCHIVE_PREFIX}robot=car7/hour.parquet"
BUCKET = "files"


@pytest.fixture
def s3(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "test")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "test")
    with mock_aws():
        client = boto3.client("s3", region_name="us-east-1")
        client.create_bucket(Bucket=BUCKET)
        client.put_bucket_versioning(Bucket=BUCKET, VersioningConfiguration={"Status": "Enabled"})
        client.put_object(Bucket=BUCKET, Key=OBJECT_KEY, Body=b"an hour")
        yield client


def documented(client: Any, command: str, **values: str) -> Any:
    """Run the page's command of this name, with these words in it replaced."""
    (line,) = re.findall(rf"^aws s3api {command} (.+)$", PAGE, re.MULTILINE)
    for word, value in {"$BUCKET": BUCKET, **values}.items():
        line = line.replace(word, value)
    words = shlex.split(line)
    names = ["".join(part.capitalize() for part in one[2:].split("-")) for one in words[::2]]
    return getattr(client, command.replace("-", "_"))(**dict(zip(names, words[1::2], strict=True)))


def content(client: Any) -> bytes:
    return bytes(client.get_object(Bucket=BUCKET, Key=OBJECT_KEY)["Body"].read())


def test_a_deleted_object_is_restored_without_its_marker(s3):
    s3.delete_object(Bucket=BUCKET, Key=OBJECT_KEY)
    with pytest.raises(s3.exceptions.NoSuchKey):
        content(s3)
    (marker,) = documented(s3, "list-object-versions")["DeleteMarkers"]
    documented(s3, "delete-object", KEY=marker["Key"], MARKER=marker["VersionId"])
    assert content(s3) == b"an hour"


def test_a_replaced_object_is_restored_from_the_version_before(s3):
    s3.put_object(Bucket=BUCKET, Key=OBJECT_KEY, Body=b"")
    (before,) = [one for one in documented(s3, "list-object-versions")["Versions"] if not one["IsLatest"]]
    documented(s3, "copy-object", KEY=OBJECT_KEY, VERSION=before["VersionId"])
    assert content(s3) == b"an hour"
