"""The properties of the stacks' rules, tables, functions and logs."""

from __future__ import annotations

import json
import re

import pytest

from iort_contract.archive import ARCHIVE_PREFIX
from iort_contract.catalog.rules import RULES
from iort_contract.cloud import ANALYSIS_PREFIX, IOT, PUBNUB
from iort_station.cost.model import RECORDS_A_CALL, WINDOW_S
from stacks.checks import granted, several
from stacks.settings import A_ROBOTS_MOST, Settings
from stacks.variations import EVERYTHING
from tests.stacks.templates import Reader, name
from tests.stacks.test_updates import identity

WAYS = {IOT: {}, PUBNUB: {"live_transport": PUBNUB}}


# --- rules ------------------------------------------------------------------------------------------


def test_no_rule_selects_by_an_or():
    """By AWS' SQL an OR with a comparison with null is Undefined, and so selects nothing."""
    assert not [rule for rule in RULES.values() if " or " in rule.statement().lower()]


def test_the_default_deployment_needs_no_third_party(deployment):
    """Lambda 1 stays, and its export, so that one deployment changes the way."""
    templates = {way: deployment(**given).templates for way, given in WAYS.items()}
    rules = {
        way: {
            one["Properties"]["RuleName"].removeprefix("iort_")
            for one in each["ingest"]["Resources"].values()
            if one["Type"] == "AWS::IoT::TopicRule"
        }
        for way, each in templates.items()
    }
    assert rules == {IOT: RULES.keys() - {"live"}, PUBNUB: RULES.keys()}
    for way, each in templates.items():
        assert each["fleet"]["Outputs"]["LiveTransport"]["Value"] == way
        assert not any(one.startswith("Public") for one in each["fleet"]["Outputs"])
    assert templates[IOT]["processing"] == templates[PUBNUB]["processing"]


# --- tables -----------------------------------------------------------------------------------------


def test_relays_are_off_by_default_and_cost_nothing_then(deployment, synthesized):
    kind = "AWS::KinesisVideo::SignalingChannel"
    assert len(synthesized.resources(kind)) == 1
    assert deployment().resources(kind) == {}
    assert "kinesisvideo" not in json.dumps(dict(deployment().templates))


def test_no_table_takes_more_than_the_fleet_and_one_robot_at_its_worst(deployment):
    def most(**settings):
        resources = deployment(**settings).templates["storage"]["Resources"]
        return {
            name(key): one["Properties"]["OnDemandThroughput"]["MaxWriteRequestUnits"]
            for key, one in resources.items()
            if one["Type"] == "AWS::DynamoDB::Table"
        }

    few, many = most(fleet_robots=5), most(fleet_robots=105)
    assert few.keys() == {"Batches", "Summary", "Robots", "Archive", "Quarantine", "Findings"}
    # A robot with lidar stores 50 KB a second; a hostile one what AWS IoT takes from a connection.
    assert (many["Batches"] - few["Batches"]) / 100 == 50
    assert min(few["Batches"], few["Summary"]) > A_ROBOTS_MOST == 612
    assert Settings().writes == most()


@pytest.mark.parametrize(
    ("account", "queues", "maps", "left"),
    [
        (10, {"Archive": 2, "Later": 2, "Quarantine": 2}, {"Plans": 1, "Drives": 1, "Findings": 1}, 3),
        (
            1000,
            {"Archive": 10, "Later": 2, "Quarantine": 2},
            {"Plans": 10, "Drives": 40, "Findings": 10},
            900,
        ),
    ],
)
def test_what_nobody_waits_for_leaves_executions_to_what_robots_and_people_wait_for(
    deployment, account, queues, maps, left
):
    """Of a queue's mapping AWS takes no limit under 2; the maps of a run follow each other."""
    given = {} if account == 10 else {"account_concurrency": account}
    resources = [
        one for template in deployment(**given).templates.values() for one in template["Resources"].values()
    ]

    def of(kind):
        return [one["Properties"] for one in resources if one["Type"] == kind]

    limits = {
        name(one["FunctionName"]["Ref"]): one["ScalingConfig"]["MaximumConcurrency"]
        for one in of("AWS::Lambda::EventSourceMapping")
        # Lambda 2 has as many as the table's stream has shards, and is one of those that stay.
        if "StreamArn" not in str(one["EventSourceArn"]) and "StartingPosition" not in one
    }
    (machine,) = of("AWS::StepFunctions::StateMachine")
    text = machine["DefinitionString"]
    parts = text["Fn::Join"][1] if isinstance(text, dict) else [text]
    states = json.loads("".join(one if isinstance(one, str) else "x" for one in parts))["States"]
    at_once = {key: state["MaxConcurrency"] for key, state in states.items() if state["Type"] == "Map"}

    assert (limits, at_once) == (queues, maps)
    assert account - sum(limits.values()) - max(at_once.values()) >= left
    reserved = [one for one in of("AWS::Lambda::Function") if "ReservedConcurrentExecutions" in one]
    assert reserved == []


