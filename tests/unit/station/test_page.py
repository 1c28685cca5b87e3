"""The page's answers, and its publication."""

from __future__ import annotations

import json

import boto3
import numpy as np
import pytest
from moto import mock_aws

from iort_contract.catalog.analysis import GROUPS
from iort_contract.messages.analysis import AnalysedDrive, DriveKey, Estimate, Finding
from iort_contract.messages.batch import Batch
from iort_contract.topics import RECORD, build_topic
from iort_contract.track import Track
from iort_station.errors import StationError
from iort_station.page import insights
from iort_station.page.answers import answers
from iort_station.page.history import MAX_ROWS, history
from iort_station.page.page import config, site_files, upload
from testkit.dynamodb import ROBOTS, TELEMETRY, item_of, serialize
from tests.unit.station.data.test_queries import START, cloud_of, ride
from tests.unit.station.data.test_runs import driven_cloud

ASKED = {
    "robot": "car",
    "stream": "vesc",
    "from_us": str(START),
    "to_us": str(START + 10_000_000),
    "rows": "50",
}


def test_few_samples_are_returned_unchanged():
    found = history(cloud_of(*ride(40)), ASKED)
    assert found["samples"] == 40
    assert found["row_s"] == 0
    assert found["times_s"] == [(START + 20_000 * i) / 1e6 for i in range(40)]
    assert found["fields"] == {"speed": {"mean": list(range(40))}}


def test_short_ranges_have_the_derived_fields_of_the_summary():
    found = history(cloud_of(*ride(3, fields=("voltage_input", "current_input"))), ASKED)
    assert found["fields"]["power_w"] == {"mean": [0, 1, 4]}


def test_many_samples_are_returned_as_mean_least_and_most():
    found = history(cloud_of(*ride(500)), ASKED)
    speed = found["fields"]["speed"]
    assert found["samples"] == 500
    assert len(found["times_s"]) <= 50
    assert found["row_s"] == pytest.approx(0.2, abs=0.001)
    # Every sample is in one row: the rows' numbers follow one another.
    assert speed["least"][0] == 0
    assert speed["most"][-1] == 499
    assert [a - b for a, b in zip(speed["least"][1:], speed["most"], strict=False)] == [1] * (
        len(speed["most"]) - 1
    )
    assert speed["mean"] == pytest.approx((np.array(speed["least"]) + np.array(speed["most"])) / 2)


def two_rows(columns):
    """The fields of two rows of these samples."""
    times = [START + 20_000 * i for i in range(len(next(iter(columns.values()))))]
    found = history(cloud_of(Batch("0badcafe", 0, times, columns)), {**ASKED, "rows": "2"})
    json.dumps(found, allow_nan=False)
    return found["fields"]


@pytest.mark.parametrize(
    ("column", "rows"),
    [
        (["a", "b", "c", "d"], {"mean": ["b", "d"]}),
        ([True, False, True, True], {"mean": [False, True]}),
        ([None, None, 3.5, None], {"mean": [None, 3.5], "least": [None, 3.5], "most": [None, 3.5]}),
        # A thumbnail beside nulls is not lost.
        ([None, "first", None, None, None, None], {"mean": ["first", None]}),
        # Their sum is beyond the largest number.
        ([1.7e308] * 4, {"mean": [None] * 2, "least": [1.7e308] * 2, "most": [1.7e308] * 2}),
    ],
)
def test_a_row_of_several_samples_has_their_extremes_or_the_last_that_is_not_null(column, rows):
    assert two_rows({"x": column, "n": list(range(len(column)))})["x"] == rows


def test_the_fields_of_an_attachment_are_of_one_sample():
    parts = {
        "key": ["a.jpg", "b.bin", None, None],
        "sha256": ["0" * 64, "1" * 64, None, None],
        "size": [1_000, 3_000, None, None],
        "content_type": ["image/jpeg", "application/octet-stream", None, None],
        "thumbnail": ["small a", None, None, None],
    }
    columns = {f"data.{part}": values for part, values in parts.items()}
    assert two_rows(columns) == {
        f"data.{part}": {"mean": [values[1], values[3]]} for part, values in parts.items()
    }


