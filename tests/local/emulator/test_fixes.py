"""Every fix is still needed, and documented: a test fails when a new ministack needs one no more."""

from __future__ import annotations

import asyncio
import inspect
import re
import time

import pytest
from ministack.core import iam_actions
from ministack.services import cloudwatch, iot, lambda_svc

from local.deployment import ROOT
from local.emulator import fixes
from local.emulator.fixes import invocations
from tests.local.emulator import patch_probes

FOLDER = ROOT / "local" / "emulator" / "fixes"
FORM = re.compile(
    r"[^\n]+\.\n\n"
    r"AWS: (?P<aws>.+)\nministack: .+\nTest:\s+(?P<file>\S+)::(?P<test>\w+)\nPatch: (?P<patch>.+)",
    re.DOTALL,
)


@pytest.fixture(autouse=True)
def no_metrics_left():
    yield
    cloudwatch.reset()


def test_every_fix_is_installed():
    functions = {
        f"{path.stem}.{name}"
        for path in FOLDER.glob("[!_]*.py")
        for name in re.findall(r"^def close_(\w+)", path.read_text(), re.MULTILINE)
    }
    assert sorted(fixes.NAMES) == sorted(functions)


@pytest.mark.parametrize("name", fixes.NAMES)
def test_each_fix_is_needed_and_documented(name):
    fix = fixes.load(name)
    assert fix.is_open(), f"ministack needs the fix {name} no longer"
    form = FORM.fullmatch(inspect.getdoc(fix.close))
    assert form
    assert "https://" in form["aws"] or form["aws"].startswith("does not apply;")
    assert f"def {form['test']}(" in (ROOT / form["file"]).read_text()
    assert form["patch"].startswith("none; ")


@pytest.mark.parametrize(
    ("template", "topic"),
    [
        ("pong/iort/${topic(3)}/rule", "pong/iort/car1/rule"),
        ("${topic(1)}/x", "ping/x"),
        ("all/${topic()}", "all/ping/iort/car1/rule"),
        ("none/${ topic( 9 ) }/x", "none//x"),
        ("plain/topic", "plain/topic"),
    ],
)
def test_a_republish_topic_is_expanded(template, topic):
    action = iot._expand_republish_topic({"republish": {"topic": template}}, "ping/iort/car1/rule")
    assert action == {"republish": {"topic": topic}}


def test_wrapped_functions_accept_the_wrappers_arguments():
    assert list(inspect.signature(iot._run_rule_actions).parameters)[:5] == [
        "account_id", "region", "rule", "payload", "topic",
    ]  # fmt: skip
    assert list(inspect.signature(iot._dispatch_rule_to_lambda).parameters) == [
        "account_id", "region", "function_arn", "event",
    ]  # fmt: skip
    assert list(inspect.signature(iot.broker_publish).parameters)[:4] == [
        "account_id", "region", "topic", "payload",
    ]  # fmt: skip
    assert list(inspect.signature(iot._mtls_serve_conn).parameters) == ["reader", "writer"]
    for name in (
        "_get_func_record_for_ref_in_scope",
        "_execution_record_for_config",
        "_reserved_concurrency",
    ):
        assert callable(getattr(lambda_svc, name))


def test_a_message_batch_needs_the_permission_of_one_message():
    for target in ("SendMessageBatch", "SendMessage"):
        request = ("sqs", "POST", "/", {"x-amz-target": f"AmazonSQS.{target}"}, b"{}", {})
        assert iam_actions.extract_iam_action(*request) == "sqs:SendMessage"


def test_a_stream_request_names_its_stream():
    arn = iam_actions.extract_resource_arn
    asked = b'{"StreamArn": "arn:stream"}'
    assert arn("dynamodbstreams", "POST", "/", {}, asked, {}, "r", "0") == "arn:stream"
    assert arn("dynamodbstreams", "POST", "/", {}, b"{", {}, "r", "0") == "*"


def test_a_named_shadow_request_names_its_shadow():
    for query, found in (({"name": ["one"]}, "thing/car/one"), ({}, "thing/car")):
        request = ("iot-data", "GET", "/things/car/shadow", {}, b"", query, "r", "0")
        assert iam_actions.extract_resource_arn(*request) == f"arn:aws:iot:r:0:{found}"


def test_a_request_to_attach_a_policy_names_its_target():
    for body, found in ((b'{"target": "arn:aws:iot:r:0:cert/1"}', "arn:aws:iot:r:0:cert/1"), (b"{}", "*")):
        request = ("iot", "PUT", "/target-policies/robot", {}, body, {}, "r", "0")
        assert iam_actions.extract_resource_arn(*request) == found


def test_floor_rounds_down_in_a_rule():
    evaluate = iot._eval_select_function
    assert evaluate("floor", ["3.7"], "", b"", {}) == 3
    assert evaluate("floor", ["x"], "", b"", {"x": -1.5}) == -2
    assert evaluate("topic", ["1"], "a/b", b"", {}) == "a"


@pytest.mark.parametrize(
    "payload",
    [
        b'{"t":1,"a":' + b"[" * 50_000 + b"]" * 50_000 + b"}",
        b'{"t":1,"a":' + b"9" * 5_000 + b"}",
        b'{"t":1,"a":-1' + b"0" * 100_000 + b"}",
    ],
    ids=["nested", "digits", "negative"],
)
def test_rules_read_an_unparsable_payload_as_text(payload):
    assert iot._rule_message(payload) == payload.decode()
    assert iot._rule_message(b'{"t":1}') == {"t": 1}
    assert iot._rule_message(b"\xff") is iot._MISSING


def test_a_too_large_publish_is_rejected():
    large = b"x" * (iot._MAX_PAYLOAD_BYTES + 1)
    with pytest.raises(ConnectionError, match="payload must be at most 131072 bytes, got 131073"):
        asyncio.run(iot.broker_publish("0", "r", "t", large))


def test_an_event_that_breaks_the_emulator_goes_to_its_destination(monkeypatch):
    def broken(*_arguments):
        raise OSError("no space left on device")

    told = []
    monkeypatch.setattr(lambda_svc, "_execute_function_with_config_scope", broken)
    monkeypatch.setattr(lambda_svc, "_route_async_failure", lambda *arguments: told.append(arguments))
    settings = {"MaximumRetryAttempts": 0, "DestinationConfig": {"OnFailure": {"Destination": "arn:queue"}}}
    monkeypatch.setattr(lambda_svc, "_event_invoke_config", lambda *_: settings)
    record = {"config": {"FunctionName": "live"}}
    invocations.invoke("000000000000", "eu-west-1", record, {"n": 1}, time.monotonic())
    ((destination, name, event, result),) = told
    assert (destination, name, event) == ("arn:queue", "live", {"n": 1})
    assert result["body"]["errorMessage"] == "OSError: no space left on device"


def test_a_functions_credentials_cannot_be_derived():
    assert not patch_probes.function_credentials()
