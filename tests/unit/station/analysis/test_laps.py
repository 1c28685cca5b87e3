"""`iort laps`, on a table in memory that holds the simulated car's laps."""

from __future__ import annotations

import json
from functools import cache

import pytest
from typer.testing import CliRunner

from iort_contract.catalog.derived import F1TENTH
from iort_contract.messages.batch import Batch
from iort_contract.topics import RECORD, build_topic
from iort_station.cli.cloud_options import CloudOptions
from iort_station.cli.main import app
from testkit.dynamodb import TELEMETRY, item_of
from tests.unit.analysis.drives import driven
from tests.unit.station.data.test_data import FakeCloud, cloud_of


def batches(block, boot="0badcafe"):
    """A batch a second."""
    times = block.times_us.tolist()
    columns = {name: column.tolist() for name, column in block.columns.items()}
    firsts = [i for i, t in enumerate(times) if i == 0 or t // 10**6 != times[i - 1] // 10**6]
    for seq, (i, end) in enumerate(zip(firsts, [*firsts[1:], len(times)], strict=True)):
        yield Batch(boot, seq, times[i:end], {name: values[i:end] for name, values in columns.items()})


@cache
def driven_cloud(*, pose: bool = True) -> FakeCloud:
    streams = driven(90).drive.streams
    made = cloud_of(*batches(streams["vesc"]), page_items=200, gain=str(F1TENTH.speed_to_erpm_gain))
    if pose:
        types = Batch("0badcafe", 0, streams["pose"].times_us[:1].tolist(), {"stream": ["pose"]})
        made.table.put(TELEMETRY, item_of(types, build_topic(RECORD, "car", "types")))
        for batch in batches(streams["pose"]):
            made.table.put(TELEMETRY, item_of(batch, build_topic(RECORD, "car", "pose")))
    return made


@pytest.fixture
def iort(monkeypatch, request):
    cloud = driven_cloud(pose=getattr(request, "param", True))
    monkeypatch.setattr(CloudOptions, "cloud", lambda _self: cloud)

    def run(*arguments):
        done = CliRunner().invoke(app, ["laps", "car", *arguments], env={"COLUMNS": "120"})
        return done.stdout, str(done.exception or "")

    return run


def test_the_laps_of_the_newest_run_are_listed_with_the_best_one(iort):
    said, _ = iort()
    told = json.loads(iort("--json")[0])["runs"][0]
    laps = told["laps"]
    assert len(laps) >= 6
    assert all(lap["method"] == "gate" and lap["energy_wh"] > 0 for lap in laps)
    best = min(laps, key=lambda lap: lap["time_s"])
    assert [lap["lap"] for lap in laps if lap["best"]] == [best["lap"]]
    assert f"{best['time_s']:.3f}" in next(line for line in said.splitlines() if line.endswith("best"))
    assert "by crossing a gate of the position; 100% sure" in said


@pytest.mark.parametrize("iort", [False], indirect=True)
def test_laps_without_a_position_say_that_they_are_by_the_pattern(iort):
    assert "by the pattern of the drive, because no stream has a position" in iort()[0]


def test_two_laps_are_compared_against_distance_and_drawn(iort, tmp_path):
    laps = json.loads(iort("--json")[0])["runs"][0]["laps"]
    file = tmp_path / "laps.png"
    said, _ = iort("--compare", "2", "4", "--out", str(file))
    assert file.read_bytes()[:4] == b"\x89PNG"
    behind = laps[3]["time_s"] - laps[1]["time_s"]
    word = "more" if behind > 0 else "less"
    assert f"lap 4 takes {abs(behind):.3f} s {word} than lap 2" in said
    places = json.loads(iort("--compare", "2", "4", "--json")[0])["places"]
    assert places[0]["delta_s"] == 0
    assert places[-1]["delta_s"] == pytest.approx(behind, abs=0.001)


def test_wrong_laps_and_ranges_say_what_is_there(iort):
    assert "--compare: lap must be from 1 to" in iort("--compare", "1", "99")[1]
    assert "give --compare too" in iort("--out", "laps.png")[1]
    assert iort("--to", "2020-01-01T00:00:00Z")[1] == "car has no runs in this range"
