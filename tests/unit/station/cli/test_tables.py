"""Results in the formats of other programs, and the ranges of queries."""

from __future__ import annotations

import csv
import io
import json
import time

import numpy as np
import pyarrow.parquet as pq
import pytest

from iort_station.cli import tables
from iort_station.cli.options import Range, When
from iort_station.data import Result, tabular
from iort_station.errors import StationError


def result(n=3):
    objects = np.empty(n, dtype=object)
    objects[:] = (["a", None, "ü"] * n)[:n]
    columns = {
        "speed": np.arange(n) * 1.5,
        "current_motor": np.full(n, np.nan),
        "name": objects,
        "on": np.arange(n) % 2 == 0,
    }
    times = np.arange(n, dtype=np.int64) * 20_000 + 1_700_000_000_123_456
    return Result("car", "vesc", times, columns)


def test_csv_has_the_form_that_spreadsheets_and_grafana_read():
    file = io.StringIO()
    tabular.to_csv(result(), file)
    rows = list(csv.DictReader(io.StringIO(file.getvalue())))
    assert rows[1] == {
        "time": "2023-11-14T22:13:20.143456Z",
        "speed": "1.5",
        "current_motor": "",
        "name": "",
        "on": "False",
    }
    assert len(rows) == 3


@pytest.mark.parametrize("text", ["=cmd|' /C calc'!A0", "+1", "-1+2", "@SUM(1)", " =1", "\t=1", "\uff1d1"])
def test_csv_has_formulas_only_on_request(text):
    values = np.array([text, "a=b"], dtype=object)
    found = Result("car", "notes", np.arange(2, dtype=np.int64), {text: values, "x": np.array([-1.5, 2])})
    file = io.StringIO()
    tabular.to_csv(found, file)
    head, first, second = csv.reader(io.StringIO(file.getvalue()))
    assert head == ["time", f"'{text}", "x"]
    assert first[1:] == [f"'{text}", "-1.5"]
    assert second[1] == "a=b"
    raw = io.StringIO()
    tabular.to_csv(found, raw, raw=True)
    head, first, _ = csv.reader(io.StringIO(raw.getvalue()))
    assert (head[1], first[1]) == (text, text)


def test_csv_and_tables_have_no_control_characters():
    escape = "\x1b]52;c;YQ==\x07"
    values = np.array([escape], dtype=object)
    found = Result("car", "notes", np.zeros(1, dtype=np.int64), {escape: values})
    file = io.StringIO()
    tabular.to_csv(found, file)
    tables.write(found, file)
    assert "\x1b" not in file.getvalue()
    assert file.getvalue().count("\\u001b]52;c;YQ==\\u0007") == 4


def test_json_lines_keep_null_text_and_microseconds():
    file = io.StringIO()
    tabular.to_json_lines(result(25_000), file)
    lines = [json.loads(line) for line in file.getvalue().splitlines()]
    assert len(lines) == 25_000
    assert lines[2] == {
        "time": "2023-11-14T22:13:20.163456Z",
        "time_us": 1_700_000_000_163_456,
        "speed": 3.0,
        "current_motor": None,
        "name": "ü",
        "on": True,
    }
    assert lines[-1]["time_us"] == 1_700_000_000_123_456 + 24_999 * 20_000


def test_parquet_keeps_times_types_null_and_units():
    file = io.BytesIO()
    tabular.to_parquet(result(), file)
    table = pq.read_table(io.BytesIO(file.getvalue()))
    assert str(table.schema.field("time").type) == "timestamp[us, tz=UTC]"
    assert table.schema.field("speed").metadata == {b"unit": b"erpm"}
    assert table.schema.metadata[b"robot"] == b"car"
    assert table.column("speed").to_pylist() == [0.0, 1.5, 3.0]
    assert table.column("current_motor").null_count == 3
    assert table.column("name").to_pylist() == ["a", None, "ü"]


@pytest.mark.parametrize("values", [[1.5, "fast"], [True, 2.0], [2**60, 0.5], [2**70, 1]])
def test_parquet_has_values_of_several_kinds_as_texts(values):
    file = io.BytesIO()
    column = np.array([*values, None], dtype=object)
    tabular.to_parquet(Result("car", "odom", np.arange(3), {"mixed": column}), file)
    table = pq.read_table(io.BytesIO(file.getvalue()))
    assert table.column("mixed").to_pylist() == [*map(str, values), None]


def test_a_file_has_every_row_and_field_with_units():
    found = result(3000)
    found.columns["name"][7] = "two\nlines\x1b"
    found.columns["a_name_that_is_longer_than_its_values"] = np.arange(3000)
    file = io.StringIO()
    tables.write(found, file)
    head, units, *rows = file.getvalue().splitlines()
    assert head.split() == ["time", "(UTC)", *found.columns]
    assert units.split() == ["erpm", "A"]
    assert len(rows) == 3000
    assert [row.split()[2] for row in rows[1500:1502]] == ["2250", "2251.5"]
    assert "two\\nlines\\u001b" in rows[7]
    assert len({len(row) for row in rows[8:]}) == 1, "its columns are straight"


