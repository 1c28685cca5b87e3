"""The independent checkers find faults, and a stale acknowledgement is an error."""

from __future__ import annotations

import importlib.util
import json

import pytest

from stacks.acknowledged import Acknowledged, single
from stacks.settings import ROOT, Settings


@pytest.fixture(scope="module")
def check_stacks():
    spec = importlib.util.spec_from_file_location("check_stacks", ROOT / "scripts" / "check_stacks.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_acknowledged_resource_exists_in_some_stage(synthesized, production):
    there = synthesized.acknowledged | production.acknowledged
    for path in single(Settings(alarm_email="lab@example.org")):
        if path.startswith(("site/", "fleet/Public")):
            continue  # options that only `make check` synthesizes
        assert any(one.startswith(path) for one in there), f"acknowledged.py: {path} is not there"


def test_nag_and_lint_find_an_unacknowledged_fault(check_stacks, tmp_path):
    from aws_cdk import App, Stack, Validations
    from aws_cdk import aws_sqs as sqs
    from cdk_nag import AwsSolutionsChecks, ServerlessChecks

    app = App(outdir=str(tmp_path))
    stack = Stack(app, "Bad")
    sqs.CfnQueue(stack, "Queue").add_property_override("DelaySeconds", "soon")
    Validations.of(app).add_plugins(AwsSolutionsChecks(app), ServerlessChecks(app))
    with pytest.raises(RuntimeError, match="ValidationFailed"):
        app.synth()
    found = [*check_stacks.nag(tmp_path), *check_stacks.lint(tmp_path)]
    assert any("AwsSolutions-SQS3 on Bad/Queue" in one.text for one in found)
    assert any("DelaySeconds" in one.text for one in found)
    assert not any(one.acknowledged for one in found)


def test_an_unneeded_acknowledgement_is_reported_by_name(check_stacks, tmp_path):
    """Each checker needs one acknowledgement; another one of the same rule is stale."""
    from aws_cdk import Acknowledgment, App, Stack, Validations
    from aws_cdk import aws_iam as iam
    from aws_cdk import aws_sqs as sqs
    from cdk_nag import AwsSolutionsChecks, ServerlessChecks

    app = App(outdir=str(tmp_path))
    stack = Stack(app, "iort-bad")
    lone, end = sqs.CfnQueue(stack, "Lone"), sqs.CfnQueue(stack, "End")
    redrive = {"deadLetterTargetArn": end.attr_arn, "maxReceiveCount": 1}
    sqs.CfnQueue(stack, "Backed", redrive_policy=redrive)
    for queue in (lone, end):
        Validations.of(queue).acknowledge(Acknowledgment(id="AwsSolutions::AwsSolutions-SQS3", reason="a"))
    early, late = iam.CfnGroup(stack, "Early"), iam.CfnGroup(stack, "Late")
    late.add_resource_dependency(early)
    late.add_property_override("GroupName", early.ref)
    for group in (early, late):
        group.add_metadata("cfn-lint", {"config": {"ignore_checks": ["W3005"]}})
    Validations.of(app).add_plugins(AwsSolutionsChecks(app), ServerlessChecks(app))
    with pytest.raises(RuntimeError, match="ValidationFailed"):
        app.synth()
    found = [*check_stacks.nag(tmp_path), *check_stacks.lint(tmp_path)]
    known = [
        Acknowledged(f"bad/{name}", rule, "a")
        for name, rule in (
            *((name, "AwsSolutions-SQS3") for name in ("Lone", "End")),
            *((name, "W3005") for name in ("Early", "Late")),
            ("Lone", "CKV_AWS_27"),
        )
    ]
    assert not any("W3005" in one.text for one in found if not one.acknowledged)

    def gone(**options):
        return [finding.split(":")[0] for finding in check_stacks.stale({"dev": known}, found, **options)]

    assert gone(unjudged=("CKV",)) == ["AwsSolutions-SQS3 on bad/End", "W3005 on bad/Early"]
    assert "CKV_AWS_27 on bad/Lone" in gone()


def test_equal_templates_are_checked_once_and_different_ones_each(check_stacks, tmp_path):
    for folder, queue in (("a", {}), ("b", {}), ("c", {"DelaySeconds": "soon"})):
        (tmp_path / folder).mkdir()
        resource = {"Type": "AWS::SQS::Queue", "Properties": queue}
        (tmp_path / folder / "one.template.json").write_text(json.dumps({"Resources": {"Queue": resource}}))
    metadata = {"/One/Queue": [{"type": "aws:cdk:logicalId", "data": "Queue"}]}
    (tmp_path / "c" / "one.metadata.json").write_text(json.dumps(metadata))
    read = check_stacks.templates_below(tmp_path / "a", tmp_path / "b", tmp_path / "c")
    assert [template.parent.name for template in read] == ["a", "c"]
    found = check_stacks.lint(tmp_path / "a", tmp_path / "b", tmp_path / "c")
    assert [one.path for one in found] == ["One/Queue"]
