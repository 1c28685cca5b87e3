"""The archive's and the analysis' part of the bill against arithmetic done by hand and the stacks."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
from typer.testing import CliRunner

from bench.meters import message_sizes
from iort_station.cli.main import app
from iort_station.cost import sizes
from iort_station.cost.bill import analysing, archiving, model
from iort_station.cost.prices import MONTH_DAYS, PRICES
from iort_station.cost.usage import Usage
from stacks import analysis, archive, storage
from stacks.settings import Settings

_ONE = Usage()


def _units(usage, lane):
    return {(item.service, item.what): item.units for item in model.bill(usage) if item.lane == lane}


def test_the_archive_is_as_small_as_the_model_says():
    assert message_sizes.archived_share() == pytest.approx(sizes.ARCHIVED_SHARE, rel=0.05)


def test_an_archived_hour_is_read_twice_and_kept_in_two_classes():
    found = _units(_ONE, "archive")
    own = _ONE.own_batches_per_s * 3600 * sizes.OWN_ITEM_BYTES
    vesc = 3600 * sizes.sizes_of(50, 1).telemetry_item
    assert found["DynamoDB", "items read, and counted before they expire"] == 2 * (vesc + own) / 4096
    later = (365 - 30) / MONTH_DAYS
    moved, small = (size * sizes.ARCHIVED_SHARE / 1e9 for size in (vesc, own))
    assert found["S3", "kept, Glacier Instant Retrieval"] == pytest.approx(moved * later)
    standard = moved * 30 / MONTH_DAYS + small * 365 / MONTH_DAYS
    assert found["S3", "kept, S3 Standard"] == pytest.approx(standard)
    # Three streams; their hours, days and nightly searches.
    assert found["SQS", "tasks"] == 3 * 3 * (1 + 0.5 + 0.5)


def test_objects_below_128_kb_stay_in_s3_standard():
    found = _units(replace(_ONE, rate_hz=1.0, hours_per_day=0.1), "archive")
    assert found["S3", "kept, Glacier Instant Retrieval"] == found["S3", "moved to the cheaper class"] == 0


def test_a_night_calls_a_function_for_each_drive_and_a_state_for_each_robot():
    found = _units(replace(_ONE, drive_minutes=15.0, robots=10), "analysis")
    assert found["Lambda", "invoked"] == found["Step Functions", "a state for each drive"] == 4
    # Two hours a day: half a night for each, with a tenth of the five states of all.
    assert found["Step Functions", "states of the run, and of each robot"] == 0.5 + 5 * 0.05
    assert found["S3", "results written, PUT"] == 4 * analysing.Function().objects


def test_without_archive_and_analysis_neither_is_billed():
    none = replace(_ONE, archive_days=0, drive_minutes=0.0)
    assert not {"archive", "analysis"} & {item.lane for item in model.bill(none)}


def test_the_model_has_the_memory_and_the_times_of_the_stacks():
    assert archiving.MEMORY_MB == archive._MEMORY_MB
    assert archiving.STANDARD_DAYS == storage._RARE_AFTER_DAYS
    one = analysing.Function()
    large = Settings(account_concurrency=1000)
    assert (one.memory_mb, one.at_once) == (analysis._CORE_MB, large.at_once.drives)


def test_the_command_compares_a_robot_year_in_the_table_with_one_in_the_archive(tmp_path):
    done = CliRunner().invoke(
        app, ["cost", "--hours-per-day", "4", "--json"], env={"XDG_CACHE_HOME": str(tmp_path)}
    )
    assert done.exit_code == 0, done.output
    table, first, later, *_ = json.loads(done.output)["robot_year"]
    assert table["dollars"] == pytest.approx(table["size_bytes"] / 1e9 * PRICES["storage"].each)
    assert table["dollars"] > 20 * first["dollars"] > 40 * later["dollars"]
    hour = archiving.recorded(Usage(hours_per_day=4))
    assert table["size_bytes"] == pytest.approx(4 * 365 * hour.table)
