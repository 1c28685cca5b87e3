"""AWS' limits of stacks and names are kept, also with the longest namespace."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any

import pytest

from iort_contract.limits import ContractError
from iort_contract.topics import check_namespace
from scripts import ceilings
from scripts.ceilings import Templates
from stacks.settings import AtOnce
from stacks.states import LONGEST_S, states
from stacks.variations import LONGEST_NAMESPACE, VARIATIONS
from tests.stacks.templates import has_schema, names, schema

# "CloudFormation quotas". The CDK passes every template through S3; a request may hold only 51,200 bytes.
TEMPLATE_BYTES = 1_000_000
SECTIONS = {"Resources": 500, "Outputs": 200, "Parameters": 200, "Mappings": 200}
LOGICAL_ID, EXPORT_NAME, STACK_NAME = 255, 255, r"[A-Za-z][A-Za-z0-9-]{0,127}"
# "IAM and AWS STS quotas": the policies within a role, white space not counted.
ROLE_POLICIES_CHARACTERS = 10_240

# Names with incomplete schemas: type and path to the rules of the service's own API.
NAMES = {
    # PutDashboard
    ("AWS::CloudWatch::Dashboard", "/properties/DashboardName"): r"[A-Za-z0-9_-]{1,255}",
    # CreateQueue
    ("AWS::SQS::Queue", "/properties/QueueName"): r"[A-Za-z0-9_-]{1,80}",
    # CreateTopic
    ("AWS::SNS::Topic", "/properties/TopicName"): r"[A-Za-z0-9_-]{1,256}",
    # CreateTable
    ("AWS::DynamoDB::Table", "/properties/TableName"): r"[A-Za-z0-9_.-]{3,255}",
    # PutMetricAlarm: no control characters.
    ("AWS::CloudWatch::Alarm", "/properties/AlarmName"): r"[\x20-\x7e]{1,255}",
    # PutRolePolicy
    ("AWS::IAM::Policy", "/properties/PolicyName"): r"[\w+=,.@-]{1,128}",
    # PutFunctionEventInvokeConfig
    ("AWS::Lambda::EventInvokeConfig", "/properties/Qualifier"): r"\$LATEST|[A-Za-z0-9$_-]{1,128}",
    # CreateOriginAccessControl and CreateResponseHeadersPolicy
    (
        "AWS::CloudFront::OriginAccessControl",
        "/properties/OriginAccessControlConfig/Name",
    ): r"[\x20-\x7e]{1,64}",
    (
        "AWS::CloudFront::ResponseHeadersPolicy",
        "/properties/ResponseHeadersPolicyConfig/Name",
    ): r"[A-Za-z0-9_-]{1,128}",
}


def too_much(stack: str, template: dict[str, Any]) -> Iterator[str]:
    """The parts of a template that exceed a limit of CloudFormation or IAM."""
    if not re.fullmatch(STACK_NAME, stack):
        yield f"{stack}: not a stack's name"
    if (size := len(json.dumps(template, indent=1).encode())) > TEMPLATE_BYTES:
        yield f"{stack}: {size} bytes"
    for section, limit in SECTIONS.items():
        if (count := len(template.get(section, {}))) > limit:
            yield f"{stack}: {count} {section}"
        yield from (
            f"{stack}: {one} is too long" for one in template.get(section, {}) if len(one) > LOGICAL_ID
        )
    for output in template.get("Outputs", {}).values():
        if len(name := output.get("Export", {}).get("Name", "")) > EXPORT_NAME:
            yield f"{stack}: {name} is too long"
    granted: dict[str, int] = {}
    for one in template.get("Resources", {}).values():
        if one["Type"] == "AWS::IAM::Policy":
            text = json.dumps(one["Properties"]["PolicyDocument"], separators=(",", ":"))
            for role in map(str, one["Properties"]["Roles"]):
                granted[role] = granted.get(role, 0) + len(text)
    yield from (f"{stack}: {role} {n}" for role, n in granted.items() if n > ROLE_POLICIES_CHARACTERS)


def misnamed(template: dict[str, Any]) -> Iterator[str]:
    """The physical names that are invalid at AWS, and those without known rules."""
    for logical_id, one in template["Resources"].items():
        if not has_schema(one):
            continue
        for path, value in names(one).items():
            where = f"{one['Type']} {logical_id} {path}"
            if not isinstance(value, str):
                # A reference to a resource that has a name itself.
                if value.keys() - {"Ref", "Fn::GetAtt", "Fn::ImportValue"}:
                    yield f"{where}: a name is made of {value}"
                continue
            known = _at(schema(one["Type"]), path)
            pattern = NAMES.get((one["Type"], path), known.get("pattern"))
            longest = known.get("maxLength")
            if pattern is None or (longest is None and (one["Type"], path) not in NAMES):
                yield f"{where}: nothing is known of how it may be named"
            elif len(value) > (longest or len(value)) or not re.fullmatch(pattern, value):
                yield f"{where}: {value}"


def _at(known: dict[str, Any], path: str) -> dict[str, Any]:
    """The schema of a property, through the definitions that it refers to."""
    found = known
    for step in path.split("/")[1:]:
        if reference := found.get("$ref"):
            found = known["definitions"][reference.rsplit("/", 1)[-1]].get("properties", {})
        elif "properties" in found and step != "properties":
            found = found["properties"]
        found = found.get(step, {})
    return found


@pytest.mark.parametrize("name", VARIATIONS)
def test_every_stack_is_within_the_limits(deployment, name):
    for stack, template in deployment(**VARIATIONS[name]).stacks.items():
        assert list(too_much(stack, template)) == []


@pytest.mark.parametrize("name", ["everything", "longest names"])
def test_every_name_is_valid_at_aws(deployment, name):
    templates = deployment(**VARIATIONS[name]).templates
    for template in templates.values():
        assert list(misnamed(template)) == []
    given = {path for t in templates.values() for one in t["Resources"].values() for path in named(one)}
    # A provisioning template's name may have 36 characters; our longest has 22.
    assert "/properties/TemplateName" in given


def named(resource):
    return names(resource) if has_schema(resource) else {}


def test_the_longest_namespace_is_the_contracts():
    assert check_namespace(LONGEST_NAMESPACE) == LONGEST_NAMESPACE
    with pytest.raises(ContractError):
        check_namespace(f"{LONGEST_NAMESPACE}n")


def resource(kind, **properties):
    return {"Resources": {"One": {"Type": f"AWS::{kind}", "Properties": properties}}}


@pytest.mark.parametrize(
    ("template", "found"),
    [
        (resource("IoT::ProvisioningTemplate", TemplateName="n" * 36), []),
        (resource("IoT::ProvisioningTemplate", TemplateName="n" * 37), ["TemplateName"]),
        (resource("IoT::TopicRule", RuleName="a_rule"), []),
        (resource("IoT::TopicRule", RuleName="a-rule"), ["RuleName"]),
        (resource("IAM::Role", RoleName="r" * 65), ["RoleName"]),
        (resource("Lambda::Function", FunctionName="f" * 65), ["nothing is known"]),
        (resource("S3::Bucket", BucketName="A"), ["BucketName"]),
        (resource("SQS::Queue", QueueName="q" * 81), ["QueueName"]),
        (resource("SNS::Topic", TopicName="t" * 257), ["TopicName"]),
        (resource("CloudWatch::Dashboard", DashboardName="a b"), ["DashboardName"]),
        (resource("CloudWatch::Alarm", AlarmName="a" * 256), ["AlarmName"]),
        (resource("IoT::ThingType", ThingTypeName="a b"), ["ThingTypeName"]),
        (resource("IoT::ThingGroup", ThingGroupName="g" * 129), ["ThingGroupName"]),
        (resource("IoT::Policy", PolicyName="p" * 129), ["PolicyName"]),
        (resource("Logs::LogGroup", LogGroupName="l" * 513), ["LogGroupName"]),
        (resource("SSM::Parameter", Name="a" * 2049), ["nothing is known"]),
        (resource("SQS::Queue", QueueName={"Fn::Join": ["", ["a", "b"]]}), ["a name is made of"]),
        (resource("SQS::Queue", QueueName={"Ref": "Other"}), []),
    ],
)
def test_an_invalid_name_is_found(template, found):
    assert len(texts := list(misnamed(template))) == len(found)
    assert all(part in text for part, text in zip(found, texts, strict=True))


@pytest.mark.parametrize(
    ("stack", "template", "found"),
    [
        ("iort-storage", {"Resources": {}}, 0),
        ("iort_storage", {}, 1),
        ("s", {"Resources": {f"R{i}": {"Type": ""} for i in range(501)}}, 1),
        ("s", {"Outputs": {f"O{i}": {} for i in range(201)}}, 1),
        ("s", {"Parameters": {f"P{i}": {} for i in range(201)}}, 1),
        ("s", {"Outputs": {"O" * 256: {}}}, 1),
        ("s", {"Outputs": {"O": {"Export": {"Name": "e" * 256}}}}, 1),
        ("s", {"Description": "d" * 1_000_000}, 1),
        ("s", resource("IAM::Policy", Roles=["r"], PolicyDocument={"Statement": ["x" * 10_240]}), 1),
    ],
)
def test_a_stack_over_a_limit_is_found(stack, template, found):
    assert len(list(too_much(stack, template))) == found


def test_a_run_without_drives_maps_over_nothing() -> None:
    """ "ItemReader (Map)" says nothing of a prefix without objects."""
    top = machine()
    assert [key for key, one in top.items() if '"Next": "Drives"' in json.dumps(one)] == ["AnyDrives"]
    choice = top["AnyDrives"]
    (listing,) = (one for one in top.values() if one.get("Next") == "AnyDrives")
    assert listing["Resource"] == "arn:aws:states:::aws-sdk:s3:listObjectsV2"
    reader = top["Drives"]["ItemReader"]["Parameters"]
    assert reader.items() <= listing["Parameters"].items()
    assert choice["Default"] == top["Drives"]["Next"] == "Findings"
    (rule,) = choice["Choices"]
    assert rule == {"Variable": f"{listing['ResultPath']}.Contents[0]", "IsPresent": True, "Next": "Drives"}
    # The maps over robots have one.
    assert top["Robots"]["Next"] == "AnyRobots"
    assert top["AnyRobots"]["Choices"] == [{"Variable": "$.robots", "NumericGreaterThan": 0, "Next": "Plans"}]
    assert top[top["AnyRobots"]["Default"]]["Result"] == {"findings": []}


def tasks(states):
    """All tasks of a machine, also those of its maps' items."""
    for name_, state in states.items():
        if state["Type"] == "Task":
            yield name_, state
        yield from tasks(state.get("ItemProcessor", {}).get("States", {}))


