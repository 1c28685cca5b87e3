"""Synth refuses rules that the embedded cloud would drop; its lists match the embedded cloud."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from iort_contract.catalog.rules import RULES
from stacks.ingest import RULE_ACTIONS, SQL_FUNCTIONS, rule_problems, sql_functions
from stacks.settings import ROOT
from tests.stacks.test_updates import identity
from verify.preflight.account import BOOTSTRAP, BOOTSTRAP_PARAMETER
from verify.preflight.deployed import STACKS

GOOD = {
    "sql": RULES["live"].statement(),
    "actions": [{"lambda": {"functionArn": "arn"}}],
    "errorAction": {"sqs": {}},
}


# --- refused rules ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sql", "called"),
    [
        (RULES["record"].statement(), {"topic", "timestamp", "floor"}),
        ("SELECT * FROM 'a/b'", set()),
        ("SELECT Topic (2) AS t, FLOOR(a) FROM 'a'", {"topic", "floor"}),
        ("SELECT 'sqrt(2)' AS text, 'it''s abs(1)' AS b FROM 'sin(1)/#'", set()),
        ("SELECT floor(abs(a)) FROM 'a' WHERE upper(b) = 'X'", {"floor", "abs", "upper"}),
        ("SELECT a FROM 'a' WHERE b IN (1, 2) AND (a > 1) OR (b)", set()),
    ],
)
def test_the_functions_in_sql_are_found(sql, called):
    assert sql_functions(sql) == called


def test_our_own_rules_are_accepted():
    for rule in RULES.values():
        assert rule_problems({**GOOD, "sql": rule.statement()}) == []
    assert (
        rule_problems({**GOOD, "actions": [{"republish": {"topic": RULES["pong"].action.topic("iort")}}]})
        == []
    )
    assert rule_problems({"sql": GOOD["sql"], "actions": []}) == []


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"sql": "SELECT sqrt(a) AS b FROM 'a'"}, "SQL function sqrt() is not implemented"),
        ({"sql": "SELECT * FROM 'a' WHERE upper(b) = 'X'"}, "SQL function upper() is not implemented"),
        (
            {"sql": "SELECT get_thing_shadow('a', 'r') FROM 'a'"},
            "SQL function get_thing_shadow() is not implemented",
        ),
        ({"actions": [{"s3": {}}]}, "rule action s3 is not implemented"),
        ({"actions": [{"lambda": {}}, {"timestream": {}}]}, "rule action timestream is not implemented"),
        ({"errorAction": {"cloudwatchLogs": {}}}, "rule action cloudwatchLogs is not implemented"),
        (
            {"actions": [{"republish": {"topic": "pong/${clientid()}"}}]},
            "republish topic pong/${clientid()} has a template that is not expanded",
        ),
        (
            {"actions": [{"republish": {"topic": "pong/${topic(3)}/${id}"}}]},
            "republish topic pong/${topic(3)}/${id} has a template that is not expanded",
        ),
    ],
)
def test_a_problem_of_a_rule_is_named(change, problem):
    assert rule_problems({**GOOD, **change}) == [problem]


@pytest.fixture(scope="module")
def refused(tmp_path_factory):
    """An app with rules that the embedded cloud would drop, synthesized."""
    from aws_cdk import App, Stack
    from aws_cdk import aws_iot as iot

    from stacks.ingest import refuse_what_the_embedded_cloud_drops

    rule = iot.CfnTopicRule
    app = App(outdir=str(tmp_path_factory.mktemp("cdk.out")))
    stack = Stack(app, "bad")
    republish = rule.RepublishActionProperty(role_arn="arn", topic="pong/${clientid()}")
    firehose = rule.FirehoseActionProperty(role_arn="arn", delivery_stream_name="s")
    for name, sql, action in (
        ("Action", "SELECT * FROM 'a'", rule.ActionProperty(firehose=firehose)),
        ("Sql", "SELECT sqrt(a) AS b FROM 'a'", rule.ActionProperty(republish=republish)),
    ):
        payload = rule.TopicRulePayloadProperty(sql=sql, actions=[action])
        iot.CfnTopicRule(stack, name, topic_rule_payload=payload)
    refuse_what_the_embedded_cloud_drops(app)
    return app.synth()


REASONS = (
    "the embedded cloud would silently drop this: rule action firehose is not implemented",
    "the embedded cloud would silently drop this: SQL function sqrt() is not implemented",
    "the embedded cloud would silently drop this: republish topic pong/${clientid()} has a template",
)


def test_synth_marks_the_rule_with_the_reason(refused):
    # The CLI reads this file; the assembly's own list of messages has a type that jsii does not know.
    metadata = json.loads((Path(refused.directory) / "bad.metadata.json").read_text())
    errors = {
        f"{path}: {entry['data']}"
        for path, entries in metadata.items()
        for entry in entries
        if entry["type"] == "aws:cdk:error"
    }
    assert len(errors) == 3
    assert all(any(reason in error for error in errors) for reason in REASONS)
    assert {error.split(":")[0] for error in errors} == {"/bad/Action", "/bad/Sql"}


def test_our_own_app_has_no_error(synthesized):
    for path in synthesized.folder.glob("*.metadata.json"):
        assert "aws:cdk:error" not in path.read_text()
    assert "aws:cdk:error" not in (synthesized.folder / "manifest.json").read_text()


def test_cdk_synth_fails_with_the_reason(refused, tmp_path):
    cdk, node = ROOT / "node_modules" / "aws-cdk" / "bin" / "cdk", ROOT / ".venv" / "bin" / "node"
    if not cdk.exists() or not node.exists():
        pytest.skip("the CDK CLI is not installed: run `make setup`")
    command = [node, cdk, "synth", "--quiet", "--app", refused.directory, "--no-notices"]
    env = {"PATH": os.environ["PATH"], "HOME": str(tmp_path), "CDK_DISABLE_CLI_TELEMETRY": "true"}
    done = subprocess.run(
        command, cwd=tmp_path, env=env, capture_output=True, text=True, check=False, timeout=240
    )
    assert done.returncode != 0
    for reason in REASONS:
        assert reason in done.stdout + done.stderr


# --- the lists are the embedded cloud's -------------------------------------------------------------


@pytest.fixture(scope="module")
def embedded():
    """The features of the pinned ministack with its fixes, read in a separate process, because
    the import changes it."""
    program = """
