"""Metrics: a line of the embedded metric format, of names that the contract knows."""

from __future__ import annotations

import json
import time

import pytest

import contract
from functions.metrics import emit


@pytest.fixture(autouse=True)
def deployment(monkeypatch):
    monkeypatch.setenv("NAMESPACE", "lab2")


def test_every_metric_of_the_contract_is_a_valid_line(capsys):
    for function, names in contract.METRICS.items():
        before_ms = time.time_ns() // 1_000_000
        emit(function, **dict.fromkeys(names, 2.5))
        line = json.loads(capsys.readouterr().out)
        # CloudWatch, "Specification: Embedded metric format": what each of these must be.
        metadata = line["_aws"]
        assert before_ms <= metadata["Timestamp"] <= before_ms + 60_000
        assert isinstance(metadata["Timestamp"], int)
        (directive,) = metadata["CloudWatchMetrics"]
        assert directive["Namespace"] == contract.METRIC_NAMESPACE
        assert directive["Dimensions"] == [["Deployment", "Function"]]
        assert (line["Deployment"], line["Function"]) == ("lab2", function)
        assert {metric["Name"] for metric in directive["Metrics"]} == set(names)
        for metric in directive["Metrics"]:
            assert metric["Unit"] == {"Ms": "Milliseconds", "es": "Bytes"}.get(metric["Name"][-2:], "Count")
            assert line[metric["Name"]] == 2.5


def test_a_zero_is_not_written_and_a_line_of_zeros_neither(capsys):
    emit("live", LivePublished=1, LiveStale=0)
    line = json.loads(capsys.readouterr().out)
    assert [metric["Name"] for metric in line["_aws"]["CloudWatchMetrics"][0]["Metrics"]] == ["LivePublished"]
    assert "LiveStale" not in line
    emit("live", LivePublished=0)
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("value", [0, 1])
def test_an_unknown_name_is_refused_even_when_it_is_zero(value, capsys):
    with pytest.raises(KeyError, match="LiveLost"):
        emit("live", LivePublished=1, LiveLost=value)
    with pytest.raises(KeyError, match="nothing"):
        emit("nothing", LivePublished=value)
    assert capsys.readouterr().out == ""