def test_a_position_is_that_of_a_rows_last_sample_and_no_mean_beside_the_track():
    corner = {"x": [0.0, 4.0, 4.0, None], "y": [0.0, 0.0, 4.0, 4.0]}
    rows = two_rows(corner)
    assert (rows["x"]["mean"], rows["y"]["mean"]) == ([4.0, 4.0], [0.0, 4.0])
    assert (rows["x"]["least"], rows["x"]["most"]) == ([0.0, 4.0], [4.0, 4.0])
    degrees = two_rows({"latitude": [48.1, 48.2, 48.3, 48.4], "longitude": [11.1, 11.2, 11.3, 11.4]})
    assert (degrees["latitude"]["mean"], degrees["longitude"]["mean"]) == ([48.2, 48.4], [11.2, 11.4])


def test_the_fields_of_each_stream_say_which_are_its_position():
    cloud = cloud_of(Batch("0badcafe", 0, [START], {"voltage_input": [12.0], "current_input": [1.0]}))
    for stream, columns in {
        "pose": {"pose.position.x": [1.0], "pose.position.y": [2.0], "frame": ["map"]},
        "gps": {"latitude": [48.1], "longitude": [11.5]},
        "laps": {"x_m": [1.0], "y_m": [2.0], "lap": [3]},
    }.items():
        cloud.table.put(
            TELEMETRY, item_of(Batch("0badcafe", 0, [START], columns), build_topic(RECORD, "car", stream))
        )
    cloud.table.put(ROBOTS, {"robot": serialize("car"), "streams": serialize({"pose", "gps", "laps"})})
    found = answers(cloud)["fields"]({"robot": "car"})["streams"]
    assert found == {
        "gps": {"numbers": ["latitude", "longitude"], "position": ["latitude", "longitude"], "degrees": True},
        "laps": {"numbers": ["lap", "x_m", "y_m"], "position": ["x_m", "y_m"], "degrees": False},
        "pose": {
            "numbers": ["pose.position.x", "pose.position.y"],
            "position": ["pose.position.x", "pose.position.y"],
            "degrees": False,
        },
        "vesc": {
            "numbers": ["current_input", "power_w", "voltage_input"],
            "position": [],
            "degrees": False,
        },
    }


def test_the_raceline_is_that_of_the_pages_track():
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    half = (1.0,) * 40
    track = Track(tuple(10 * np.cos(angle)), tuple(10 * np.sin(angle)), half, half)
    cloud = cloud_of()
    found = answers(cloud, track)["raceline"]({})
    radius = np.hypot(found["x_m"], found["y_m"])
    # Of a circle the widest line has the least curvature: 0.15 m of the car are beside it.
    assert radius == pytest.approx(np.full(len(radius), 10.85), abs=0.05)
    assert found["lap_s"] > 5
    assert answers(cloud)["raceline"]({})["reason"] == "the page has no track"
    narrow = Track(track.x_m, track.y_m, (0.1,) * 40, (0.1,) * 40)
    assert "must be wider than the car" in answers(cloud, narrow)["raceline"]({})["reason"]


def test_an_empty_range_gives_an_empty_result():
    late = {**ASKED, "from_us": str(START + 60_000_000), "to_us": str(START + 61_000_000)}
    found = history(cloud_of(*ride(10)), late)
    assert (found["samples"], found["times_s"]) == (0, [])


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"robot": ""}, "must have the parameter robot"),
        ({"robot": "../x"}, "robot name"),
        ({"robot": "nobody"}, "robot nobody is not registered"),
        ({"stream": "odom"}, "has no stream odom"),
        ({"from_us": "-1"}, "from_us"),
        ({"from_us": "9" * 400}, "from_us"),
        ({"from_us": "\u0661"}, "from_us"),
        ({"to_us": str(START)}, "must end after its start"),
        ({"rows": "1"}, "rows"),
        ({"rows": str(MAX_ROWS + 1)}, "rows"),
    ],
)
def test_an_invalid_question_is_refused_with_the_reason(change, says):
    with pytest.raises(StationError, match=says):
        history(cloud_of(*ride(10)), {**ASKED, **change})


