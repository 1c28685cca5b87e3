"""What the preflight knows of the stacks is what the stacks are."""

from __future__ import annotations

import json

from tests.stacks.test_flips import identity
from verify.preflight.account import BOOTSTRAP, BOOTSTRAP_PARAMETER
from verify.preflight.deployed import STACKS

# Kinds that have a name of ours, and that the preflight asks for by it.
ASKED = {
    "AWS::IoT::Policy",
    "AWS::IoT::ProvisioningTemplate",
    "AWS::IoT::ThingGroup",
    "AWS::IoT::ThingType",
    "AWS::IoT::TopicRule",
    "AWS::CloudWatch::Dashboard",
    # An account's one each, by items of their own.
    "AWS::IoT::AccountAuditConfiguration",
    "AWS::IoT::Logging",
}
# Those that go with their stack, whatever the stage, and that nothing but our stack makes.
NOT_ASKED = {
    "AWS::CloudWatch::Alarm",
    "AWS::IAM::Policy",
    "AWS::Lambda::EventInvokeConfig",
    "AWS::Lambda::EventSourceMapping",
    "AWS::S3::BucketPolicy",
    "AWS::SNS::Subscription",
}


def test_it_asks_for_every_stack(synthesized):
    assert {*synthesized.templates, "site"} == set(STACKS)


def test_it_asks_for_every_name_that_is_part_of_the_design(synthesized, production):
    named = {
        resource["Type"]
        for templates in (synthesized.templates, production.templates)
        for template in templates.values()
        for resource in template["Resources"].values()
        if identity(resource) is not None
    }
    assert named == ASKED | NOT_ASKED


def test_the_bootstrap_stack_is_as_new_as_the_templates_need(synthesized):
    artifacts = json.loads((synthesized.folder / "manifest.json").read_text())["artifacts"].values()
    stacks = [one["properties"] for one in artifacts if one["type"] == "aws:cloudformation:stack"]
    assert {one["requiresBootstrapStackVersion"] for one in stacks} == {BOOTSTRAP}
    assert {one["bootstrapStackVersionSsmParameter"] for one in stacks} == {BOOTSTRAP_PARAMETER}
