"""Health: the metrics that follow from a car's batches."""

from __future__ import annotations

import pytest

from functions.shared.metrics import MOST_VALUES
from functions.shared.summary import measure, together
from iort_contract.catalog.metrics import metrics_of
from iort_contract.catalog.streams import AGENT_STREAM, RTT_STREAM
from iort_contract.catalog.vesc import TEMPERATURES, hottest_degc
from iort_contract.messages.batch import Batch


def batch(columns, *, times_us=None):
    length = len(next(iter(columns.values())))
    return Batch("0" * 8, 0, times_us or [1_000_000 + 20_000 * i for i in range(length)], columns)


def test_the_worst_values_of_a_drive_are_measured():
    first = batch({"voltage_input": [12.1, 11.9], "temp_fet": [40.0, 41.5], "fault_code": [0, 5]})
    second = batch({"voltage_input": [11.2, 11.6], "temp_fet": [0.0, 39.0], "temp_motor": [55.5, None]})
    measured = measure("vesc", [first, second])
    assert measured == {
        "SampleGaps": 0,
        "FaultSamples": 1,
        "BatteryVolts": [11.2],
        "TemperatureDegC": [55.5],
    }


def test_unmeasured_values_are_not_counted():
    nothing = {"SampleGaps": 0, "FaultSamples": 0, "BatteryVolts": [], "TemperatureDegC": []}
    assert measure("vesc", [batch({"voltage_input": [0.0, None], "temp_fet": [0, 0]})]) == nothing
    cold = {"voltage_input": [0.0], "temp_motor": [-273.15], "temp_fet": [-57]}
    assert measure("vesc", [batch(cold)]) == nothing
    assert measure("imu", [batch({"x": [1.0], "fault_code": ["odd"], "voltage_input": [True]})]) == nothing


def test_a_hole_is_a_gap():
    times_us = [0, 20_000, 40_000, 60_000, 200_000, 220_000]
    assert measure("vesc", [batch({"x": [0.0] * 6}, times_us=times_us)])["SampleGaps"] == 1


def test_round_trips_and_the_agents_own_figures_are_measured():
    rtt = batch({"broker_ms": [12.0, None], "rule_ms": [None, 31.5], "lambda_ms": [None, None]})
    assert measure(RTT_STREAM, [rtt]) == {
        "RoundTripBrokerMs": [12.0],
        "RoundTripRuleMs": [31.5],
        "RoundTripLambdaMs": [],
    }
    agent = batch({"backlog_batches": [0, 7], "thread_errors": [0, 2]})
    assert measure(AGENT_STREAM, [agent]) == {"AgentReports": 2, "BacklogBatches": [7.0], "ThreadErrors": 2}


@pytest.mark.parametrize("stream", ["vesc", RTT_STREAM, AGENT_STREAM])
def test_the_metric_names_are_the_contracts(stream):
    assert measure(stream, [batch({"x": [1.0]})]).keys() <= set(metrics_of("health"))


def test_several_robots_share_one_log_line_without_loss_of_values():
    one = {"SampleGaps": 1, "FaultSamples": 0, "BatteryVolts": [11.2], "TemperatureDegC": []}
    rtt = {"RoundTripBrokerMs": [5.0] * 3}
    (line,) = together([one, {**one, "BatteryVolts": [12.0]}, rtt])
    assert line == {
        "SampleGaps": 2,
        "FaultSamples": 0,
        "BatteryVolts": [11.2, 12.0],
        "TemperatureDegC": [],
        "RoundTripBrokerMs": [5.0] * 3,
    }
    many = list(together({**one, "BatteryVolts": [float(n)]} for n in range(MOST_VALUES + 1)))
    assert [len(line["BatteryVolts"]) for line in many] == [MOST_VALUES, 1]
    assert sum(line.get("SampleGaps", 0) for line in many) == MOST_VALUES + 1
    assert list(together([])) == [{}]


def test_the_alarm_and_the_watch_use_the_same_hottest_temperature() -> None:
    for hot in TEMPERATURES:
        sample = {**dict.fromkeys(TEMPERATURES, 20.0), hot: 81.5}
        measured = measure("vesc", [batch({name: [value] for name, value in sample.items()})])
        assert measured["TemperatureDegC"] == [81.5] == [hottest_degc(sample)]
    unread = {"temperature_pcb": 0, "temp_fet": -60.0, "temp_motor": None, "ntc_temp_mos1": True}
    assert hottest_degc(unread) is None
    assert hottest_degc({**unread, "ntc_temp_mos2": -3.5}) == -3.5
