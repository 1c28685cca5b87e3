"""Logs of VESC Tool: a real ride's, and ones written here with everything that may be wrong with them."""

from __future__ import annotations

import datetime as dt
import logging
import threading
import time
from pathlib import Path
from typing import Any, Mapping, Tuple

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from iort_agent.errors import SourceError
from iort_agent.sources.recording import BagConfig
from iort_contract.catalog.vesc import VESC_FIELDS, absent
from testkit.agent import ManualClock
from tests.recordings import recording

NOW = 1_700_000_000_000_000
HEADER = "ms_today;input_voltage;temp_motor;erpm;amp_hours_used;fault_code;roll"

Sample = Tuple[str, int, Any]


@pytest.fixture
def log(caplog: pytest.LogCaptureFixture) -> pytest.LogCaptureFixture:
    caplog.set_level(logging.INFO, "iort_agent")
    return caplog


def play(path: Path, clock: ManualClock | None = None, **how: Any) -> list[Sample]:
    return play_and_report(path, clock, **how)[0]


def play_and_report(
    path: Path, clock: ManualClock | None = None, **how: Any
) -> tuple[list[Sample], Mapping[str, Any]]:
    out: list[Sample] = []
    source = BagConfig(path=path, **how).build(clock or ManualClock(now_us=NOW))
    source.run(lambda *sample: out.append(sample), threading.Event())
    return out, source.report()


def write(folder: Path, *rows: str, header: str = HEADER, name: str = "ride.csv") -> Path:
    path = folder / name
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    return path


def row(ms: int, *, volts: str = "46.4", motor: str = "25", fault: str = "0", roll: str = "0.5") -> str:
    return f"{ms};{volts};{motor};1200;0.0281;{fault};{roll};"


def test_a_real_ride(log: pytest.LogCaptureFixture) -> None:
    clock = ManualClock(now_us=NOW)
    samples, report = play_and_report(recording("vesc-tool-ride.csv"), clock)
    assert len(samples) == 877
    assert report == {
        "rows": 877, "skipped": {}, "bad_cells": {}, "clock_back": 0, "columns_left_out": [],
    }  # fmt: skip
    stream, t_us, first = samples[0]
    assert (stream, t_us) == ("vesc", NOW)
    ros2 = {name for name, field in VESC_FIELDS.items() if 2 in field.ros}
    assert ros2 <= set(first)
    assert first["voltage_input"] == 46.4
    assert first["temp_fet"] == 32.7
    assert first["charge_drawn"] == 281
    assert first["energy_drawn"] == 12908
    assert (first["displacement"], first["distance_traveled"]) == (106353, 109537)
    assert first["pid_pos_now"] == 307.511
    # No sensor is fitted: what the controller says is recorded, and null wherever numbers are made of it.
    assert all(absent("temp_motor", values["temp_motor"]) for _, _, values in samples)
    # The columns that are not the contract's keep their names, the time of day is no field.
    assert first["battery_level"] == 9.152
    assert "ms_today" not in first
    assert "ms_today_imu" in first
    assert len(first) == 46
    assert max(values["speed"] for _, _, values in samples) == 27383
    assert samples[-1][1] - NOW == 73_648_000
    assert clock.now_us() - NOW == pytest.approx(73_648_000, abs=100)
    assert {frozenset(values) for _, _, values in samples} == {frozenset(first)}
    counters = ("charge_drawn", "charge_regen", "energy_drawn", "energy_regen")
    assert {type(values[name]) for _, _, values in samples for name in counters} == {int}
    assert log.text == ""


def test_loop_and_duration(tmp_path: Path) -> None:
    path = write(tmp_path, *(row(1000 + i * 100, volts=str(i)) for i in range(3)))
    samples = play(path, loop=True, duration_s=0.8, stream="ride")
    assert [values["voltage_input"] for _, _, values in samples] == [0, 1, 2, 0, 1, 2, 0, 1]
    assert [t - NOW for _, t, _ in samples] == [i * 100_000 for i in range(8)]
    assert {stream for stream, _, _ in samples} == {"ride"}