def test_a_terminal_shows_units_and_both_ends():
    file = io.StringIO()
    assert tables.write(result(1000), file, 120) == (40, [])
    text = file.getvalue()
    assert text.splitlines()[1].split() == ["erpm", "A"]
    assert text.splitlines()[22].split() == ["..."] * 5
    assert "22:13:20.123456" in text
    assert "22:13:40.103456" in text
    assert "22:13:30" not in text


@pytest.mark.parametrize(
    ("width", "left_out"),
    [(80, []), (62, []), (56, ["on"]), (50, ["name", "on"]), (36, ["current_motor", "name", "on"])],
)
def test_a_narrow_terminal_shows_whole_values_and_names_the_omitted_fields(width, left_out):
    found, file = result(50), io.StringIO()
    found.columns["speed"] += 1000
    assert tables.write(found, file, width).left_out == left_out
    lines = file.getvalue().splitlines()
    assert max(map(len, lines)) <= width
    assert "1073.5" in lines[-1]


def test_a_terminal_cuts_long_texts():
    found, file = result(1), io.StringIO()
    found.columns["name"][0] = "x" * 100
    assert tables.write(found, file, 110).left_out == []
    assert f" {'x' * 37}... " in file.getvalue()


@pytest.fixture
def berlin(monkeypatch):
    monkeypatch.setenv("TZ", "Europe/Berlin")
    time.tzset()
    yield
    monkeypatch.undo()
    time.tzset()


@pytest.mark.usefixtures("berlin")
@pytest.mark.parametrize(
    ("text", "zone"), [("2023-11-14T22:13:20", "CET (UTC+0100)"), ("2023-07-14", "CEST (UTC+0200)")]
)
def test_a_time_without_a_zone_is_told_with_the_one_that_it_has(capsys, text, zone):
    When(text).range()
    assert f"{text} is read as {zone}, this machine's zone" in capsys.readouterr().err


def test_ranges_are_parsed(capsys):
    assert When(last="all").range() == Range(None, None)
    found = When(last="2s").range()
    assert found.end_us - found.start_us == 2_000_000
    found = When("2023-11-14T22:13:20Z", "2023-11-14T22:13:21Z").range()
    assert (found.start_us, found.end_us) == (1_700_000_000_000_000, 1_700_000_001_000_000)
    assert capsys.readouterr().err == ""
    assert When().range() == Range(None, None)
    found = When("00:00Z", "00:00:01Z").range()
    assert found.end_us - found.start_us == 1_000_000
    found = When("00:00:01Z", "00:00Z").range()
    assert found.end_us - found.start_us == 86_399_000_000, "to the next midnight"
    assert capsys.readouterr().err == ""
    found = When().range("5m")
    assert found.end_us - found.start_us == 300_000_000
    assert "--last all" in capsys.readouterr().err


@pytest.mark.parametrize("options", [("-1m", None, "1m"), ("now", "-1m", None), (None, None, "soon")])
def test_invalid_ranges_are_refused(options):
    with pytest.raises(StationError):
        When(*options).range()


def written(to, found):
    file = io.StringIO()
    to(found, file)
    return file.getvalue().splitlines()


def test_integers_are_written_as_integers_and_fractions_as_fractions():
    mixed = np.empty(2, dtype=object)
    mixed[:] = [2**63 + 1, -127.0]
    columns = {"rssi": np.array([-127.0, np.nan]), "volts": np.array([12.0, 12.5]), "large": mixed}
    found = Result("car", "radio", np.array([0, 1_000_000]), {**columns, "far": np.array([1e300, 1.0])})
    assert [line.partition(",")[2] for line in written(tabular.to_csv, found)] == [
        "rssi,volts,large,far",
        "-127,12.0,9223372036854775809,1e+300",
        ",12.5,-127,1.0",
    ]
    first, second = written(tabular.to_json_lines, found)
    assert '"rssi": -127, "volts": 12.0, "large": 9223372036854775809' in first
    assert '"rssi": null, "volts": 12.5, "large": -127' in second
    many = Result("car", "radio", np.arange(20_000), {"n": np.arange(20_000.0)})
    assert written(tabular.to_csv, many)[-1].endswith(",19999")
    # A column with a later fraction is written as fractions from the start.
    many.columns["n"][-1] = 0.5
    assert written(tabular.to_csv, many)[1].endswith(",0.0")


def test_a_latitude_is_shown_to_the_centimetre():
    names = ["gnss_lat", "longitude_mean", "fix.latitude", "flat", "lon_velocity"]
    columns = {name: np.array([52.12345678]) for name in names}
    file = io.StringIO()
    tables.write(Result("car", "fix", np.array([0]), columns), file, 200)
    shown = file.getvalue().splitlines()[-1].split()[2:]
    assert shown == ["52.1234568"] * 3 + ["52.1235"] * 2
