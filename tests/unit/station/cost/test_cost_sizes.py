"""The cost model's table of sizes matches measured sizes."""

from __future__ import annotations

from dataclasses import asdict

import pytest

from bench.meters import message_sizes
from iort_contract.catalog.vesc import VESC_FIELDS
from iort_station.cost import sizes
from testkit.car import simulated_drive


def test_each_item_of_a_second_fits_in_one_write_unit():
    """The cost depends on it: one byte over a kilobyte is billed as two units."""
    for robot_hz in (10, 50):
        measured = message_sizes.batch_sizes(robot_hz, 1.0)
        assert measured.telemetry_item <= 1024
        assert measured.summary_item <= 1024
    assert message_sizes.own_item_bytes() <= 1024


@pytest.mark.parametrize("row", sizes.TABLE, ids=lambda row: str(row.samples))
def test_the_table_of_sizes_matches_measured_sizes(row):
    # Versions of zlib differ a little in size.
    fresh = message_sizes.batch_sizes(row.samples, 1.0)
    assert row == pytest.approx(fresh, rel=0.03), "put in what `python -m bench.meters.message_sizes` prints"


def test_the_other_sizes_match_measured_sizes():
    assert pytest.approx(message_sizes.own_item_bytes(), rel=0.03) == sizes.OWN_ITEM_BYTES
    kept = asdict(sizes.sizes_of(50.0, 1.0))
    for name, size in message_sizes.message_sizes().items():
        assert kept[name] == pytest.approx(size, rel=0.03), name


@pytest.mark.parametrize(
    ("rate_hz", "batch_s"), [(0.1, 1.0), (15.0, 1.0), (35.0, 1.0), (50.0, 0.2), (50.0, 0.0), (150.0, 1.0)]
)
def test_interpolated_sizes_are_close_to_measured_sizes(rate_hz, batch_s):
    found, fresh = sizes.sizes_of(rate_hz, batch_s), message_sizes.batch_sizes(rate_hz, batch_s)
    told = (found.record, found.telemetry_item, found.summary_item)
    assert told == pytest.approx(fresh[1:], rel=0.05)


def test_a_short_batch_of_a_fast_stream_is_overestimated_by_at_most_a_third():
    found, fresh = sizes.sizes_of(1000.0, 0.05), message_sizes.batch_sizes(1000.0, 0.05)
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
