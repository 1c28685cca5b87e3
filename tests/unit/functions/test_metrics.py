"""Metrics: lines of the embedded metric format with the contract's names only."""

from __future__ import annotations

import json
import time
from decimal import Decimal

import pytest
from boto3.dynamodb.types import TypeDeserializer, TypeSerializer
from hypothesis import given
from hypothesis import strategies as st

from functions.shared.clients import SUBJECT_CHARACTERS, subject_line
from functions.shared.metrics import Gathered, emit
from iort_contract.catalog.metrics import METRIC_NAMESPACE, METRICS, metrics_of
from iort_contract.dynamodb import deserialize, plain


@pytest.fixture(autouse=True)
def deployment(monkeypatch):
    monkeypatch.setenv("NAMESPACE", "lab2")


def test_every_metric_of_the_contract_is_a_valid_line(capsys):
    for function in {metric.function for metric in METRICS.values()}:
        names = metrics_of(function)
        before_ms = time.time_ns() // 1_000_000
        emit(function, **dict.fromkeys(names, 2.5))
        line = json.loads(capsys.readouterr().out)
        # The types required by CloudWatch's "Specification: Embedded metric format".
        metadata = line["_aws"]
        assert before_ms <= metadata["Timestamp"] <= before_ms + 60_000
        assert isinstance(metadata["Timestamp"], int)
        (directive,) = metadata["CloudWatchMetrics"]
        assert directive["Namespace"] == METRIC_NAMESPACE
        assert directive["Dimensions"] == [["Deployment", "Function"]]
        assert (line["Deployment"], line["Function"]) == ("lab2", function)
        assert {metric["Name"] for metric in directive["Metrics"]} == set(names)
        for metric in directive["Metrics"]:
            endings = {"Ms": "Milliseconds", "Bytes": "Bytes", "Volts": "None", "DegC": "None"}
            units = [unit for ending, unit in endings.items() if ending in metric["Name"]]
            assert metric["Unit"] == (units or ["Count"])[0]
            assert line[metric["Name"]] == 2.5


def test_a_bool_is_written_as_a_number(capsys):
    """CloudWatch takes only numbers; JSON's true is not a number."""
    emit("admit", RobotsAdmitted=True, RobotsRefused=False)
    line = json.loads(capsys.readouterr().out)
    assert type(line["RobotsAdmitted"]) is int
    assert line["RobotsAdmitted"] == 1
    assert "RobotsRefused" not in line


def test_a_list_gives_several_values_and_a_robot_its_own_metric(capsys):
    emit("health", robot="car7", BatteryVolts=[11.5, 11.25], TemperatureDegC=[])
    line = json.loads(capsys.readouterr().out)
    (directive,) = line["_aws"]["CloudWatchMetrics"]
    assert directive["Dimensions"] == [["Deployment", "Function"], ["Deployment", "Function", "Robot"]]
    assert (line["Robot"], line["BatteryVolts"]) == ("car7", [11.5, 11.25])
    assert directive["Metrics"] == [{"Name": "BatteryVolts", "Unit": "None"}]
    # "Specification: Embedded metric format": an array of up to 100 members.
    emit("health", BatteryVolts=[float(i) for i in range(150)])
    assert json.loads(capsys.readouterr().out)["BatteryVolts"] == [float(i) for i in range(50, 150)]


def test_a_value_out_of_cloudwatchs_range_is_clamped(capsys):
    emit("health", BatteryVolts=[11.5, 1e308, -1e308], TemperatureDegC=1e200)
    line = json.loads(capsys.readouterr().out)
    # "MetricDatum": "Values must be in the range of -2^360 to 2^360."
    assert line["BatteryVolts"] == [11.5, 2.0**360, -(2.0**360)]
    assert line["TemperatureDegC"] == 2.0**360


def test_zeros_and_lines_of_zeros_are_not_written(capsys):
    emit("live", LivePublished=1, LiveStale=0)
    line = json.loads(capsys.readouterr().out)
    assert [metric["Name"] for metric in line["_aws"]["CloudWatchMetrics"][0]["Metrics"]] == ["LivePublished"]
    assert "LiveStale" not in line
    emit("live", LivePublished=0)
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("value", [0, 1])
def test_an_unknown_name_is_refused_even_with_value_zero(value, capsys):
    with pytest.raises(KeyError, match="LiveLost"):
        emit("live", LivePublished=1, LiveLost=value)
    with pytest.raises(KeyError, match="nothing"):
        emit("nothing", LivePublished=value)
    assert capsys.readouterr().out == ""


