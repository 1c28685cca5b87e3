"""The answers that the page gets about a car's past."""

from __future__ import annotations

import json

import numpy as np
import pytest

from iort_analysis.samples.blocks import values
from iort_contract.messages.batch import Batch
from iort_station.errors import StationError
from iort_station.page.answers import answers
from iort_station.page.history import MAX_ROWS, history
from tests.unit.station.data.test_data import START, cloud_of, ride

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


def test_a_row_has_the_last_text_or_bool_and_null_stays_null():
    times = [START + 20_000 * i for i in range(4)]
    columns = {"frame": ["a", "b", "c", "d"], "on": [True, False, True, True], "x": [None, None, 3.5, None]}
    found = history(cloud_of(Batch("0badcafe", 0, times, columns)), {**ASKED, "rows": "2"})
    assert found["fields"]["frame"]["mean"] == ["b", "d"]
    assert found["fields"]["on"]["mean"] == [False, True]
    assert found["fields"]["x"] == {"mean": [None, 3.5], "least": [None, 3.5], "most": [None, 3.5]}
    json.dumps(found, allow_nan=False)


def test_a_thumbnail_beside_nulls_is_not_lost():
    times = [START + 20_000 * i for i in range(6)]
    columns = {"n": list(range(6)), "data.thumbnail": [None, "first", None, None, None, None]}
    found = history(cloud_of(Batch("0badcafe", 0, times, columns)), {**ASKED, "rows": "2"})
    assert found["fields"]["data.thumbnail"]["mean"] == ["first", None]


def test_the_fields_of_an_attachment_are_of_one_sample():
    parts = {
        "key": ["a.jpg", "b.bin", None, None],
        "sha256": ["0" * 64, "1" * 64, None, None],
        "size": [1_000, 3_000, None, None],
        "content_type": ["image/jpeg", "application/octet-stream", None, None],
        "thumbnail": ["small a", None, None, None],
    }
    columns = {f"data.{part}": values for part, values in parts.items()}
    times = [START + 20_000 * i for i in range(4)]
    found = history(cloud_of(Batch("0badcafe", 0, times, columns)), {**ASKED, "rows": "2"})
    assert found["fields"] == {
        f"data.{part}": {"mean": [values[1], values[3]]} for part, values in parts.items()
    }


def test_the_mean_of_very_large_numbers_does_not_overflow():
    times = [START + 20_000 * i for i in range(6)]
    columns = {"x": [1e308, 1.5e308, -1e308, None, 1.7e308, -1.7e308]}
    found = history(cloud_of(Batch("0badcafe", 0, times, columns)), {**ASKED, "rows": "2"})
    assert found["fields"]["x"] == {
        "mean": [pytest.approx(0.5e308), pytest.approx(0)],
        "least": [-1e308, -1.7e308],
        "most": [1.5e308, 1.7e308],
    }
    found = history(cloud_of(Batch("0badcafe", 0, times, {"x": [1.7e308] * 6})), {**ASKED, "rows": "2"})
    assert found["fields"]["x"]["mean"] == pytest.approx([1.7e308] * 2)
    json.dumps(found, allow_nan=False)


def test_a_number_without_json_form_is_null():
    column = np.array([np.inf, 1.5, -np.inf, np.nan])
    assert values(column) == [None, 1.5, None, None]


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


def test_vehicles_are_the_robots_with_a_registered_gain():
    known = {"vehicles": {"car": {"speed_to_erpm_gain": 4614.0, "speed_to_erpm_offset": 0.0}}}
    assert answers(cloud_of(*ride(10), gain="4614"))["vehicles"]({}) == known
    assert answers(cloud_of(*ride(10)))["vehicles"]({}) == {"vehicles": {}}


def test_streams_are_the_stored_ones():
    assert answers(cloud_of(*ride(10)))["streams"]({"robot": "car"}) == {"streams": ["vesc"]}
