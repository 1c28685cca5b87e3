"""Account-wide settings are optional, not on the embedded cloud, and deployed after all other stacks."""

from __future__ import annotations

import pytest
from aws_cdk import App, assertions

from stacks.account import Account
from stacks.settings import Settings, SettingsError
from tests.stacks.templates import layers

KINDS = {"AWS::IoT::AccountAuditConfiguration", "AWS::IoT::ScheduledAudit", "AWS::IoT::Logging"}


def kinds(**settings):
    stack = Account(App(), Settings(**settings))
    resources = assertions.Template.from_stack(stack).to_json().get("Resources", {})
    return {one["Type"] for one in resources.values() if one["Type"].startswith("AWS::IoT::")}


def test_every_scheduled_check_is_enabled(synthesized, reader):
    (audit,) = synthesized.resources("AWS::IoT::AccountAuditConfiguration").values()
    (daily,) = synthesized.resources("AWS::IoT::ScheduledAudit").values()
    enabled = {
        name.lower()
        for name, check in audit["AuditCheckConfigurations"].items()
        if check == {"Enabled": True}
    }
    assert enabled == {name.replace("_", "").lower() for name in daily["TargetCheckNames"]}
    assert {"unauthenticatedcognitoroleoverlypermissivecheck"} < enabled
    assert len(enabled) == 12
    assert daily["Frequency"] == "DAILY"
    assert audit["AccountId"] == {"Ref": "AWS::AccountId"}
    assert reader.text(audit["RoleArn"]) == "AuditRole.Arn"


def test_aws_iot_logs_errors(synthesized, reader):
    (log,) = synthesized.resources("AWS::IoT::Logging").values()
    assert log["DefaultLogLevel"] == "ERROR"
    assert reader.text(log["RoleArn"]) == "LogRole.Arn"


def test_each_account_wide_setting_is_optional():
    """This stack would fail in an account that already has them configured."""
    assert kinds() == set()
    assert kinds(iot_log_level="error") == {"AWS::IoT::Logging"}
    assert kinds(device_defender=True) == KINDS - {"AWS::IoT::Logging"}
    assert not Settings().account_wide
    # ministack supports neither.
    assert not Settings(embedded=True, device_defender=True, iot_log_level="error").account_wide


@pytest.fixture
def built(tmp_path):
    from app import build

    (tmp_path / "layer").mkdir()

    def build_with(**settings):
        app = App(outdir=str(tmp_path / "out"))
        build(app, Settings(**layers(tmp_path / "layer"), **settings))
        return app.synth().stacks

    return build_with


def test_no_stack_depends_on_the_account_stack(built):
    """It is deployed last, so that the other stacks exist if it fails."""
    found = {
        stack.stack_name: stack for stack in built(device_defender=True, site=True, site_robots=["car1"])
    }
    before = {
        name: {one.id for one in stack.dependencies if not one.id.endswith(".assets")}
        for name, stack in found.items()
    }
    assert before.pop("iort-account") == found.keys() - {"iort-account"}
    assert not any("iort-account" in each for each in before.values())


def test_the_embedded_cloud_has_no_account_wide_settings(built):
    stacks = built(embedded=True, site_robots=["*"], device_defender=True, iot_log_level="error")
    assert not KINDS & {one["Type"] for stack in stacks for one in stack.template["Resources"].values()}


@pytest.mark.parametrize(("given", "level"), [("off", ""), ("debug", "debug")])
def test_the_log_level_is_read_from_the_context(tmp_path, given, level):
    app = App(context={"iot_log_level": given, **layers(tmp_path)})
    assert Settings.from_context(app).iot_log_level == level


def test_an_unknown_log_level_is_refused(tmp_path):
    with pytest.raises(
        SettingsError, match=r"iot_log_level must be off, error, warn, info or debug, got 'loud'"
    ):
        Settings.from_context(App(context={"iot_log_level": "loud", **layers(tmp_path)}))