def test_midnight(tmp_path: Path) -> None:
    ms = [86_399_900, 86_399_950, 0, 50]
    samples = play(write(tmp_path, *map(row, ms)))
    assert [t - NOW for _, t, _ in samples] == [0, 50_000, 100_000, 150_000]


def test_a_clock_set_back_a_little_is_no_midnight_and_counted(
    tmp_path: Path, log: pytest.LogCaptureFixture
) -> None:
    rows = list(map(row, [5000, 5100, 4000, 5050, 5200]))
    samples, report = play_and_report(write(tmp_path, *rows))
    assert [t - NOW for _, t, _ in samples] == [0, 100_000, 100_000, 100_000, 200_000]
    assert (report["rows"], report["clock_back"]) == (5, 2)
    assert log.text.count("the clock went back before 2 rows") == 1


def test_original_stamps_are_what_the_log_says_though_its_clock_was_set_back(tmp_path: Path) -> None:
    rows = list(map(row, [5000, 5100, 4000, 5050, 5200]))
    samples = play(write(tmp_path, *rows, name="2024-06-12_00-00-05.csv"), stamps="original")
    assert [t - samples[0][1] for _, t, _ in samples] == [0, 100_000, -1_000_000, 50_000, 200_000]


@pytest.fixture
def zone(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setenv("TZ", request.param)
    time.tzset()
    yield request.param
    monkeypatch.undo()
    time.tzset()


def ms_of(utc: dt.datetime) -> int:
    midnight = utc.replace(hour=0, minute=0, second=0, microsecond=0)
    return (utc - midnight) // dt.timedelta(milliseconds=1)


@pytest.mark.parametrize(
    "zone",
    ["Europe/Berlin", "America/Los_Angeles", "Asia/Kolkata", "Pacific/Kiritimati", "Etc/GMT+12", "UTC"],
    indirect=True,
)
@pytest.mark.parametrize("hour", range(0, 24, 3))
def test_original_stamps_are_utc_of_the_day_that_the_local_name_means(
    tmp_path: Path, zone: str, hour: int
) -> None:
    # VESC Tool names the file by local time and counts ms_today in UTC.
    opened = dt.datetime(2024, 6, 11, hour, 59, 59, tzinfo=dt.timezone.utc)
    first = opened + dt.timedelta(seconds=1.5)
    name = opened.astimezone().strftime("ride %Y-%m-%d_%H-%M-%S.csv")
    rows = [row(ms_of(first)), row(ms_of(first + dt.timedelta(seconds=0.1)))]
    expected = round(first.timestamp() * 1e6)
    samples = play(write(tmp_path, *rows, name=name), stamps="original")
    assert [t for _, t, _ in samples] == [expected, expected + 100_000]


@pytest.mark.parametrize("zone", ["UTC"], indirect=True)
def test_an_agent_in_another_zone_than_the_phone_gets_the_same_instants(tmp_path: Path, zone: str) -> None:
    # Half past midnight in Berlin's summer, read by a robot whose clock shows UTC.
    path = write(tmp_path, row(81_271_500), name="2024-06-12_00-34-31.csv")
    assert play(path, stamps="original")[0][1] == 1_718_145_271_500_000


@pytest.mark.parametrize("name", ["ride.csv", "2024-13-12_00-34-31.csv"])
def test_original_stamps_without_a_day_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(SourceError, match=r"needs the day.*2024-06-12_00-34-31\.csv"):
        play(write(tmp_path, row(1000), name=name), stamps="original")


@pytest.mark.parametrize(
    ("bad", "why", "cause"),
    [
        ("1100;46.4;25;", "4 columns, and the first line names 7", "columns"),
        ("1100;46.4;25;1200;0.0281;0;0.5;9;", "9 columns", "columns"),
        (row(86_400_000), "must be a number from 0 to 86399999", "time"),
        (row(-1), "must be a number from 0", "time"),
        (row(1100).replace("1100", ""), "ms_today must be a number from 0 to 86399999, got ''", "time"),
        (row(1100).replace("1100", "nan"), "a number from 0 to 86399999, got 'nan'", "time"),
        (row(1100).replace("1100", "noon"), "a number from 0 to 86399999, got 'noon'", "time"),
        ("\x00\x00\x00\x00", "1 columns", "columns"),
    ],
)
def test_a_malformed_row_is_skipped_counted_by_cause_and_told_once(
    tmp_path: Path, log: pytest.LogCaptureFixture, bad: str, why: str, cause: str
) -> None:
    path = write(tmp_path, row(1000), bad, row(1200), bad, row(1300))
    rows, report = play_and_report(path)
    assert (len(rows), report["rows"], report["skipped"]) == (3, 5, {cause: 2})
    log.clear()
    samples = play(path, loop=True, duration_s=0.7)
    assert [t - NOW for _, t, _ in samples[:3]] == [0, 200_000, 300_000]
    told = [record.getMessage() for record in log.records]
    assert len([text for text in told if "row 3 is skipped" in text]) == 1
    assert why in log.text
    assert any("2 rows have been skipped" in text for text in told)
    assert not any("row 5" in text for text in told)


@pytest.mark.parametrize("place", [0, 1, 2])
@pytest.mark.parametrize(
    ("bad", "column", "why"),
    [
        (row(1001, volts="46.x"), "input_voltage", "input_voltage must be a number, got '46.x'"),
        (row(1001, volts="46,4"), "input_voltage", "input_voltage must be a number, got '46,4'"),
        (row(1001, volts="1_000"), "input_voltage", "input_voltage must be a number, got '1_000'"),
        (row(1001, roll="left"), "roll", "roll must be a number, got 'left'"),
        (row(1001, fault="FAULT_CODE_GREMLINS"), "fault_code", "fault_code must be a known fault, got"),
    ],
)
def test_a_bad_cell_is_null_and_costs_neither_its_row_nor_its_column(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, bad: str, column: str, why: str, *, place: int
) -> None:
    rows = [row(1001) for _ in range(3)]
    rows[place] = bad
    samples, report = play_and_report(write(tmp_path, *rows))
    field = {"input_voltage": "voltage_input"}.get(column, column)
    assert [values[field] is None for _, _, values in samples] == [i == place for i in range(3)]
    assert all(len(values) == 6 for _, _, values in samples)
    assert (report["bad_cells"], report["skipped"]) == ({column: 1}, {})
    assert caplog.text.count(f"row {place + 2}: {why}") == 1


def test_a_first_row_cut_short_says_nothing_about_the_others(tmp_path: Path) -> None:
    path = write(tmp_path, "1000;4", row(1000, roll="x;y"), row(1100, volts="46.5", roll="0.25"))
    assert [values["roll"] for _, _, values in play(path)] == [0.25]


def test_a_decimal_comma(tmp_path: Path, log: pytest.LogCaptureFixture) -> None:
    whole = row(1000).replace("46.4", "46").replace("0.0281", "0").replace("0.5", "0")
    comma = [row(ms).replace(".", ",") for ms in (1100, 1200)]
    samples, report = play_and_report(write(tmp_path, whole, *comma, row(1300)))
    assert [values["voltage_input"] for _, _, values in samples] == [46, 46.4, 46.4, None]
    assert samples[1][2]["charge_drawn"] == 281
    assert report["bad_cells"] == {"input_voltage": 1, "amp_hours_used": 1, "roll": 1}


def test_a_text_with_a_comma_says_nothing_about_the_decimal_sign(tmp_path: Path) -> None:
    header = HEADER + ";note"
    rows = [row(1000 + i) + "left, then right;" for i in range(3)]
    samples, report = play_and_report(write(tmp_path, *rows, header=header))
    assert [values["voltage_input"] for _, _, values in samples] == [46.4] * 3
    assert report["columns_left_out"] == ["note"]


def test_a_column_that_has_a_number_now_and_then_is_kept_with_the_rows(tmp_path: Path) -> None:
    header = HEADER + ";gnss_lat"
    rows = [row(1000 + i) + ("n/a;" if i % 6 else "47.5;") for i in range(168)]
    samples, report = play_and_report(write(tmp_path, *rows, header=header))
    assert len(samples) == 168
    assert [values["gnss_lat"] for _, _, values in samples].count(47.5) == 28
    assert report["bad_cells"] == {"gnss_lat": 140}


@pytest.mark.parametrize("separator", ["\t", ","])
def test_other_separators(tmp_path: Path, separator: str) -> None:
    path = write(tmp_path, row(1000).replace(";", separator), header=HEADER.replace(";", separator))
    assert play(path)[0][2]["voltage_input"] == 46.4


def test_what_windows_adds(tmp_path: Path) -> None:
    path = tmp_path / "RIDE.CSV"
    path.write_bytes(
        b"\xef\xbb\xbf" + "\r\n".join([HEADER + ";", row(1000), "", row(1100)]).encode() + b"\r\n"
    )
    assert len(play(path)) == 2


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("FAULT_CODE_NONE", 0),
        ("FAULT_CODE_DRV", 3),
        ("FAULT_CODE_DRV8302", 3),
        ("OVER_TEMP_FET", 5),
        ("FAULT_CODE_ENCODER_NO_MAGNET", 25),
        ("7", 7),
        ("FAULT_CODE_GREMLINS", None),
    ],
)
def test_faults_by_name(tmp_path: Path, log: pytest.LogCaptureFixture, text: str, code: int | None) -> None:
    samples = play(write(tmp_path, row(1000, fault=text), row(1100, fault=text)))
    assert [values["fault_code"] for _, _, values in samples] == [code, code]
    assert log.text.count("GREMLINS") == (1 if code is None else 0)