import json
from local.emulator import fixes
from local.emulator import package
package.use()
from ministack.services import iot
fixes.install()
ours = ["${topic()}", "a/${topic(3)}/b", "${ topic( 2 ) }"]
topics = [*ours, "${clientid()}", "${id}", "${topic(1)}/${newuuid()}"]
print(json.dumps({
    "actions": sorted(iot._RULE_ACTION_RESOURCE_KEYS),
    "functions": sorted(iot._IMPLEMENTED_SQL_FUNCS),
    "expanded": {
        topic: iot._expand_republish_topic({"republish": {"topic": topic}}, "ping/iort/car/rule")
        for topic in topics
    },
}))
"""
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_the_listed_actions_are_those_of_the_emulator(embedded):
    assert set(embedded["actions"]) == RULE_ACTIONS


def test_the_listed_sql_functions_are_those_of_the_emulator(embedded):
    assert set(embedded["functions"]) == SQL_FUNCTIONS


def test_a_republish_topic_is_accepted_only_if_the_emulator_expands_it(embedded):
    for topic, action in embedded["expanded"].items():
        expanded = action["republish"]["topic"]
        payload = {"sql": "SELECT * FROM 'a'", "actions": [{"republish": {"topic": topic}}]}
        assert (rule_problems(payload) == []) == ("${" not in expanded), topic


# The preflight knows all stacks and names.

# Kinds with a name of ours; the preflight asks for the name.
ASKED = {
    "AWS::IoT::Policy",
    "AWS::IoT::ProvisioningTemplate",
    "AWS::IoT::ThingGroup",
    "AWS::IoT::ThingType",
    "AWS::IoT::TopicRule",
    "AWS::CloudWatch::Dashboard",
    # One in each account, with separate items.
    "AWS::IoT::AccountAuditConfiguration",
    "AWS::IoT::Logging",
}
# Deleted with their stack in every stage, and made only by our stack.
NOT_ASKED = {
    "AWS::CloudWatch::Alarm",
    "AWS::IAM::Policy",
    "AWS::Lambda::EventInvokeConfig",
    "AWS::Lambda::EventSourceMapping",
    "AWS::S3::BucketPolicy",
    "AWS::SNS::Subscription",
}


def test_the_preflight_asks_for_every_stack(synthesized):
    assert {*synthesized.templates, "site"} == set(STACKS)


def test_the_preflight_asks_for_every_fixed_name(synthesized, production):
    named = {
        resource["Type"]
        for templates in (synthesized.templates, production.templates)
        for template in templates.values()
        for resource in template["Resources"].values()
        if identity(resource) is not None
    }
    assert named == ASKED | NOT_ASKED


def test_the_required_bootstrap_version_is_that_of_the_templates(synthesized):
    artifacts = json.loads((synthesized.folder / "manifest.json").read_text())["artifacts"].values()
    stacks = [one["properties"] for one in artifacts if one["type"] == "aws:cloudformation:stack"]
    assert {one["requiresBootstrapStackVersion"] for one in stacks} == {BOOTSTRAP}
    assert {one["bootstrapStackVersionSsmParameter"] for one in stacks} == {BOOTSTRAP_PARAMETER}
