"""The archive's and the analysis' part of the bill against arithmetic done by hand and the stacks."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from bench.load import message_sizes
from iort_contract.catalog.vesc import VESC_FIELDS
from iort_contract.cloud import PUBNUB
from iort_station.cli.main import app
from iort_station.cost import model, report
from iort_station.cost.prices import MONTH_DAYS, PRICES
from iort_station.cost.usage import Usage, variations
from stacks import analysis, archive, storage
from stacks.settings import Settings
from testkit.car import simulated_drive

_ONE = Usage()
# Dollars and units as the model computed them line by line, before it was a table.
FIGURES = json.loads(Path(__file__).with_name("figures.json").read_text())


def _units(usage, lane):
    return {(item.what, item.price): item.units for item in model.bill(usage) if item.lane == lane}


def test_the_archive_is_as_small_as_the_model_says():
    assert message_sizes.archived_share() == pytest.approx(model.ARCHIVED_SHARE, rel=0.05)


def test_an_archived_hour_is_read_twice_and_kept_in_two_classes():
    found = _units(_ONE, "archive")
    own = _ONE.own_batches_per_s * 3600 * model.OWN_ITEM_BYTES
    vesc = 3600 * model.sizes_of(50, 1).telemetry_item
    assert found["items read, and counted before they expire", "read"] == 2 * (vesc + own) / 4096
    later = (365 - 30) / MONTH_DAYS
    moved, small = (size * model.ARCHIVED_SHARE / 1e9 for size in (vesc, own))
    assert found["kept", "s3_instant"] == pytest.approx(moved * later)
    standard = moved * 30 / MONTH_DAYS + small * 365 / MONTH_DAYS
    assert found["kept", "s3_standard"] == pytest.approx(standard)
    # Three streams; their hours, days and nightly searches.
    assert found["tasks", "queue_request"] == 3 * 3 * (1 + 0.5 + 0.5)


def test_objects_below_128_kb_stay_in_s3_standard():
    found = _units(replace(_ONE, rate_hz=1.0, hours_per_day=0.1), "archive")
    assert found["kept", "s3_instant"] == found["objects", "s3_move"] == 0


def test_a_night_calls_a_function_for_each_drive_and_a_state_for_each_robot():
    found = _units(replace(_ONE, drive_minutes=15.0, robots=10), "analysis")
    assert found["invoked", "invocation"] == found["a state for each drive", "transition"] == 4
    # Two hours a day: half a night for each, with a tenth of the five states of all.
    assert found["states of the run, and of each robot", "transition"] == 0.5 + 5 * 0.05
    assert found["results written, PUT", "s3_put"] == 4 * model.DRIVE_OBJECTS


def test_without_archive_and_analysis_neither_is_billed():
    none = replace(_ONE, archive_days=0, drive_minutes=0.0)
    assert not {"archive", "analysis"} & {item.lane for item in model.bill(none)}


def test_the_model_has_the_memory_and_the_times_of_the_stacks():
    assert model.ARCHIVE_MB == archive._MEMORY_MB
    assert model.STANDARD_DAYS == storage._RARE_AFTER_DAYS
    large = Settings(account_concurrency=1000)
    assert (analysis._CORE_MB, large.at_once.drives) == (model.ANALYSIS_MB, model.DRIVES_AT_ONCE)


def test_the_command_compares_a_robot_year_in_the_table_with_one_in_the_archive(tmp_path):
    done = CliRunner().invoke(
        app, ["cost", "--hours-per-day", "4", "--json"], env={"XDG_CACHE_HOME": str(tmp_path)}
    )
    assert done.exit_code == 0, done.output
    table, first, later, *_ = json.loads(done.output)["robot_year"]
    assert table["dollars"] == pytest.approx(table["size_bytes"] / 1e9 * PRICES["storage"].each)
    assert table["dollars"] > 20 * first["dollars"] > 40 * later["dollars"]
    hour = model.recorded(Usage(hours_per_day=4))
    assert table["size_bytes"] == pytest.approx(4 * 365 * hour.table)


SETTINGS = {
    **dict(variations(Usage())),
    "three streams at 10 Hz by PubNub, always": Usage(
        streams=3, rate_hz=10.0, live_transport=PUBNUB, watched_hours=None, viewers=3
    ),
    "two hundred by PubNub with everything": Usage(
        robots=200,
        streams=2,
        rate_hz=100.0,
        batch_s=0.5,
        ping_hz=1.0,
        command_hz=5.0,
        questions_per_hour=30.0,
        connects_per_hour=4.0,
        hours_per_day=6.0,
        watched_hours=1.5,
        live_transport=PUBNUB,
        viewers=12,
        retention_days=60,
        archive_days=3000,
        drive_minutes=25.0,
        function_logs="all",
        recoverable=True,
        customer_key=True,
        device_defender=True,
        robot_metrics=True,
        live_concurrency=5,
        alarms=50,
        dashboards=(60, 20, 22),
    ),
    "slow and short": Usage(
        rate_hz=1.0,
        live_hz=0.05,
        hours_per_day=0.1,
        watched_hours=0.0,
        archive_days=20,
        agent_every_s=0.0,
        dashboard_hours=0.0,
    ),
    "ten thousand robots at 1000 Hz": Usage(
        robots=10_000, rate_hz=1000.0, live_hz=30.0, agent_every_s=1.0, viewers=2000, live_transport=PUBNUB
    ),
}


def by_lane(items):
    sums = Counter()
    for item in items:
        sums[f"{item.service}, {item.lane}"] += item.dollars
    return dict(sums)


@pytest.mark.parametrize("name", SETTINGS)
def test_the_figures_stay_as_they_were_first_computed(name):
    usage = SETTINGS[name]
    figures = {
        "aws": by_lane(model.bill(usage)),
        "thesis": by_lane(model.thesis_bill(usage)),
        "pubnub": by_lane(model.pubnub_bill(usage)),
        "month": model.deployment_dollars_per_month(usage),
        "year": {place.what: place.dollars for place in model.robot_year(usage)},
        "quotas": {need.name: need.needed for need in report.on_paper(usage).needs},
    }
    for table, expected in FIGURES[name].items():
        found = {what: value for what, value in figures[table].items() if value}
        assert found == pytest.approx(expected, rel=0.01), table


def test_every_setting_has_figures():
    assert FIGURES.keys() == SETTINGS.keys()


# The cost model's table of sizes matches measured sizes.


def test_each_item_of_a_second_fits_in_one_write_unit():
    """The cost depends on it: one byte over a kilobyte is billed as two units."""
    for robot_hz in (10, 50):
        measured = message_sizes.batch_sizes(robot_hz, 1.0)
        assert measured.telemetry_item <= 1024
        assert measured.summary_item <= 1024
    assert message_sizes.own_item_bytes() <= 1024


@pytest.mark.parametrize("row", model.TABLE, ids=lambda row: str(row.samples))
def test_the_table_of_sizes_matches_measured_sizes(row):
    # Versions of zlib differ a little in size.
    fresh = message_sizes.batch_sizes(row.samples, 1.0)
    assert row == pytest.approx(fresh, rel=0.03), "put in what `python -m bench.load.message_sizes` prints"


def test_the_other_sizes_match_measured_sizes():
    assert pytest.approx(message_sizes.own_item_bytes(), rel=0.03) == model.OWN_ITEM_BYTES
    kept = asdict(model.sizes_of(50.0, 1.0))
    for name, size in message_sizes.message_sizes().items():
        assert kept[name] == pytest.approx(size, rel=0.03), name


@pytest.mark.parametrize(
    ("rate_hz", "batch_s"), [(0.1, 1.0), (15.0, 1.0), (35.0, 1.0), (50.0, 0.2), (50.0, 0.0), (150.0, 1.0)]
)
def test_interpolated_sizes_are_close_to_measured_sizes(rate_hz, batch_s):
    found, fresh = model.sizes_of(rate_hz, batch_s), message_sizes.batch_sizes(rate_hz, batch_s)
    told = (found.record, found.telemetry_item, found.summary_item)
    assert told == pytest.approx(fresh[1:], rel=0.05)


def test_a_short_batch_of_a_fast_stream_is_overestimated_by_at_most_a_third():
    found, fresh = model.sizes_of(1000.0, 0.05), message_sizes.batch_sizes(1000.0, 0.05)
    assert fresh.telemetry_item <= found.telemetry_item <= 1.33 * fresh.telemetry_item


def test_the_simulated_drive_has_the_vescs_fields():
    assert list(simulated_drive(1)[0]) == [name for name, field in VESC_FIELDS.items() if 1 in field.ros]


@pytest.mark.parametrize(
    ("item", "expected"),
    [
        ({"a": "bc"}, 3),
        ({"n": 0}, 3),
        ({"n": 12345}, 5),
        ({"n": -1.5}, 4),
        ({"b": True}, 2),
        ({"l": [1, 12345]}, 1 + 3 + (1 + 2) + (1 + 4)),
    ],
)
def test_item_sizes_are_counted_as_dynamodb_counts_them(item, expected):
    assert message_sizes.item_bytes(item) == expected
