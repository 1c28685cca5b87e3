"""The runs of a robot, and the laps in them."""

from __future__ import annotations

import json
from functools import cache

import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from iort_contract.catalog.derived import F1TENTH
from iort_contract.catalog.streams import ACCOUNT_STREAM
from iort_contract.messages.account import SourceAccount, StreamAccount
from iort_contract.messages.batch import Batch
from iort_contract.topics import RECORD, build_topic
from iort_station.cli.main import app
from iort_station.cli.options import CloudOptions
from iort_station.data.runs import runs
from iort_station.errors import StationError
from iort_station.page.answers import answers
from testkit.dynamodb import TELEMETRY, item_of
from tests.unit.analysis.simulated import driven
from tests.unit.station.data.test_queries import START, FakeCloud, cloud_of

SECOND = 1_000_000


def run_of(number, start_us, batches, every_us=SECOND, first_seq=0):
    """The batches of a run; each has two samples."""
    starts = [start_us + i * every_us for i in range(batches)]
    return [
        Batch(f"{number:08x}", first_seq + i, [at, at + min(every_us, SECOND) // 2], {"speed": [1, 2]})
        for i, at in enumerate(starts)
    ]


def put(cloud, stream, *batches):
    for batch in batches:
        cloud.table.put(TELEMETRY, item_of(batch, build_topic(RECORD, "car", stream)))


def report(number, t_us, *accounts):
    samples = [one.sample() for one in accounts]
    columns = {name: [sample.get(name) for sample in samples] for sample in samples for name in sample}
    return Batch(f"{number:08x}", 0, [t_us] * len(samples), columns)


@given(
    st.lists(
        st.tuples(
            st.integers(1, 2000),  # microseconds or seconds between two runs
            st.sampled_from([1, SECOND]),
            st.integers(1, 60),
            st.sampled_from([1_000, 100_000, SECOND, 40 * SECOND]),
            st.sampled_from([0, 0, 7, 5_000]),
        ),
        min_size=1,
        max_size=6,
    )
)
def test_the_runs_are_found_whatever_their_pauses_rates_and_numbers(given_runs):
    """More than one batch a second, or numbers that go on over runs, make the first jump too long. Fewer make
    it too short."""
    made, at_us = [], START
    for number, (pause, unit_us, batches, every_us, first_seq) in enumerate(given_runs):
        made.append(run_of(number, at_us, batches, every_us, first_seq))
        at_us = made[-1][-1].times_us[-1] + pause * unit_us
    found = runs(cloud_of(*(batch for one in made for batch in one)), "car")
    assert [(run["run"], run["from_us"], run["to_us"]) for run in found["runs"]] == [
        (one[0].boot, one[0].t_us, one[-1].times_us[-1] + 1) for one in reversed(made)
    ]
    assert [run["streams"]["vesc"]["batches"] for run in found["runs"]] == [
        len(one) for one in reversed(made)
    ]
    assert found["streams"] == {"vesc": {"from_us": START, "to_us": made[-1][-1].times_us[-1] + 1}}


def test_a_run_costs_a_few_reads_of_one_batch_however_long_it_is():
    cloud = cloud_of(
        *run_of(1, START, 10_000), *run_of(2, START + 86_400 * SECOND, 10_000), page_items=1_000_000
    )
    assert len(runs(cloud, "car")["runs"]) == 2
    assert cloud.table.read < 40


def test_a_run_has_every_stream_and_what_its_agent_reports():
    cloud = cloud_of(*run_of(1, START, 3), *run_of(2, START + 100 * SECOND, 3))
    put(cloud, "odom", *run_of(2, START + 90 * SECOND, 20))
    put(
        cloud,
        ACCOUNT_STREAM,
        report(
            2,
            START + 110 * SECOND,
            StreamAccount("vesc", 6, 6, 0, 0, 0, 3, ended=True),
            StreamAccount("odom", 41, 40, 1, 0, 0, 20, ended=True),
            SourceAccount("ros1", {"/tf.malformed": 2, "/tf.published": 9}),
        ),
        # A run of a car that stood there without a source.
        report(3, START + 200 * SECOND, StreamAccount("vesc", 0, 0, 0, 0, 0, 0, ended=False)),
    )
    idle, newer, older = runs(cloud, "car")["runs"]
    assert (idle["streams"], idle["state"]) == ({}, "cut off")
    assert newer == {
        "run": "00000002",
        "from_us": START + 90 * SECOND,
        "to_us": START + 109 * SECOND + SECOND // 2 + 1,
        "state": "ended",
        "lost": 3,
        "streams": {
            "odom": {
                "from_us": START + 90 * SECOND,
                "to_us": START + 109 * SECOND + SECOND // 2 + 1,
                "batches": 20,
                "samples": 40,
            },
            "vesc": {
                "from_us": START + 100 * SECOND,
                "to_us": START + 102 * SECOND + SECOND // 2 + 1,
                "batches": 3,
                "samples": 6,
            },
        },
    }
    assert (older["state"], older["streams"]["vesc"]["samples"]) == ("unknown", None)


def test_a_run_that_goes_on_after_the_range_is_not_cut_off():
    cloud = cloud_of(*run_of(1, START, 3))
    for second, ended in ((30, False), (60, True)):
        count = StreamAccount("vesc", 6, 6, 0, 0, 0, 3, ended=ended)
        put(cloud, ACCOUNT_STREAM, report(1, START + second * SECOND, count))
    ends = (None, START + 61 * SECOND, START + 60 * SECOND, START + 2 * SECOND)
    states = [runs(cloud, "car", end_us=end_us)["runs"][0]["state"] for end_us in ends]
    assert states == ["ended", "ended", "unknown", "unknown"]


def test_the_page_gets_the_newest_runs_and_then_the_older_ones():
    starts = [START + i * 1_000 * SECOND for i in range(5)]
    cloud = cloud_of(*(batch for i, at in enumerate(starts) for batch in run_of(i, at, 30)))
    ask = answers(cloud)["runs"]
    newest = ask({"robot": "car", "count": "3"})
    assert [run["from_us"] for run in newest["runs"]] == starts[:1:-1]
    assert newest["older"]
    rest = ask({"robot": "car", "count": "3", "before_us": str(newest["runs"][-1]["from_us"])})
    assert [run["from_us"] for run in rest["runs"]] == starts[1::-1]
    assert not rest["older"]
    assert rest["streams"] == newest["streams"]


def test_an_unknown_robot_has_no_runs():
    with pytest.raises(StationError, match="robot cra is not registered"):
        runs(cloud_of(), "cra")
    assert answers(cloud_of())["runs"]({"robot": "cra", "count": "3"})["runs"] == []


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
