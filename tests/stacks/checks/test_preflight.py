"""The preflight knows all stacks and names."""

from __future__ import annotations

import json

from tests.stacks.updates.test_flips import identity
from verify.preflight.account import BOOTSTRAP, BOOTSTRAP_PARAMETER
from verify.preflight.deployed import STACKS

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
