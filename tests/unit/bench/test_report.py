"""The pure parts of the bench: spreads, ratios, the report's rendering and the guard."""

from __future__ import annotations

import argparse
import json
import xml.etree.ElementTree as ET
from dataclasses import replace

import pytest

from bench import plots, run
from bench import report as writer
from bench.report import Plot, Ratio, Report, Section, ratio, spread
from bench.sections import ALL, SECTIONS, Declared, Option, guard, load, numbers, values
from scripts.docs_parts import REPORT
from testkit.command import Table
from testkit.waiting import InstrumentError

MACHINE = {
    "date": "2026-01-02T03:04:05+00:00",
    "cores": 2,
    "cpu": "A processor",
    "memory": "8 GB",
    "kernel": "Linux 6",
    "python": "3.11",
    "packages": {"boto3": "1"},
    "commit": "abc",
    "load_1min": 0.5,
}


def _section(*ratios):
    svg = plots.bars({"a": 1.0, "b": 2.0}, unit="s")("Bars & <co>")
    return Section(
        "query",
        "Query <b>",
        tables=[Table("T|x", ["name", "value"], [["a|b", "<script>"]])],
        plots=[Plot("bars", "Bars & <co>", svg)],
        ratios=list(ratios),
        notes=["a note"],
        raw={"values": [1, 2]},
    )


def test_the_spread_has_percentiles_and_the_range_of_repeats():
    found = spread([[1.0, 2.0, 3.0], [5.0, 6.0, 7.0]])
    assert found is not None
    assert (found.n, found.p50, found.low, found.high) == (6, 4.0, 2.0, 6.0)
    assert found.p95 <= found.p99 <= 7.0
    assert found.text() == "4.00 ms (p95 6.75, p99 6.95; 2.00 to 6.00)"
    assert spread([[], []]) is None
    assert spread([[3.0]]) == spread([[3.0], []])


def test_a_ratio_compares_pairs_so_that_a_slow_minute_cancels_out():
    assert ratio([[2.0], [20.0], [2.0]], [[1.0], [10.0], [1.0]]) == 2.0
    assert ratio([[2.0], []], [[1.0], [1.0]]) == 2.0
    assert ratio([[]], [[1.0]]) is None
    assert ratio([[1.0]], [[0.0]]) is None


@pytest.mark.parametrize(
    ("value", "target", "at_least", "reached"),
    [
        (1.5, 1.5, False, True),
        (1.6, 1.5, False, False),
        (25, 20, True, True),
        (19, 20, True, False),
        (9, None, False, None),
    ],
)
def test_a_ratio_reaches_its_target_or_not(value, target, at_least, reached):
    assert Ratio("r", value, target, at_least=at_least).reached is reached


def test_the_markdown_has_tables_pictures_and_the_machine():
    text = writer.markdown([_section(Ratio("r", 1.6, 1.5))], MACHINE, "embedded")
    assert "| r | 1.6 | at most 1.5 | **no** |" in text
    assert "| a\\|b | <script> |" in text
    assert "![Bars & <co>](report-bars.svg)" in text
    assert "2026-01-02" in text
    assert "A processor" in text


def test_a_written_report_is_complete_and_old_pictures_are_deleted(tmp_path):
    (tmp_path / "report-old.svg").write_text("<svg/>")
    writer.write(tmp_path, [_section(Ratio("r", 1, 2))], MACHINE, "embedded")
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "report-bars.svg",
        "report.json",
        "report.md",
    ]
    kept = json.loads((tmp_path / "report.json").read_text())
    assert kept["sections"][0]["raw"] == {"values": [1, 2]}
    assert guard.ratios(kept)["r"].value == 1
    assert writer.read(tmp_path) == ([_section(Ratio("r", 1, 2))], MACHINE)


def _report(*ratios, cpu="A processor", key="query"):
    section = {**_section(*ratios).as_json(), "key": key}
    machine = {**MACHINE, "cpu": cpu}
    return json.loads(json.dumps({"target": "embedded", "machine": machine, "sections": [section]}))


@pytest.mark.parametrize(
    ("was", "now", "target", "more", "worse"),
    [
        (2.0, 2.9, None, {}, 0),
        (2.0, 3.1, None, {}, 1),
        # Also with a distant target.
        (1.0, 1.6, 9.0, {}, 1),
        (1.0, 1.6, 9.0, {"tolerance": 2}, 0),
        (30.0, 21.0, 20.0, {"at_least": True}, 0),
        (90.0, 21.0, 20.0, {"at_least": True}, 1),
        (0.0, 1.0, 0.0, {}, 1),
        (0.0, 0.0, 0.0, {}, 0),
    ],
)
def test_the_guard_allows_a_figure_its_stated_tolerance(was, now, target, more, worse):
    old, new = (_report(Ratio("r", value, target, **more)) for value in (was, now))
    assert len(guard.regressions(new, old)) == worse


@pytest.mark.parametrize(
    ("cpu", "now", "worse"), [("A processor", 1.6, 1), ("Other", 1.6, 0), ("Other", 9, 1)]
)
def test_the_guard_compares_a_time_from_another_machine_with_its_target(cpu, now, worse):
    old = _report(Ratio("r", 1.0, 5.0, by_machine=True))
    new = _report(Ratio("r", now, 5.0, by_machine=True), cpu=cpu)
    assert len(guard.regressions(new, old)) == worse


