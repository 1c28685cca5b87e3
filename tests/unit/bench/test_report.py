"""The pure parts of the bench: ratios, the report's rendering, options and the guard."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict, replace

import pytest

from bench import report as writer
from bench import run
from bench.report import Ratio, Report, Section, ratio
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
    return Section(
        "query",
        "Query <b>",
        tables=[Table("T|x", ["name", "value"], [["a|b", "<script>"]])],
        ratios=list(ratios),
        notes=["a note"],
        raw={"values": [1, 2]},
    )


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


@pytest.mark.parametrize(
    ("figure", "part"),
    [
        (Ratio("r", 1.0, 2.0), 0.5),
        (Ratio("r", 10, 20, at_least=True), 2),
        (Ratio("r", 3, None), None),
        (Ratio("r", 0, 0), None),
        (Ratio("r", 1, 0), None),
    ],
)
def test_a_figure_stands_beside_its_target(figure, part):
    assert figure.of_target == part


def test_the_picture_names_every_figure_that_has_a_target_of_its_own(tmp_path):
    figures = Ratio("fast", 1.0, 2.0), Ratio("lost", 0, 0), Ratio("rare", 3, None)
    writer.write(tmp_path, [_section(*figures)], MACHINE, "embedded")
    picture = (tmp_path / "report.svg").read_text()
    assert "fast: 1" in picture
    assert "lost" not in picture
    assert "rare" not in picture
    assert "(report.svg)" in (tmp_path / "report.md").read_text()


def test_a_figure_is_shown_to_four_digits_and_a_count_whole():
    section = Section("query", "")
    for value in (1.23456, 12_345, None):
        section.ratio("r", value, None)
    assert [ratio.value for ratio in section.ratios] == [1.235, 12_345]


def test_a_written_report_is_read_back_and_names_its_machine(tmp_path):
    section = _section(Ratio("r", 1.6, 1.5))
    writer.write(tmp_path, [section], MACHINE, "embedded")
    text = (tmp_path / "report.md").read_text()
    assert "| r | 1.6 | at most 1.5 | **no** |" in text
    assert "| a\\|b | <script> |" in text
    assert "2026-01-02" in text
    assert "A processor" in text
    assert guard.ratios(json.loads((tmp_path / "report.json").read_text()))["r"].value == 1.6
    assert writer.read(tmp_path) == ([section], MACHINE)


def _report(*ratios, cpu="A processor", key="query"):
    section = {**asdict(_section(*ratios)), "key": key}
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
    assert guard.regressions(_report(Ratio("c", 1, 1), key="outage"), old) == []


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({}, ""),
        ({"target": "aws"}, "has no figure of"),
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


def _declared(*options):
    return Declared("", lambda *_, **__: _section(), options, cloud=False)


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
        only=["cost"], values=[], target="embedded", namespace="iort", yes=False, out=tmp_path
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
