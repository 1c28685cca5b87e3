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
            endings = {"Ms": "Milliseconds", "Bytes": "Bytes", "Volts": "None", "DegC": "None"}
            units = [unit for ending, unit in endings.items() if metric["Name"].endswith(ending)]
            assert metric["Unit"] == (units or ["Count"])[0]
            assert line[metric["Name"]] == 2.5


def test_a_list_is_values_and_a_robot_a_metric_of_its_own(capsys):
    emit("health", robot="car7", BatteryVolts=[11.5, 11.25], TemperatureDegC=[])
    line = json.loads(capsys.readouterr().out)
    (directive,) = line["_aws"]["CloudWatchMetrics"]
    assert directive["Dimensions"] == [["Deployment", "Function"], ["Deployment", "Function", "Robot"]]
    assert (line["Robot"], line["BatteryVolts"]) == ("car7", [11.5, 11.25])
    assert directive["Metrics"] == [{"Name": "BatteryVolts", "Unit": "None"}]
    # "Specification: Embedded metric format": an array of up to 100 members.
    emit("health", BatteryVolts=[float(i) for i in range(150)])
    assert json.loads(capsys.readouterr().out)["BatteryVolts"] == [float(i) for i in range(50, 150)]


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
