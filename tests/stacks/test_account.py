"""What is set for the whole account: on by default, off by option, and never on the embedded cloud."""

from __future__ import annotations

import pytest
from aws_cdk import App, assertions

from stacks.account import Account
from stacks.settings import Settings, SettingsError

KINDS = {"AWS::IoT::AccountAuditConfiguration", "AWS::IoT::ScheduledAudit", "AWS::IoT::Logging"}


def kinds(**settings):
    stack = Account(App(), "account", settings=Settings(**settings))
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
    assert len(enabled) == 10
    assert daily["Frequency"] == "DAILY"
    assert audit["AccountId"] == {"Ref": "AWS::AccountId"}
    assert reader.text(audit["RoleArn"]) == "AuditRole.Arn"


def test_iot_logs_errors(synthesized, reader):
    (log,) = synthesized.resources("AWS::IoT::Logging").values()
    assert log["DefaultLogLevel"] == "ERROR"
    assert reader.text(log["RoleArn"]) == "LogRole.Arn"


def test_each_is_off_by_option():
    assert kinds() == KINDS
    assert kinds(device_defender=False) == {"AWS::IoT::Logging"}
    assert kinds(iot_log_level="") == KINDS - {"AWS::IoT::Logging"}
    assert not Settings(device_defender=False, iot_log_level="").account_wide
    # ministack knows neither.
    assert not Settings(embedded=True).account_wide


def test_the_embedded_cloud_has_none_of_it(tmp_path):
    from app import build

    (tmp_path / "layer").mkdir()
    app = App(outdir=str(tmp_path / "out"))
    build(app, Settings(layer=tmp_path / "layer", embedded=True))
    resources = [one for stack in app.synth().stacks for one in stack.template["Resources"].values()]
    assert not KINDS & {one["Type"] for one in resources}


@pytest.mark.parametrize(("given", "level"), [("off", ""), ("debug", "debug")])
def test_the_level_of_the_context(tmp_path, given, level):
    app = App(context={"iot_log_level": given, "layer": str(tmp_path)})
    assert Settings.from_context(app).iot_log_level == level


def test_a_level_that_there_is_not(tmp_path):
    with pytest.raises(
        SettingsError, match=r"iot_log_level = 'loud': allowed is off, error, warn, info or debug"
    ):
        Settings.from_context(App(context={"iot_log_level": "loud", "layer": str(tmp_path)}))