def test_streams_are_the_stored_ones_and_vehicles_the_robots_with_a_registered_gain():
    assert answers(cloud_of(*ride(10)))["streams"]({"robot": "car"}) == {"streams": ["vesc"]}
    known = {"vehicles": {"car": {"speed_to_erpm_gain": 4614.0, "speed_to_erpm_offset": 0.0}}}
    assert answers(cloud_of(*ride(10), gain="4614"))["vehicles"]({}) == known
    assert answers(cloud_of(*ride(10)))["vehicles"]({}) == {"vehicles": {}}


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
    cloud = driven_cloud()
    told = json.loads(json.dumps(insights.laps(cloud, WHOLE), allow_nan=False))
    assert told["method"] == "gate"
    assert len(told["laps"]) >= 6
    compared = {**WHOLE, "one": "2", "other": "3"}
    delta = json.loads(json.dumps(insights.delta(cloud, compared), allow_nan=False))
    behind = told["laps"][2]["time_s"] - told["laps"][1]["time_s"]
    assert delta["unit"] == "m"
    assert delta["delta_s"][-1] == pytest.approx(behind, abs=0.001)
    with pytest.raises(StationError, match="lap must be from 1 to"):
        insights.delta(cloud, {**compared, "other": "99"})


def test_a_range_without_laps_says_why():
    told = insights.laps(driven_cloud(), {**WHOLE, "to_us": str(START + 10_000_000)})
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
    insights.analyse(cloud, {"last_s": "60"})
    asked, fleet = cloud.machine.started
    assert fleet["robots"] == []
    assert asked["robots"] == ["car"]
    assert asked["end_us"] - asked["start_us"] == DAY_US
    assert insights.progress(cloud, {"run": run}) == {"running": True, "drives": 3, "done": 2}
    cloud.machine.status = "SUCCEEDED"
    assert insights.progress(cloud, {"run": run})["running"] is False
    cloud.machine.status = "FAILED"
    with pytest.raises(StationError, match="failed: the plan has failed"):
        insights.progress(cloud, {"run": run})


TOLD = config(namespace="iort", subscribe_key="sub-c-1", token="abc_DEF-1=")


@pytest.fixture
def built(tmp_path):
    (tmp_path / "index.html").write_text("<!doctype html>")
    (tmp_path / "page.js").write_text("1")
    (tmp_path / "secret.pem").write_text("a key")
    return tmp_path


def test_only_the_build_and_the_configuration_are_uploaded(built):
    content = site_files(TOLD, built)
    assert content.keys() == {"index.html", "page.js", "config.json"}
    told = json.loads(content["config.json"])
    assert told["answers"] is False
    assert told["token"] == "abc_DEF-1="
    assert not any(b"pub-c-" in body or b"sec-c-" in body for body in content.values())


def test_a_page_without_a_build_is_an_error(tmp_path):
    with pytest.raises(StationError, match="not built"):
        site_files(TOLD, tmp_path)


@mock_aws
def test_the_bucket_holds_exactly_the_uploaded_files(built):
    s3 = boto3.client("s3", region_name="us-east-1", aws_access_key_id="x", aws_secret_access_key="x")
    s3.create_bucket(Bucket="page")
    s3.put_object(Bucket="page", Key="old.js", Body=b"old")
    content = site_files(TOLD, built)
    assert upload(s3, "page", content) == ["old.js"]
    assert upload(s3, "page", content) == []
    held = {entry["Key"] for entry in s3.list_objects_v2(Bucket="page")["Contents"]}
    assert held == content.keys()
    page = s3.get_object(Bucket="page", Key="page.js")
    assert page["ContentType"].startswith("text/javascript")
    assert page["CacheControl"] == "no-cache"
    assert page["Body"].read() == b"1"
