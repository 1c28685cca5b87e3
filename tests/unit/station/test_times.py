"""Times as people write them."""

from __future__ import annotations

from datetime import datetime, timezone

import numpy as np
import pytest

from iort_station.errors import StationError, UsageError
from iort_station.times import duration_us, has_zone, iso, iso_s, time_us

NOW = 1_700_000_000_123_456


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("now", NOW),
        ("-10m", NOW - 600_000_000),
        ("-1.5h", NOW - 5_400_000_000),
        ("2023-11-14T22:13:20Z", 1_700_000_000_000_000),
        ("2023-11-14 23:13:20.5+01:00", 1_700_000_000_500_000),
        ("2023-11-14T22:13:20.123456789Z", 1_700_000_000_123_456),
        ("22:13:20Z", 1_700_000_000_000_000),
        ("22:14Z", 1_700_000_040_000_000 - 86_400_000_000),
        ("00:13+02:00", 1_699_999_980_000_000),
        ("9:00Z", 1_699_952_400_000_000),
        (17, 17),
        (np.int64(17), 17),
        (datetime(1970, 1, 1, 0, 0, 1, tzinfo=timezone.utc), 1_000_000),
    ],
)
def test_a_time_is_parsed(text, expected):
    assert time_us(text, NOW) == expected


def test_a_time_without_a_zone_is_in_this_machines_zone():
    assert time_us("2023-11-14T22:13:20", NOW) == datetime(2023, 11, 14, 22, 13, 20).timestamp() * 1e6  # noqa: DTZ001 - on purpose
    assert not has_zone("2023-11-14T22:13:20")
    assert not has_zone("2023-11-14")
    assert has_zone("2023-11-14T22:13:20Z")
    assert has_zone("2023-11-14 22:13+01:00")
    assert has_zone("-10m")
    assert has_zone("20:04Z")
    assert not has_zone("20:04")
    assert time_us("20:04", NOW) in {
        datetime(2023, 11, day, 20, 4).timestamp() * 1e6  # noqa: DTZ001 - on purpose
        for day in (13, 14, 15)
    }


@pytest.mark.parametrize("text", ["", "soon", "-10", "2023-13-01", "10m", "25:00", "20:60", "20:04:61"])
def test_an_invalid_time_is_refused(text):
    with pytest.raises(StationError, match=r"must be .*, got"):
        time_us(text, NOW)


@pytest.mark.parametrize(
    "value", [1.5, float("nan"), b"now", [1], np.datetime64("2023-11-14"), 2**70, -(2**70)]
)
def test_what_is_no_time_is_refused(value):
    with pytest.raises(UsageError, match=r"time must be microseconds since the epoch as an integer, .*, got"):
        time_us(value, NOW)


def test_durations_are_parsed():
    assert [duration_us(text) for text in ("100ms", "1s", "1 min", "0.5h", "7d")] == [
        100_000, 1_000_000, 60_000_000, 1_800_000_000, 604_800_000_000,
    ]  # fmt: skip
    for text in ("0s", "9" * 400 + "d"):
        with pytest.raises(StationError, match="duration must be"):
            duration_us(text)


def test_a_formatted_time_is_parsed_back():
    assert iso(NOW) == "2023-11-14T22:13:20.123456Z"
    assert time_us(iso(NOW), 0) == NOW
    assert iso_s(NOW) == "2023-11-14T22:13:20Z"