def test_columns_that_are_no_fields(tmp_path: Path, log: pytest.LogCaptureFixture) -> None:
    header = HEADER + ";note;gnss lat;speed;extra"
    rows = [row(1000 + i) + "abc;1.5;3;2.25" for i in range(3)]
    samples = play(write(tmp_path, *rows, header=header))
    assert set(samples[0][2]) == {
        "voltage_input", "temp_motor", "speed", "charge_drawn", "fault_code", "roll", "extra",
    }  # fmt: skip
    assert samples[0][2]["speed"] == 1200, "the contract's, not a column that happens to have its name"
    assert log.text.count("columns that hold no numbers: note, gnss lat, speed") == 1


def test_empty_cells_are_null_and_nan_stays_for_the_contract_to_count(tmp_path: Path) -> None:
    samples = play(write(tmp_path, row(1000, volts="", roll="nan"), row(1100)))
    assert samples[0][2]["voltage_input"] is None
    assert samples[0][2]["roll"] != samples[0][2]["roll"]
    assert set(samples[0][2]) == set(samples[1][2])


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "no column ms_today"),
        ("time;speed\n1;2\n", "no column ms_today"),
        (HEADER + "\n", "it has no row that can be read"),
        (HEADER + "\n1;2\n", "it has no row that can be read"),
        (HEADER + ";roll\n", "roll are there twice"),
    ],
)
def test_what_is_no_log(tmp_path: Path, content: str, words: str) -> None:
    path = tmp_path / "ride.csv"
    path.write_text(content)
    with pytest.raises(SourceError, match=words):
        play(path)


def test_a_log_has_no_topics(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="has no topics; `stream` names its stream"):
        play(write(tmp_path, row(1000)), topics=(("/sensors/core", "vesc"),))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(st.binary(max_size=300))
def test_whatever_stands_in_it_the_good_rows_come_out(tmp_path: Path, junk: bytes) -> None:
    path = tmp_path / "ride.csv"
    junk = junk.replace(b";", b"").replace(b"\t", b"")
    path.write_bytes(f"{HEADER}\n{row(1000)}\n".encode() + junk + f"\n{row(1200)}\n".encode())
    assert [t - NOW for _, t, _ in play(path)] == [0, 200_000]


def test_a_line_and_a_header_without_an_end_are_bounded(tmp_path: Path) -> None:
    samples, report = play_and_report(write(tmp_path, row(1000), "\0" * 1_000_000, row(1100)))
    assert len(samples) == 2
    assert report["skipped"] == {"columns": 1}
    wide = ";".join(["ms_today", *(f"x{i}" for i in range(200_000))])
    with pytest.raises(SourceError, match=r"ride\.csv: it must have at most 4,096 columns"):
        play(write(tmp_path, row(1000), header=wide))