def test_the_guard_names_missing_figures_and_sections_that_were_not_run():
    old, new = _report(Ratio("a", 1, 1), Ratio("b", 1, 1)), _report(Ratio("a", 1, 1))
    assert guard.regressions(new, old) == ["b: no longer measured"]
    other = _report(Ratio("c", 1, 1), key="outage")
    assert guard.regressions(other, old) == []
    assert guard.not_compared(other, old) == ["query"]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({}, ""),
        ({"target": "aws"}, "a report of aws says nothing about one of embedded"),
        ({"sections": []}, "has no figure of"),
    ],
)
def test_the_guard_compares_reports_of_one_target(tmp_path, change, said):
    report = _report(Ratio("r", 1, 2))
    for name, content in (("old", report), ("new", {**report, **change})):
        (tmp_path / name).write_text(json.dumps(content))
    files = {"new": tmp_path / "new", "old": tmp_path / "old"}
    if said:
        with pytest.raises(InstrumentError, match=said):
            guard.run(None, print, **files)
    else:
        (worse,) = guard.run(None, print, **files).ratios
        assert (worse.value, worse.reached) == (0, True)


def test_a_merged_report_keeps_what_was_not_measured_again(tmp_path):
    kind = Report("kept", "Kept", "make bench", merged=True)
    then, now = ({**MACHINE, "commit": commit} for commit in ("then", "now"))
    first, second = replace(_section(), key="first"), replace(_section(), key="second")
    writer.write(tmp_path, [first, second], then, "embedded", kind)
    writer.write(tmp_path, [replace(second, title="again", notes=[])], now, "embedded", kind)
    sections, machine = writer.read(tmp_path, kind)
    assert [section.title for section in sections] == [first.title, "again"]
    assert (machine["commit"], sections[1].notes) == (
        "then",
        [f"Measured on {now['date'][:10]}, commit now."],
    )
    writer.write(tmp_path, [first, second], now, "embedded", kind)
    assert writer.read(tmp_path, kind) == ([first, second], now)


def _declared(*options, section=None):
    return Declared("", lambda *_, **__: section or _section(), options, cloud=False)


def test_options_are_read_by_the_section_that_has_them():
    both = {"a": _declared(Option("CARS", int, 20, "")), "b": _declared(Option("ROBOTS", numbers, [1], ""))}
    assert values(both, ["CARS=3"]) == {"a": {"cars": 3}, "b": {"robots": [1]}}
    assert values(both, ["ROBOTS=10 200"])["b"] == {"robots": [10, 200]}
    with pytest.raises(ValueError, match="KILLS: a, b has CARS, ROBOTS"):
        values(both, ["KILLS=1"])
    with pytest.raises(ValueError, match="CARS=many"):
        values(both, ["CARS=many"])


def test_every_section_declares_itself():
    for key in ALL:
        declared = load(key)
        assert declared.what
        assert declared.report.name == "report" if key in SECTIONS else declared.report.name != "report"


@pytest.mark.parametrize(
    ("value", "status"), [(1, 0), (3, 1), (None, 2)], ids=["reached", "missed", "not measured"]
)
def test_a_missed_target_is_an_exit_status(tmp_path, monkeypatch, value, status):
    def measure(_target, _say):
        if value is None:
            raise InstrumentError("it failed")
        return _section(Ratio("r", value, 2))

    monkeypatch.setattr(run.sections, "load", lambda _: Declared("", measure, cloud=False))
    options = argparse.Namespace(
        only=["cost"], values=[], target="embedded", namespace="iort", yes=False, out=tmp_path, report=None
    )
    with pytest.raises(SystemExit) as ended:
        run.run(options)
    assert ended.value.code == status
    assert (tmp_path / "report.md").exists() is (value is not None)


def test_the_guard_reads_the_kept_report():
    kept = json.loads(REPORT.read_text())
    assert len(guard.ratios(kept)) > 10
    assert guard.regressions(kept, kept) == []


def test_the_kept_report_names_no_host_and_no_folder():
    for path in REPORT.parent.iterdir():
        text = path.read_text()
        assert "/tmp/" not in text, path.name
        assert "/home/" not in text, path.name
        assert "/work/" not in text, path.name


def test_plots_are_small_and_reproducible_xml():
    curves = {"a": [1.0, 2.0, 3.0] * 500, "b": [2.0], "none": []}
    first, second = (plots.cdf(curves)("A & B") for _ in range(2))
    assert first == second
    assert len(first) < 60_000
    for svg in (
        first,
        plots.lines([1, 10], {"a": [1, 2]}, x_label="x", y_label="y")("L"),
        plots.ranges(["a", "b"], {"x": {"a": (1, 2), "b": (3, 3)}, "y": {"b": (4, 5)}}, unit="ms")("R"),
        plots.points("a", [1, 2], [3, 4], y_label="y", shaded=(1, 2))("P"),
    ):
        assert ET.fromstring(svg).tag.endswith("svg")
