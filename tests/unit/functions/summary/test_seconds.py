"""A second's summary is stored packed and read flat."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from functions.shared.tables import attribute
from iort_contract.codec.seconds import flat_second
from iort_contract.dynamodb import plain
from iort_contract.messages.batch import Batch
from iort_contract.statistics import summarize_second
from iort_contract.tables import EXPIRES_S, OMITTED, SECOND, STATS, TOPIC

# Field names that look like a second's other keys or like another field's statistics.
COUNTS = ["n", "batches", "gaps", "topic", "second", "expires_s", "omitted"]
AWKWARD = [*COUNTS, "a", "a_last", "a_min", "a_last_last"]
names = st.sampled_from(AWKWARD) | st.from_regex(r"[a-z]{1,3}(_(min|mean|max|last)){0,2}", fullmatch=True)
numbers = st.integers(-5, 5) | st.floats(-1e9, 1e9) | st.sampled_from([1e300, -1e-200])
values = numbers | st.none() | st.booleans() | st.text(max_size=3)


three = {"min_size": 3, "max_size": 3}


@given(st.dictionaries(names, st.lists(numbers, **three) | st.lists(values, **three)))
def test_a_packed_second_is_read_as_it_was_summarized(columns):
    packed = summarize_second(0, [Batch("0badcafe", 0, [0, 10, 20], columns)], None)
    assert packed is not None
    packed[EXPIRES_S] = 1_800_000_000
    made = flat_second(packed)
    for name, column in columns.items():
        known = [value for value in column if value is not None]
        if known:
            assert made[f"{name}_last"] == known[-1]
        if known and {type(value) for value in known} <= {int, float}:
            assert (made[f"{name}_min"], made[f"{name}_max"]) == (min(known), max(known))
    assert not packed.keys() & {TOPIC, SECOND, OMITTED}
    # The same through the table, with Decimals as numbers.
    stored = plain({name: attribute(value) for name, value in packed.items()})
    assert flat_second(stored) == plain({name: attribute(value) for name, value in made.items()})


def test_a_second_that_was_stored_flat_is_still_read():
    flat = {"n": 50, "speed_min": 1, "speed_mean": 1.5, "speed_max": 2, "speed_last": 2, "mode_last": "x"}
    assert flat_second(flat) == flat


@pytest.mark.parametrize(
    ("columns", "expected"),
    [
        ({"a": [1, 2, 4.5]}, {"a": [1, 2.5, 4.5, 4.5]}),
        ({"a": [7, 7, 7]}, {"a": [7]}),
        ({"a": ["x", "y", None]}, {"a_last": "y"}),
        ({"a": [1, 2, "y"]}, {"a_last": "y"}),
        ({"gaps": [1, 1, 1]}, {f"gaps_{statistic}": 1 for statistic in STATS}),
    ],
)
def test_a_second_is_packed_as_documented(columns, expected):
    packed = summarize_second(0, [Batch("0badcafe", 0, [0, 10, 20], columns)], None)
    whole = {"n": 3, "batches": 1, "missing_batches": 0, "gaps": 0, "nonfinite": 0}
    assert packed == {**whole, **expected}
