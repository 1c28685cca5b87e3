"""The gaps are closed, and are still gaps: a release of the emulator that closes one tells us here."""

from __future__ import annotations

import asyncio
import inspect
import json
import time

import pytest
from ministack.core import iam_actions
from ministack.services import iot, iot_data, lambda_svc

from local import gaps, stream_gap


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
def test_republish_topic_is_expanded(template, topic):
    assert gaps.expand_topic(template, "ping/iort/car1/rule") == topic


def test_wrapped_functions_take_what_the_wrappers_pass():
    assert list(inspect.signature(iot._run_rule_actions).parameters)[:5] == [
        "account_id", "region", "rule", "payload", "topic",
    ]  # fmt: skip
    assert list(inspect.signature(iot._dispatch_rule_to_lambda).parameters) == [
        "account_id", "region", "function_arn", "event",
    ]  # fmt: skip
    assert list(inspect.signature(iot.broker_publish).parameters)[:4] == [
        "account_id", "region", "topic", "payload",
    ]  # fmt: skip
    assert list(inspect.signature(iot._fleet_provisioning_reply).parameters) == [
        "account_id", "region", "operation", "template_name", "payload", "connection",
    ]  # fmt: skip
    for handle in (iot.handle_request, iot_data.handle_request):
        assert list(inspect.signature(handle).parameters) == [
            "method", "path", "headers", "body", "query_params",
        ]  # fmt: skip
    assert list(inspect.signature(iot._mtls_serve_conn).parameters) == ["reader", "writer"]
    assert {"cleanup", "disconnect_reason", "send_bytes"} <= set(dir(iot._WSSession))
    for name in (
        "_get_func_record_for_ref_in_scope",
        "_execution_record_for_config",
        "_reserved_concurrency",
    ):
        assert callable(getattr(lambda_svc, name))


def test_gaps_are_still_gaps():
    assert "floor" not in iot._IMPLEMENTED_SQL_FUNCS
    assert "topic(" not in inspect.getsource(iot._dispatch_rule_republish)
    assert "128 * 1024" not in inspect.getsource(iot.broker_publish)
    assert iot._parse_fleet_provisioning_topic("$aws/certificates/create-from-csr/json") is None
    assert "secure" not in inspect.getsource(iot._dispatch_rule_sqs)
    batch = ("sqs", "POST", "/", {"x-amz-target": "AmazonSQS.SendMessageBatch"}, b"{}", {})
    assert iam_actions.extract_iam_action(*batch) == "sqs:SendMessageBatch"
    assert gaps._as_one_message(iam_actions.extract_iam_action)(*batch) == "sqs:SendMessage"
    # local/cut_sessions.py
    assert "_connected_clients" not in inspect.getsource(iot._handle_certificate)
    assert "/connections/" not in inspect.getsource(iot_data)
    assert iot._mtls_resolve_identity(None) is not None
    # local/listener_gap.py
    assert 'host="0.0.0.0"' in inspect.getsource(iot._mtls_start_locked)
    assert "timeout" not in inspect.getsource(iot._mtls_serve_conn) + inspect.getsource(iot._MtlsAcceptor)
    assert "Bisect" not in inspect.getsource(lambda_svc._poll_dynamodb_streams)
    asked = json.dumps({"StreamArn": "arn:stream"}).encode()
    request = ("dynamodbstreams", "POST", "/", {}, asked, {}, "r", "0")
    assert iam_actions.extract_resource_arn(*request) == "*"
    assert stream_gap._knowing_streams(iam_actions.extract_resource_arn)(*request) == "arn:stream"


def test_floor():
    evaluate = gaps._with_floor(iot._eval_select_function)
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
def test_a_payload_that_python_does_not_read_is_a_text_to_the_rules(payload):
    with pytest.raises((RecursionError, ValueError)):
        iot._rule_message(payload)
    read = gaps.as_text_if_unreadable(iot._rule_message)
    assert read(payload) == payload.decode()
    assert read(b'{"t":1}') == {"t": 1}
    assert read(b"\xff") is iot._MISSING


def test_large_publish_is_refused_before_anything_happens():
    async def publish(*_args, **_named):
        raise AssertionError

    refuse = gaps._refusing_large(publish)
    with pytest.raises(gaps.MessageTooLargeError):
        asyncio.run(refuse("0", "r", "t", b"x" * (gaps.AWS_MESSAGE_BYTES + 1)))


def test_an_event_whose_invocation_breaks_the_emulator_goes_to_its_destination(monkeypatch):
    def broken(*_arguments):
        raise OSError("no space left on device")

    told = []
    monkeypatch.setattr(lambda_svc, "_execute_function_with_config_scope", broken)
    monkeypatch.setattr(lambda_svc, "_route_async_failure", lambda *arguments: told.append(arguments))
    settings = {"MaximumRetryAttempts": 0, "DestinationConfig": {"OnFailure": {"Destination": "arn:queue"}}}
    monkeypatch.setattr(lambda_svc, "_event_invoke_config", lambda *_: settings)
    record = {"config": {"FunctionName": "live"}}
    gaps._invoke("000000000000", "eu-west-1", record, {"n": 1}, time.monotonic())
    ((destination, name, event, result),) = told
    assert (destination, name, event) == ("arn:queue", "live", {"n": 1})
    assert result["body"]["errorMessage"] == "OSError: no space left on device"