def machine():
    arns = dict.fromkeys(("Plan", "Analyse", "Evaluate", "Present"), "arn")
    return states("aws", arns, bucket="files", at_once=AtOnce(2, 1, 1))["States"]


def test_a_call_that_lambda_refuses_is_repeated_until_the_run_ends() -> None:
    """So no catch sees it, and it is no failed drive. Pauses with full jitter are half as long on average."""
    calls = [(key, task) for key, task in tasks(machine()) if "lambda" in task["Resource"]]
    assert {key for key, _ in calls} == {"Robots", "Plan", "Analyse", "Evaluate", "Present", "Failed"}
    for _, task in calls:
        first = next(
            one
            for one in task["Retry"]
            if {"Lambda.TooManyRequestsException", "States.ALL"} & set(one["ErrorEquals"])
        )
        assert first["ErrorEquals"] == ["Lambda.TooManyRequestsException"]
        assert first["MaxAttempts"] * first["MaxDelaySeconds"] / 2 >= 2 * LONGEST_S
        # "Step Functions service quotas": an execution ends at 25,000 events, an attempt has three.
        assert 3 * LONGEST_S / (first["MaxDelaySeconds"] / 2) < 25_000
        assert first["MaxDelaySeconds"] * 5 < LONGEST_S


def test_no_item_of_a_run_ends_another_one() -> None:
    """Nor do they share a history, a payload, or the five minutes of an express workflow."""
    maps = {key: state for key, state in machine().items() if state["Type"] == "Map"}
    assert maps.keys() == {"Plans", "Drives", "Findings"}
    for state in maps.values():
        assert state["ItemProcessor"]["ProcessorConfig"] == {
            "Mode": "DISTRIBUTED",
            "ExecutionType": "STANDARD",
        }
        assert state["ToleratedFailurePercentage"] == 100
        assert "ItemsPath" not in state
        first = state["ItemProcessor"]["States"][state["ItemProcessor"]["StartAt"]]
        assert [(one["ErrorEquals"], one["Next"]) for one in first["Catch"]] == [(["States.ALL"], "Failed")]


