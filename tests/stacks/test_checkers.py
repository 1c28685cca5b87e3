"""The independent checkers: that they see what is wrong, and that no excuse outlives what it was for."""

from __future__ import annotations

import importlib.util

import pytest

from stacks.acknowledged import single
from stacks.settings import ROOT, Settings


@pytest.fixture(scope="module")
def check_stacks():
    spec = importlib.util.spec_from_file_location("check_stacks", ROOT / "scripts" / "check_stacks.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_what_is_acknowledged_of_one_resource_is_there_in_some_stage(synthesized, production):
    there = synthesized.acknowledged | production.acknowledged
    for path in single(Settings(alarm_email="lab@example.org")):
        if path.startswith("site/"):
            continue  # an option that only `make check` synthesizes
        assert any(one.startswith(path) for one in there), f"stacks/acknowledged.py: {path} is not there"


def test_nag_and_lint_find_what_nobody_acknowledged(check_stacks, tmp_path):
    from aws_cdk import App, Stack, Validations
    from aws_cdk import aws_sqs as sqs
    from cdk_nag import AwsSolutionsChecks, ServerlessChecks

    app = App(outdir=str(tmp_path))
    stack = Stack(app, "Bad")
    sqs.CfnQueue(stack, "Queue").add_property_override("DelaySeconds", "soon")
    Validations.of(app).add_plugins(AwsSolutionsChecks(app), ServerlessChecks(app))
    with pytest.raises(RuntimeError, match="ValidationFailed"):
        app.synth()
    assert any("AwsSolutions-SQS3 on Bad/Queue" in finding for finding in check_stacks.nag(tmp_path))
    assert any("DelaySeconds" in finding for finding in check_stacks.lint(tmp_path))
