"""The embedded cloud runs every rule of the catalogue, and the preflight knows all stacks and names."""

from __future__ import annotations

import json
import re
import subprocess
import sys

from iort_contract.catalog.rules import RULES, Republish
from stacks.settings import ROOT
from testkit.waiting import GUARD_S
from tests.stacks.test_updates import identity
from verify.preflight.account import BOOTSTRAP, BOOTSTRAP_PARAMETER
from verify.preflight.deployed import STACKS

# Words that may precede a bracket in a rule's SQL without being a function.
KEYWORDS = {"and", "as", "case", "else", "exists", "in", "not", "or", "select", "then", "when", "where"}


def test_the_embedded_cloud_has_what_our_rules_use():
    """It drops in silence a function or a topic's template that it does not know.

    The pinned ministack with its fixes is read in a separate process, because the import changes it.
    """
    topics = [rule.action.topic("iort") for rule in RULES.values() if isinstance(rule.action, Republish)]
    program = f"""
import json
from local.emulator import fixes
from local.emulator import package
package.use()
from ministack.services import iot
fixes.install()
actions = [{{"republish": {{"topic": topic}}}} for topic in {topics}]
expanded = [iot._expand_republish_topic(action, "ping/iort/car/rule") for action in actions]
print(json.dumps([sorted(iot._IMPLEMENTED_SQL_FUNCS), expanded]))
"""
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
        timeout=GUARD_S,
    )
    assert done.returncode == 0, done.stderr
    functions, expanded = json.loads(done.stdout.splitlines()[-1])
    for rule in RULES.values():
        sql = re.sub(r"'(?:[^']|'')*'", "''", rule.statement()).lower()
        called = set(re.findall(r"\b([a-z_]\w*)\s*\(", sql)) - KEYWORDS
        assert called <= set(functions), rule.name
    assert expanded
    assert not any("${" in str(action) for action in expanded)


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