def test_a_message_of_a_queue_is_not_read_twice_at_once(synthesized):
    """AWS advises six times the timeout of the queue's reader."""
    functions = synthesized.resources("AWS::Lambda::Function")
    queues = {name(k): v for k, v in synthesized.resources("AWS::SQS::Queue").items()}
    readers = {"Rejected": "Quarantine", "PutOff": "Later", "ArchiveTasks": "Archive"}
    timeouts = {name(k): v["Timeout"] for k, v in functions.items()}
    assert {
        queue: queues[queue]["VisibilityTimeout"] / timeouts[reader] for queue, reader in readers.items()
    } == (dict.fromkeys(readers, 6))


def test_the_cost_model_knows_the_streams_window(synthesized):
    (mapping,) = (
        one
        for one in synthesized.resources("AWS::Lambda::EventSourceMapping").values()
        if "StartingPosition" in one
    )
    assert (mapping["MaximumBatchingWindowInSeconds"], mapping["BatchSize"]) == (WINDOW_S, RECORDS_A_CALL)


def test_two_deployments_can_share_an_account(deployment, synthesized):
    """Every name that CloudFormation does not generate contains the namespace."""
    app = deployment(namespace="lab2", retention_days=7, device_defender=True, iot_log_level="error")
    assert app.stacks.keys() == {f"lab2-{noun}" for noun in synthesized.templates}
    # An alarm's advice names a program.
    text = json.dumps(app.stacks).replace("`iort-agent ", "")
    assert not any(word in text for word in ("iort/", "/iort", "iort_", "iort-", "iort."))
    assert f"+ {7 * 86_400} AS expires_s" in text


def test_two_environments_in_one_account_share_no_name(deployment):
    """A stage dev and a stage prod with everything, beside each other: stacks, exports, and what has a name
    of ours. The account's own settings exist once, and the preflight asks for them; a role's policy is within
    its role."""
    apart = {"AWS::IoT::AccountAuditConfiguration", "AWS::IoT::Logging", "AWS::IAM::Policy"}

    def names(**settings):
        templates = deployment(**settings).stacks
        yield from (("stack", stack) for stack in templates)
        for template in templates.values():
            for output in template.get("Outputs", {}).values():
                if "Export" in output:
                    yield "export", json.dumps(output["Export"]["Name"])
            for one in template["Resources"].values():
                # A reference is another name in each deployment.
                if one["Type"] not in apart and "'Ref'" not in (text := str(identity(one))) != "None":
                    yield one["Type"], text

    dev = set(names(**{**EVERYTHING, "stage": "dev"}))
    prod = set(names(**EVERYTHING, namespace="lab2"))
    assert {kind for kind, _ in dev} == {kind for kind, _ in prod} >= {"stack", "export", "AWS::IoT::Policy"}
    assert not dev & prod


# --- files ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("days", "kept"),
    [(7, {"old": 7}), (30, {"old": 30}), (365, {"rare": None, "old": 365}), (0, {"rare": None})],
)
def test_files_expire_after_the_configured_days(tmp_path, days, kept):
    from aws_cdk import App

    from stacks.storage import Storage

    app = App(outdir=str(tmp_path))
    Storage(app, Settings(files_days=days))
    (template,) = [stack.template for stack in app.synth().stacks]
    (bucket,) = [r["Properties"] for r in template["Resources"].values() if r["Type"] == "AWS::S3::Bucket"]
    rules = bucket["LifecycleConfiguration"]["Rules"]
    assert {r["Id"]: r.get("ExpirationInDays") for r in rules if r["Id"] in {"rare", "old"}} == kept


def test_who_may_delete_what_by_prefix(synthesized, production):
    """No role may delete an earlier version, or change how long one stays."""
    for app in (synthesized, production):
        reader = Reader(app)
        deletes = set()
        for template in app.templates.values():
            for logical_id, one in template["Resources"].items():
                for role, statement in granted(logical_id, one["Type"], one.get("Properties", {})):
                    for action in several(statement["Action"]):
                        if re.fullmatch(r"s3:(Delete|Put(Lifecycle|BucketVersioning)|Bypass).*", action):
                            deletes |= {(role, action, text) for text in reader.texts(statement["Resource"])}
        assert deletes == {
            ("ArchiveRole", "s3:DeleteObject", f"Files.Arn/{ARCHIVE_PREFIX}*"),
            ("PresentRole", "s3:DeleteObject", f"Files.Arn/{ANALYSIS_PREFIX}robot=*"),
        }
