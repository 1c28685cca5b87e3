"""Every deployed function under AWS' own runtime interface client: it starts, answers, fails and logs as
Lambda expects.
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from typing import Any

import pytest

pytest.importorskip("awslambdaric", reason="it has wheels for Linux alone")

from scripts.layer import compile_all
from stacks.settings import ROOT
from testkit.deployed import events, functions
from testkit.runtime import ERROR, PUBNUB_KEY, RESPONSE, RuntimeFailedError, started

LAYER = ROOT / "build" / "layer" / "local"
# Per function: the answer to its event, and the services that it calls.
ANSWERS: dict[str, tuple[Any, set[str]]] = {
    "admit": ({"allowProvisioning": True}, {"UpdateItem"}),
    "analyse": (None, {"GetItem", "Query", "Write", "PutItem"}),
    "answer": (None, {"UpdateItem", "Query", "Topic"}),
    "alert": (None, {"UpdateItem", "Mail"}),
    "archive": ({}, {"Query"}),
    "echo": (None, {"Topic"}),
    "evaluate": ({"drives": 0, "findings": 0}, {"Object", "Write"}),
    "incident": (None, {"GetItem"}),
    "later": (None, {"GetItem"}),
    "live": (None, {"GetParameter", "PubNub"}),
    "plan": ({"drives": 0}, {"GetItem", "Query", "Write"}),
    "presence": (None, {"UpdateItem"}),
    "present": ({"findings": 1, "mails": 0}, {"PutItem"}),
    "quarantine": ({"batchItemFailures": []}, {"UpdateItem"}),
    "query": ({"n": 0, "token": None}, {"Query"}),
    "summarize": ({"batchItemFailures": []}, {"GetItem", "Query", "BatchWriteItem", "UpdateItem"}),
    "upload": (None, {"Objects", "UpdateItem", "Topic"}),
}


@pytest.fixture(scope="module")
def deployed(tmp_path_factory):
    if not LAYER.is_dir():
        pytest.skip(f"{LAYER} is missing: run `make setup`")
    return functions(tmp_path_factory.mktemp("functions"), LAYER)


def test_every_function_has_an_event_and_an_answer(deployed):
    assert deployed.keys() == ANSWERS.keys() == events().keys()


@pytest.mark.parametrize("name", ANSWERS)
def test_each_function_answers_its_event_within_its_memory(deployed, tmp_path, name):
    expected, asked = ANSWERS[name]
    with started(deployed[name], tmp_path) as environment:
        answer = environment.invoke(events()[name])
        assert (answer.kind, answer.error_type) == (RESPONSE, None), answer.document
        if isinstance(expected, dict):
            assert answer.document.items() >= expected.items()
        else:
            assert answer.document is expected
        # Python alone takes ten.
        assert 10 < environment.peak_mb() < deployed[name].memory_mb
        # A second event in the same environment.
        assert environment.invoke(events()[name]).kind == RESPONSE
    assert set(environment.services.asked) == asked
    check_log(environment)


def check_log(environment):
    """Check that records are JSON with a level, that printed lines are metrics in CloudWatch's format, and
    that no line has keys.
    """
    assert not [line for line in [*environment.printed, *environment.logged] if PUBNUB_KEY in line]
    records = [json.loads(line) for line in environment.logged]
    assert all(record.keys() >= {"timestamp", "level", "message", "requestId"} for record in records)
    assert {record["level"] for record in records} <= {"INFO", "WARNING"}
    for line in environment.printed:
        metric = json.loads(line)
        assert "level" not in metric
        (directive,) = metric["_aws"]["CloudWatchMetrics"]
        for named in directive["Metrics"]:
            values = metric[named["Name"]]
            # "MetricValue": a number or a list of numbers; JSON's true is neither.
            listed = values if isinstance(values, list) else [values]
            assert {type(value) for value in listed} <= {int, float}
        for dimension in {one for several in directive["Dimensions"] for one in several}:
            assert isinstance(metric[dimension], str)


def test_a_failure_makes_an_error_document_and_an_error_record(deployed, tmp_path):
    with started(deployed["echo"], tmp_path) as environment:
        answer = environment.invoke({})
        # An error does not end the environment.
        assert environment.invoke(events()["echo"]).kind == RESPONSE
    assert (answer.kind, answer.document["errorType"]) == (ERROR, "KeyError")
    assert answer.document.keys() == {"errorMessage", "errorType", "requestId", "stackTrace"}
    (record,) = [one for one in map(json.loads, environment.logged) if one["level"] == "ERROR"]
    assert record.items() >= answer.document.items()


def test_an_import_error_is_reported_at_the_start(deployed, tmp_path):
    bare = replace(deployed["live"], layer=None)
    with pytest.raises(RuntimeFailedError, match="No module named 'pubnub'"), started(bare, tmp_path):
        pass


def test_the_layers_bytecode_is_deployed_and_sufficient(deployed, tmp_path):
    """A module is imported from its bytecode although its source would fail: Python does not compare them."""
    packages = deployed["live"].layer / "python"
    assert len(list(packages.rglob("*.pyc"))) > 200
    code = tmp_path / "code"
    code.mkdir()
    (code / "one.py").write_text("def handler(event, context):\n    return 'compiled'\n")
    compile_all(code, sys.executable)
    (code / "one.py").write_text("raise AssertionError('compiled again')\n")
    with started(replace(deployed["echo"], handler="one.handler", code=code), tmp_path) as environment:
        assert environment.invoke({}).document == "compiled"


@pytest.mark.parametrize("log_format", ["JSON", "Text"])
def test_a_printed_line_reaches_lambda_unchanged_unlike_a_logged_line(deployed, tmp_path, log_format):
    """Metrics are printed for this reason: with logs in JSON, `logging` writes a line inside a record,
    where CloudWatch does not search for metrics.
    """
    code = tmp_path / "code"
    code.mkdir()
    line = '{"_aws":{"Timestamp":1,"CloudWatchMetrics":[]},"One":1}'
    (code / "one.py").write_text(
        "import logging\n\n\ndef handler(event, context):\n"
        "    print(event['line'])\n    logging.getLogger().warning(event['line'])\n"
    )
    function = replace(deployed["echo"], handler="one.handler", code=code, log_format=log_format)
    with started(function, tmp_path) as environment:
        environment.invoke({"line": line})
    assert environment.printed == [line]
    (logged,) = environment.logged
    if log_format == "JSON":
        assert json.loads(logged)["message"] == line
        assert "_aws" not in json.loads(logged)
    else:
        assert logged.startswith("[WARNING]\t")