# What one robot and one stranger can spend is bounded by a property of a template, for all there is.


@pytest.fixture(scope="module")
def templates() -> Templates:
    return ceilings.default()


def ceilings_named(templates: Templates, kind: str) -> set[str]:
    return {
        key.rpartition("/")[2][:-8]
        for key, one in templates.resources.items()
        if one["Type"] == f"AWS::{kind}"
    }


def test_every_table_and_every_reader_of_a_queue_has_a_limit_in_the_table(templates):
    held = " ".join(one.held_by for one in ceilings.robot(templates))
    for table in ceilings_named(templates, "DynamoDB::Table"):
        assert f"`{table}`: `MaxWriteRequestUnits`" in held
    streams = {"SummarizeDynamoDBEventSource"}
    for mapping in ceilings_named(templates, "Lambda::EventSourceMapping"):
        if not any(mapping.startswith(stream) for stream in streams):
            assert f"`{mapping}`: `MaximumConcurrency`" in held


@pytest.mark.parametrize(
    ("kind", "name", "held"),
    [
        ("DynamoDB::Table", "Batches", "OnDemandThroughput"),
        ("Lambda::EventSourceMapping", "Tasks", "ScalingConfig"),
        ("S3::Bucket", "Files", "LifecycleConfiguration"),
    ],
)
def test_a_limit_that_is_taken_away_has_no_figure(templates, monkeypatch, kind, name, held):
    (key,) = [
        key
        for key, one in templates.resources.items()
        if one["Type"] == f"AWS::{kind}" and key.rpartition("/")[2][:-8] == name
    ]
    resource = templates.resources[key]
    without = {which: value for which, value in resource["Properties"].items() if which != held}
    monkeypatch.setitem(templates.resources, key, {**resource, "Properties": without})
    with pytest.raises(KeyError, match=held):
        list(ceilings.robot(templates))


def test_the_fleets_size_is_what_the_tables_take():
    of_one = next(iter(ceilings.robot(Templates(fleet_robots=1))))
    of_many = next(iter(ceilings.robot(Templates(fleet_robots=100))))
    assert (of_one.limit, of_many.limit) == ("662 write units a second", "5,612 write units a second")
    assert (round(of_one.usd_a_day), round(of_many.usd_a_day)) == (40, 342)


def test_a_stranger_finds_no_door_unless_the_page_is_on_the_web(templates):
    assert {one.usd_a_day for one in ceilings.stranger(templates)} == {0.0}
    public = Templates(site=True, live_transport="iot", site_robots=["car1"])
    open_ = [one.held_by for one in ceilings.stranger(public) if one.usd_a_day is None]
    assert open_ == ["`AWS::Cognito::IdentityPool`", "`AWS::CloudFront::Distribution`"]
