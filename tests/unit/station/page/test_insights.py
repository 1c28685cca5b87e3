"""The page's answers about findings, analysed drives and laps."""

from __future__ import annotations

import json

import pytest

from iort_contract.catalog.analysis.parameters import GROUPS
from iort_contract.messages.analysis.findings import DriveKey, Estimate, Finding
from iort_contract.messages.analysis.run import AnalysedDrive
from iort_station.errors import StationError
from iort_station.page import insights
from iort_station.page import insights as laps
from tests.unit.station.analysis.test_laps import driven_cloud
from tests.unit.station.data.test_data import START

DAY_US = 86_400_000_000
WHOLE = {"robot": "car", "from_us": str(START), "to_us": str(START + 90_000_000)}


def finding(robot="car", **given):
    key = DriveKey(robot, START, "0badcafe")
    told = {"kind": "battery_worn", "severity": "warning", "subject": "battery_resistance_ohm"}
    told |= {"from_us": START + 5, "to_us": START + 9, "stream": "vesc", "fields": ("voltage_input",)}
    told["text"] = "it has grown"
    return Finding(drive=key, **{**told, **given})


def analysed(robot="car", days=0):
    key = DriveKey(robot, START + days * DAY_US, "0badcafe")
    found = {"battery_resistance_ohm": Estimate(0.04, 0.03, 0.05, "ohm")}
    return AnalysedDrive(key, key.start_us + 999, "job", 50, found, {"lap_best_s": "no laps"}, {"gap": 1})


class Table:
    """The table of findings of two robots."""

    def findings(self, robot):
        failed = finding(robot, kind="analysis_failed", text="out of memory", to_us=START + 60_000_000)
        return [finding(robot, effect=Estimate(0.01, 0.008, 0.012, "ohm"), q=0.001), failed]

    def drives(self, robot, most):
        return [analysed(robot, days) for days in (2, 1)][:most]


@pytest.fixture(autouse=True)
def _table(monkeypatch):
    monkeypatch.setattr(insights.stored, "findings_table", lambda _cloud: Table())
    monkeypatch.setattr(insights.registry, "presence", lambda _cloud: {"car": {}, "other": {}})


def test_a_robots_insights_are_its_findings_and_drives_with_the_catalogues_words():
    told = json.loads(json.dumps(insights.insights(None, {"robot": "car"}), allow_nan=False))
    first = told["findings"][0]
    assert first["meaning"] == "the battery's internal resistance has grown"
    assert first["effect"] == {"value": 0.01, "low": 0.008, "high": 0.012, "unit": "ohm"}
    assert "replace" in first["action"]
    assert list(told["groups"]) == list(GROUPS)
    assert told["drives"][0]["estimates"]["battery_resistance_ohm"]["value"] == 0.04
    assert told["drives"][0]["missing"] == {"lap_best_s": "no laps"}


def test_a_drive_that_could_not_be_analysed_is_among_the_drives_with_its_reason():
    drives = insights.insights(None, {"robot": "car"})["drives"]
    assert [drive["failed"] for drive in drives] == ["", "", "out of memory"]
    assert drives[2]["to_us"] - drives[2]["from_us"] == 60_000_000


def test_the_fleets_insights_are_of_all_robots():
    told = insights.insights(None, {})
    assert {finding["robot"] for finding in told["findings"]} == {"car", "other"}
    assert {drive["robot"] for drive in told["drives"]} == {"car", "other"}


def test_laps_and_their_delta_are_answered_from_the_samples():
    answers = laps.laps_answers(driven_cloud())
    told = json.loads(json.dumps(answers["laps"](WHOLE), allow_nan=False))
    assert told["method"] == "gate"
    assert len(told["laps"]) >= 6
    delta = json.loads(json.dumps(answers["delta"]({**WHOLE, "one": "2", "other": "3"}), allow_nan=False))
    behind = told["laps"][2]["time_s"] - told["laps"][1]["time_s"]
    assert delta["unit"] == "m"
    assert delta["delta_s"][-1] == pytest.approx(behind, abs=0.001)
    with pytest.raises(StationError, match="lap must be from 1 to"):
        answers["delta"]({**WHOLE, "one": "2", "other": "99"})


def test_a_range_without_laps_says_why():
    told = laps.laps_answers(driven_cloud())["laps"]({**WHOLE, "to_us": str(START + 10_000_000)})
    assert told["laps"] == []
    assert told["reason"].startswith("no laps: ")


class StepFunctions:
    """The state machine, which has three drives to analyse."""

    def __init__(self):
        self.started = []
        self.status = "RUNNING"

    def start_execution(self, **given):
        self.started.append(json.loads(given["input"]))
        return {"executionArn": f"arn:aws:states:eu-west-1:1:execution:iort-analysis:{given['name']}"}

    def describe_execution(self, executionArn):
        assert executionArn.startswith("arn:aws:states:eu-west-1:1:execution:iort-analysis:iort-")
        return {"status": self.status, "output": '{"findings": [0, 2, null]}', "cause": "the plan has failed"}

    def list_map_runs(self, **_given):
        return {"mapRuns": [{"mapRunArn": f"mapRun:iort/{label}:1"} for label in ("Plans", "Drives")]}

    def describe_map_run(self, **_given):
        return {"itemCounts": {"total": 3, "succeeded": 1, "failed": 1}}


class Analysing:
    """A cloud with the state machine alone."""

    def __init__(self):
        self.machine = StepFunctions()

    def client(self, _service):
        return self.machine

    def output(self, _noun, _name):
        return "arn:aws:states:eu-west-1:1:stateMachine:iort-analysis"


def test_an_analysis_is_started_and_followed_by_its_name():
    cloud = Analysing()
    run = insights.analyse(cloud, {"robot": "car", "last_s": "86400"})["run"]
    (asked,) = cloud.machine.started
    assert asked["robots"] == ["car"]
    assert asked["end_us"] - asked["start_us"] == DAY_US
    assert insights.progress(cloud, {"run": run}) == {"running": True, "drives": 3, "done": 2}
    cloud.machine.status = "SUCCEEDED"
    assert insights.progress(cloud, {"run": run})["running"] is False
    cloud.machine.status = "FAILED"
    with pytest.raises(StationError, match="failed: the plan has failed"):
        insights.progress(cloud, {"run": run})


def test_an_analysis_of_the_fleet_names_no_robot():
    cloud = Analysing()
    insights.analyse(cloud, {"last_s": "60"})
    assert cloud.machine.started[0]["robots"] == []
