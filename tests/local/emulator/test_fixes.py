"""Every fix is documented; a test fails when a new ministack has changed what a fix wraps."""

from __future__ import annotations

import hashlib
import inspect
import json
import os
import re
import subprocess
import sys
import time

import pytest
from ministack import app
from ministack.core import iam_actions, lambda_runtime
from ministack.services import iot, lambda_svc

from local.deployment import ROOT
from local.emulator import fixes, package
from local.emulator.fixes import invocations
from testkit.waiting import GUARD_S

FORM = re.compile(
    r"[^\n]+\.\n\n"
    r"AWS: (?P<aws>.+)\nministack: .+\nTest:\s+(?P<file>\S+)::(?P<test>\w+)\nPatch: (?P<patch>.+)",
    re.DOTALL,
)


@pytest.mark.parametrize("close", [close for _, close in fixes.every()], ids=lambda close: close.__name__)
def test_each_fix_is_documented(close):
    form = FORM.fullmatch(inspect.getdoc(close))
    assert form
    assert "https://" in form["aws"] or form["aws"].startswith("does not apply;")
    assert f"def {form['test']}(" in (ROOT / form["file"]).read_text()
    assert form["patch"].startswith("none; ")


def test_what_the_fixes_replace_is_what_they_were_written_for(tmp_path, snapshot):
    """Where a new ministack differs, look whether the fix is needed and still right; then
    `pytest --snapshot-update`."""
    done = subprocess.run(
        [sys.executable, "-m", "tests.local.emulator.replaced", tmp_path / "ledger.db"],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(package.folder()), "IORT_BROKER_CERTIFICATE": __file__},
        capture_output=True,
        text=True,
        check=False,
        timeout=GUARD_S,
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == snapshot


@pytest.mark.parametrize(
    ("request_", "resource"),
    [
        (("dynamodbstreams", "POST", "/", {}, b'{"StreamArn": "arn:stream"}', {}), "arn:stream"),
        (("dynamodbstreams", "POST", "/", {}, b"{", {}), "*"),
        (
            ("iot-data", "GET", "/things/car/shadow", {}, b"", {"name": ["one"]}),
            "arn:aws:iot:r:0:thing/car/one",
        ),
        (("iot-data", "GET", "/things/car/shadow", {}, b"", {}), "arn:aws:iot:r:0:thing/car"),
        (("iot", "PUT", "/target-policies/robot", {}, b'{"target": "arn:cert"}', {}), "arn:cert"),
        (("iot", "PUT", "/target-policies/robot", {}, b"{}", {}), "*"),
    ],
)
def test_a_request_names_its_resource_as_on_aws(request_, resource):
    assert iam_actions.extract_resource_arn(*request_, "r", "0") == resource


@pytest.mark.parametrize("target", ["SendMessageBatch", "SendMessage"])
def test_a_message_batch_needs_the_permission_of_one_message(target):
    request = ("sqs", "POST", "/", {"x-amz-target": f"AmazonSQS.{target}"}, b"{}", {})
    assert iam_actions.extract_iam_action(*request) == "sqs:SendMessage"


def test_a_republish_topic_is_expanded():
    for template, topic in (
        ("pong/iort/${topic(3)}/rule", "pong/iort/car1/rule"),
        ("all/${topic()}", "all/ping/iort/car1/rule"),
        ("none/${ topic( 9 ) }/x", "none//x"),
    ):
        action = iot._expand_republish_topic({"republish": {"topic": template}}, "ping/iort/car1/rule")
        assert action == {"republish": {"topic": topic}}


def test_a_functions_credentials_cannot_be_derived(monkeypatch):
    monkeypatch.setattr(app, "AUTH", True)
    config = {
        "FunctionArn": "arn:aws:lambda:eu-west-1:000000000000:function:one",
        "Role": "arn:aws:iam::000000000000:role/one",
    }
    first, second = (lambda_runtime.execution_credentials(dict(config)) for _ in range(2))
    digest = hashlib.sha256("{FunctionArn}:{Role}".format(**config).encode()).hexdigest()
    derived = hashlib.sha256(f"secret:{digest}".encode()).hexdigest()
    assert first["AWS_SECRET_ACCESS_KEY"] == second["AWS_SECRET_ACCESS_KEY"] != derived


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
