"""Every parameter that may be changed of a deployment: no update does what CloudFormation refuses, or loses
data."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from cfnlint.schema.manager import PROVIDER_SCHEMA_MANAGER

from stacks.settings import _READ, Settings, Thresholds

Templates = dict[str, dict[str, Any]]

# Parameters and the values that they are changed to and back from; the base has every default. What only
# changes properties, each of another resource, is changed at once: an app takes seconds to synthesize.
FLIPS: dict[str, dict[str, Any]] = {
    "stage": {"stage": "prod"},
    "mail": {"alarm_email": "lab@example.org"},
    "budget": {"budget_usd": 50, "alarm_email": "lab@example.org"},
    "kept key": {"keep_customer_key": True},
    "account": {"device_defender": True, "iot_log_level": "error"},
    "site": {"site": True},
    "old table": {"old_telemetry": True},
    "properties": {
        "retention_days": 7,
        "files_days": 30,
        "upload_gb_a_day": 5,
        "live_concurrency": 5,
        "robot_metrics": True,
        "function_logs": "all",
        "tags": {"team": "lab"},
        "thresholds": Thresholds(low_voltage_v=13.2, stream_behind_s=30),
    },
}
KEY = {"customer_key": True}
# Another namespace is another deployment, and so is the embedded cloud; the layer is a folder.
NOT_FLIPPED = {"namespace", "embedded", "layer"}

# What holds data, and is lost with it where it is replaced or goes.
HOLDS_DATA = {"AWS::DynamoDB::Table", "AWS::S3::Bucket", "AWS::SQS::Queue", "AWS::KMS::Key"}


@pytest.fixture(scope="module")
def templates(tmp_path_factory):
    """The templates of a deployment with these settings, synthesized once each."""
    from aws_cdk import App

    from app import build

    layer, made = tmp_path_factory.mktemp("layer"), {}
    (layer / "nothing.py").touch()

    def synthesized(**given: Any) -> Templates:
        key = repr(sorted(given.items()))
        if key not in made:
            app = App(outdir=str(tmp_path_factory.mktemp("cdk.out")))
            build(app, Settings(layer=layer, **given))
            made[key] = {stack.stack_name: stack.template for stack in app.synth().stacks}
        return made[key]

    return synthesized


def troubles(before: Templates, after: Templates) -> Iterator[str]:
    """What goes wrong when a deployment of the one is updated to the other. A stack that is in one of them
    alone is made, or stays as it is."""
    for stack in before.keys() & after.keys():
        imported = {
            name for other, template in before.items() if other != stack for name in imports(template)
        }
        for name in sorted((exports(before[stack]) - exports(after[stack])) & imported):
            yield f"{stack}: export {name} goes while others import it"
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
            # What is kept when it leaves its stack is not lost.
            kept = logical_id not in new and one.get("DeletionPolicy") == "Retain"
            if gone and not kept and one["Type"] in HOLDS_DATA and one["Type"] != "AWS::KMS::Key":
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


def schema(kind: str) -> dict[str, Any]:
    return dict(PROVIDER_SCHEMA_MANAGER.get_resource_schema("us-east-1", kind).schema)


def identity(resource: dict[str, Any]) -> str | None:
    """Type and name of what has a name of ours, by which there can be one only."""
    kind, properties = resource["Type"], resource.get("Properties", {})
    if kind.startswith(("Custom::", "AWS::CDK::")):
        return None
    own = [key.split("/")[2] for key in schema(kind)["primaryIdentifier"]]
    if not all(name in properties for name in own):
        # Its identifier is AWS', and may be made of a name: a queue's address, a topic's ARN.
        own = [f"{kind.split('::')[-1]}Name"]
    given = {name: properties[name] for name in own if name in properties}
    return f"{kind} {given}" if given else None


def is_replaced(old: dict[str, Any], new: dict[str, Any]) -> bool:
    """Whether a property changes that is given once for all."""
    if old["Type"] != new["Type"]:
        return True
    if old["Type"].startswith(("Custom::", "AWS::CDK::")):
        return False
    paths = schema(old["Type"]).get("createOnlyProperties", [])

    def at(resource: dict[str, Any], path: str) -> Any:
        value: Any = resource.get("Properties", {})
        for step in path.split("/")[2:]:
            value = value.get(step) if isinstance(value, dict) else None
        return value

    return any(at(old, path) != at(new, path) for path in paths)


def test_every_parameter_is_flipped():
    flipped = {name for flip in FLIPS.values() for name in flip}
    assert flipped | KEY.keys() | NOT_FLIPPED == _READ.keys() | {"thresholds"}


@pytest.mark.parametrize("flip", FLIPS)
def test_a_parameter_may_be_changed_and_changed_back(templates, flip):
    base, changed = templates(), templates(**FLIPS[flip])
    assert base != changed
    assert list(troubles(base, changed)) == []
    assert list(troubles(changed, base)) == []


def test_a_key_of_ones_own_comes_at_once_and_goes_in_two_steps(templates):
    base, kept, used = templates(), templates(keep_customer_key=True), templates(**KEY)
    assert list(troubles(base, used)) == []
    assert list(troubles(used, kept)) == []
    assert list(troubles(kept, used)) == []
    assert list(troubles(kept, base)) == []
    both = templates(**KEY, keep_customer_key=True)
    assert both == used
    # In one it does not: CloudFormation refuses it, and what is encrypted already would have no key.
    refused = list(troubles(used, base))
    assert refused
    assert all("goes while others import it" in one for one in refused)


TABLE = {"Type": "AWS::DynamoDB::Table", "Properties": {"TableName": "a", "BillingMode": "x"}}
RULE = {"Type": "AWS::IoT::TopicRule", "Properties": {"RuleName": "r"}}
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
    ],
)
def test_what_is_looked_for_is_found(before, after, trouble):
    found = list(troubles(before, after))
    assert (trouble in found) if trouble else found == []