class Lines:
    """A fake writer: it records the time and the values of each line."""

    def __init__(self):
        self.written = []

    def __call__(self, function, values, at_s):
        assert function == "live"
        self.written.append((at_s, values))


def test_the_first_count_is_written_at_once_and_later_ones_every_ten_seconds():
    lines = Lines()
    gathered = Gathered("live", lines)
    for i in range(26):
        gathered.add(1000.0 + i, LivePublished=1, InCarMs=0.5 + i)
    assert [at_s for at_s, _ in lines.written] == [1000, 1010, 1020]
    first, second, third = (values for _, values in lines.written)
    assert first == {"LivePublished": 1, "InCarMs": 0.5}
    assert second == {"LivePublished": 10, "InCarMs": [i + 0.5 for i in range(1, 11)]}
    assert third["LivePublished"] == 10


def test_every_value_is_written_in_lines_of_at_most_100_values():
    lines = Lines()
    gathered = Gathered("live", lines)
    delays = [round(1 + i / 7, 2) for i in range(5000)]
    for i, delay in enumerate(delays):
        gathered.add(1000 + i * 0.02, LivePublished=1, CarToLambdaMs=delay, UplinkMs=0.0)
    gathered.add(2000, LiveStale=1)
    values = [values for _, values in lines.written]
    found = [each["CarToLambdaMs"] for each in values if "CarToLambdaMs" in each]
    assert [ms for each in found for ms in (each if isinstance(each, list) else [each])] == delays
    assert max(len(each) for each in found if isinstance(each, list)) == 100
    assert sum(each.get("LivePublished", 0) for each in values) == 5000
    assert not any("UplinkMs" in each for each in values), "a zero is a value that nobody knows"


def test_counts_before_a_pause_are_written_with_their_own_time():
    lines = Lines()
    gathered = Gathered("live", lines)
    for at_s in (1000, 1001, 1002, 1400):
        gathered.add(at_s, LivePublished=1)
    assert lines.written == [
        (1000, {"LivePublished": 1}),
        (1002, {"LivePublished": 2}),
        (1400, {"LivePublished": 1}),
    ]


def test_a_clock_that_was_set_back_does_not_delay_lines_for_long():
    lines = Lines()
    gathered = Gathered("live", lines)
    gathered.add(1000, InCarMs=1)
    for i in range(100):
        gathered.add(i, InCarMs=1)
    assert len(lines.written) == 2


def test_a_gathered_line_has_its_own_timestamp(capsys):
    gathered = Gathered("live")
    for at_s in (1000.0, 1004.0, 1011.0):
        gathered.add(at_s, LivePublished=1, InCarMs=1.2345)
    _, line = map(json.loads, capsys.readouterr().out.splitlines())
    assert (line["_aws"]["Timestamp"], line["LivePublished"]) == (1_011_000, 2)
    assert line["InCarMs"] == [1.23, 1.23]


# A mail's subject is one that SNS takes.


@pytest.mark.parametrize(
    ("text", "subject"),
    [
        ("iort: car7, fault 5", "iort: car7, fault 5"),
        ("a" * 99, "a" * 99),
        # "Less than 100 characters long".
        ("a" * 100, "a" * 96 + "..."),
        ("two\nlines\x00", "two lines "),
    ],
)
def test_a_subject_is_one_short_line(text, subject):
    assert subject_line(text) == subject
    assert len(subject_line(text)) <= SUBJECT_CHARACTERS < 100


# Stored attributes are read as boto3's deserializer reads them, and long numbers that it refuses too.

numbers = st.integers(-(10**37), 10**37).map(Decimal)
leaves = st.none() | st.booleans() | st.text() | st.binary() | numbers
sets = (
    st.sets(st.text(min_size=1), min_size=1)
    | st.sets(numbers, min_size=1)
    | st.sets(st.binary(min_size=1), min_size=1)
)
values = st.recursive(
    leaves | sets, lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner), max_leaves=20
)


@given(values)
def test_a_value_is_read_as_boto3_reads_it(value):
    stored = TypeSerializer().serialize(value)
    assert deserialize(stored) == TypeDeserializer().deserialize(stored) == value


def test_a_number_that_boto3_refuses_is_read():
    digits = "1" * 40
    assert plain({"n": {"N": digits}, "e": {"N": "1e126"}}) == {"n": Decimal(digits), "e": Decimal("1e126")}
