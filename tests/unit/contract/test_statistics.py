"""The summary of a second counts every sample once, in whichever batch it arrived."""

from __future__ import annotations

import math
from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iort_contract.catalog.derived import Vehicle, derive
from iort_contract.codec import flat_second
from iort_contract.messages.batch import Batch, BatchId, RunEnd
from iort_contract.statistics import count_holes, missing_before, summarize_second

S = 1_000_000
SECOND = 1_700_000_000
T0 = SECOND * S
CAR = Vehicle(speed_to_erpm_gain=4614.0, speed_to_erpm_offset=10.0)


def batch(times_us, columns=None, *, seq=0, boot="aaaaaaaa", nonfinite=0):
    return Batch(boot, seq, list(times_us), columns or {}, nonfinite)


def every(step_us, n, start_us=T0):
    return [start_us + i * step_us for i in range(n)]


def summarized(second, batches, vehicle, missing=0):
    found = summarize_second(second, batches, vehicle, missing)
    return None if found is None else flat_second(found)


# --- one second -------------------------------------------------------------------------------------


def test_a_summary_has_min_mean_max_and_last_of_every_field_and_counts_gaps():
    first = batch(every(100_000, 5), {"speed": [4624, 10, 9238, 10, 10], "mode": ["a", "b", None, "c", "d"]})
    assert summarized(SECOND, [first], CAR) == {
        "n": 5,
        "batches": 1,
        "missing_batches": 0,
        "gaps": 0,
        "nonfinite": 0,
        "speed_min": 10,
        "speed_mean": 2778.4,
        "speed_max": 9238,
        "speed_last": 10,
        "mode_last": "d",
        "speed_mps_min": 0.0,
        "speed_mps_mean": 0.6,
        "speed_mps_max": 2.0,
        "speed_mps_last": 0.0,
    }


def test_a_second_without_a_sample_has_no_summary():
    assert summarized(SECOND, [], CAR) is None
    assert summarized(SECOND, [batch([T0 - 1], {"a": [1]}), batch([T0 + S], {"a": [1]})], CAR) is None


def test_a_batch_across_two_seconds_counts_each_sample_in_its_own_second():
    across = batch([T0 - 20_000, T0 - 1, T0, T0 + 20_000], {"a": [1, 2, 3, 4]}, seq=4, nonfinite=3)
    before, after = (summarized(SECOND - back, [across], None, missing=4 * back) for back in (1, 0))
    assert (before["n"], before["a_min"], before["a_max"], before["a_last"]) == (2, 1, 2, 2)
    assert (after["n"], after["a_min"], after["a_max"], after["a_last"]) == (2, 3, 4, 4)
    assert (before["batches"], after["batches"]) == (1, 1)
    assert (before["missing_batches"], after["missing_batches"]) == (4, 0)
    # Figures of the whole batch count once, in the second in which it starts.
    assert (before["nonfinite"], after["nonfinite"]) == (3, 0)


def test_the_first_second_of_the_epoch_has_a_summary():
    early = batch([0, 999_999, 1_000_000], {"a": [1, 2, 3]})
    assert summarized(0, [early], None)["n"] == 2
    assert summarized(1, [early], None)["n"] == 1
    assert summarized(-1, [early], None) is None


def test_samples_with_equal_times_all_count():
    twice = batch([T0, T0, T0 + 1], {"a": [1, 2, 3]})
    second = summarized(SECOND, [twice], None)
    assert (second["n"], second["a_min"], second["a_mean"], second["a_last"]) == (3, 1, 2, 3)


def test_fields_appear_and_vanish_from_batch_to_batch():
    batches = [
        batch(every(10_000, 2), {"a": [1, 2], "voltage_input": [10, 11]}, seq=0),
        batch(every(10_000, 2, T0 + 20_000), {"b": [5, None], "current_input": [2, 3]}, seq=1),
        batch(
            every(10_000, 2, T0 + 40_000),
            {"a": [None, 7], "voltage_input": [12, 13], "current_input": [1, 2]},
        ),
    ]
    second = summarized(SECOND, batches, None)
    assert (second["a_min"], second["a_mean"], second["a_max"], second["a_last"]) == (
        1,
        pytest.approx(10 / 3),
        7,
        7,
    )
    assert (second["b_min"], second["b_last"]) == (5, 5)
    # Power needs both in the same sample.
    assert (second["power_w_min"], second["power_w_max"], second["power_w_last"]) == (12, 26, 26)


def test_a_field_of_nulls_is_left_out_and_a_field_of_text_or_bools_keeps_its_last_value():
    columns = {
        "none": [None] * 3,
        "text": ["a", "b", None],
        "flag": [True, False, None],
        "mixed": [1, "x", 2.5],
    }
    second = summarized(SECOND, [batch(every(1, 3), columns)], None)
    assert {k: v for k, v in second.items() if "_" in k and not k.startswith("missing")} == {
        "text_last": "b",
        "flag_last": False,
        "mixed_last": 2.5,
    }


def test_a_sensor_that_is_not_fitted_is_counted_and_gives_no_temperature():
    columns = {
        "temp_motor": [-273.15, 31, 33, -50],
        "temp_fet": [-57] * 4,
        "temperature_pcb": [None, -49.9, "cold", -60],
        "current_motor": [-60] * 4,
    }
    second = summarized(SECOND, [batch(every(1, 4), columns)], None)
    assert [second[f"temp_motor_{name}"] for name in ("min", "mean", "max", "last")] == [31, 32, 33, 33]
    assert not [name for name in second if name.startswith("temp_fet")]
    assert second["temperature_pcb_last"] == "cold"
    assert second["current_motor_mean"] == -60
    assert second["absent"] == 2 + 4 + 1
    assert "absent" not in summarized(SECOND, [batch(every(1, 4), {"temp_motor": [31] * 4})], None)


@pytest.mark.parametrize(
    "column",
    [
        [1e308, 1.7e308, 1.79e308],
        [-1.7e308, -1.7e308, 1.7e308],
        [5e-324, 5e-324, 0],
        [2**64 - 1, 2**53 + 1, -(2**63)],
        [2**53 + 1, 2**53 + 1, 2**53 + 1],
        [1e300, 5e-324, 2**64 - 1],
        [0.1, 0.1, 0.1],
        [1234567891, 1234567891, 1234567891],
    ],
)
def test_numbers_at_the_ends_of_their_ranges_are_summarized(column):
    second = summarized(SECOND, [batch(every(1, 3), {"a": column})], None)
    assert (second["a_min"], second["a_max"], second["a_last"]) == (min(column), max(column), column[-1])
    assert second["a_min"] <= second["a_mean"] <= second["a_max"]
    exact = float(sum(map(Fraction, column)) / 3)
    assert second["a_mean"] == pytest.approx(exact, rel=1e-8, abs=max(map(abs, column)) * 1e-15)


numbers = st.integers(-(2**63), 2**64 - 1) | st.floats(allow_nan=False, allow_infinity=False)


@given(st.lists(numbers, min_size=1, max_size=30), st.lists(numbers, min_size=1, max_size=30))
def test_every_number_has_a_finite_summary_within_its_bounds(column, other):
    n = min(len(column), len(other))
    columns = {"speed": column[:n], "voltage_input": column[:n], "current_input": other[:n]}
    for vehicle in (None, CAR, Vehicle(1e-100), Vehicle(-1e300, 1e308)):
        second = summarized(SECOND, [batch(every(1, n), columns)], vehicle)
        for field in ("speed", "voltage_input", "current_input", "power_w", "speed_mps"):
            if f"{field}_mean" in second:
                assert math.isfinite(second[f"{field}_mean"])
                assert second[f"{field}_min"] <= second[f"{field}_mean"] <= second[f"{field}_max"]
            else:
                assert field in ("power_w", "speed_mps")


# --- derived ----------------------------------------------------------------------------------------


def test_speed_needs_the_vehicle_and_power_needs_both_fields():
    columns = {
        "speed": [4624.0, None, "fast", True],
        "voltage_input": [16, 16, None, 16],
        "current_input": [2] * 4,
    }
    assert derive(columns, CAR)["speed_mps"] == [1.0, None, None, None]
    assert derive(columns, None).keys() == {"power_w"}
    assert derive(columns, None)["power_w"] == [32, 32, None, 32]
    assert derive({"voltage_input": [16]}, CAR) == {}
    assert derive({}, CAR) == {}


def test_a_derived_value_is_never_infinite():
    columns = {"speed": [1e308], "voltage_input": [1e308], "current_input": [-1e308]}
    assert derive(columns, Vehicle(1e-10)) == {"speed_mps": [None], "power_w": [None]}


# --- missing batches and holes ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("previous", "seq", "boot", "missing"),
    [
        (None, 0, "aaaaaaaa", 0),
        (None, 3, "aaaaaaaa", 3),
        (0, 1, "aaaaaaaa", 0),
        (0, 2, "aaaaaaaa", 1),
        (7, 70, "aaaaaaaa", 62),
        # After a restart, numbers continue if the spool survived and start at 0 if it was lost.
        (7, 8, "bbbbbbbb", 0),
        (7, 9, "bbbbbbbb", 1),
        (7, 0, "bbbbbbbb", 0),
        (7, 2, "bbbbbbbb", 2),
        # Another clock gave a later number an earlier time: the numbers before this one are still missing.
        (7, 3, "aaaaaaaa", 3),
        (7, 0, "aaaaaaaa", 0),
    ],
)
def test_missing_batches_are_counted_by_sequence_number(previous, seq, boot, missing):
    near = [] if previous is None else [BatchId(T0, "aaaaaaaa", previous)]
    own = BatchId(T0 + 1, boot, seq)
    assert missing_before(own, near) == missing
    # Later batches and the batch itself change nothing.
    assert missing_before(own, [*near, own, BatchId(T0 + 2, boot, seq + 1)]) == missing


@pytest.mark.parametrize(
    ("near", "seq", "previous", "missing"),
    [
        ([], 0, [], 0),
        ([], 3, [], 3),
        ([("aaaaaaaa", 0)], 0, [("aaaaaaaa", 0)], 0),
        # A short run before, and the first batches lost.
        ([("aaaaaaaa", 0)], 3, [("aaaaaaaa", 0)], 3),
        # The end of the run before.
        ([("aaaaaaaa", 7)], 0, [("aaaaaaaa", 9)], 2),
        ([("aaaaaaaa", 7), ("bbbbbbbb", 4)], 1, [("aaaaaaaa", 9), ("bbbbbbbb", 4)], 3),
        # Nearby batches cannot tell whether a distant run is stored.
        ([("aaaaaaaa", 7)], 0, [("dddddddd", 9)], 0),
        ([("cccccccc", 1)], 2, [("aaaaaaaa", 9)], 0),
    ],
)
def test_a_run_that_names_the_runs_before_it_tells_their_missing_batches(near, seq, previous, missing):
    ids = [BatchId(T0 + i, *each) for i, each in enumerate(near)]
    ends = [RunEnd(*each) for each in previous]
    assert missing_before(BatchId(T0 + 9, "cccccccc", seq), ids, ends) == missing


def test_the_end_of_a_run_that_continues_later_is_not_missing():
    """A recording is played twice: only part of the first run lies near the second run's first batch."""
    first = [BatchId(T0 + i * S, "aaaaaaaa", i) for i in range(5)]
    again = BatchId(T0 + S, "bbbbbbbb", 0)
    assert missing_before(again, sorted([*first, again]), [RunEnd("aaaaaaaa", 90)]) == 0


@given(st.permutations(range(12)), st.sets(st.integers(0, 11), max_size=11))
def test_each_missing_number_is_reported_once_with_any_clocks(order, lost):
    """Numbers of one run with times of several clocks: all missing numbers are found but those at the end."""
    ids = sorted(BatchId(T0 + at * S, "aaaaaaaa", seq) for at, seq in enumerate(order) if seq not in lost)
    told = sum(missing_before(own, ids) for own in ids)
    assert told == max(own.seq for own in ids) + 1 - len(ids)


@pytest.mark.parametrize("boots", [("aaaaaaaa", "bbbbbbbb"), ("bbbbbbbb", "aaaaaaaa")])
@pytest.mark.parametrize("shift_us", [0, 1, 400_000, -400_000])
def test_a_run_that_overlaps_another_in_time_misses_nothing(boots, shift_us):
    """A recording is played twice with its own times; the second run's numbers continue the first's."""
    first = [BatchId(T0 + i * S, boots[0], i) for i in range(10)]
    second = [BatchId(T0 + i * S + shift_us, boots[1], 10 + i) for i in range(10)]
    ids = sorted([*first, *second])
    assert [missing_before(own, ids) for own in ids] == [
        # Before the first batch, only its number is known.
        own.seq if own == ids[0] else 0
        for own in ids
    ]
    without = [own for own in ids if own != second[4]]
    assert {own.seq: missing_before(own, without) for own in second[5:6]} == {15: 1}


@pytest.mark.parametrize(
    ("steps", "holes"),
    [
        ([], 0),
        ([20, 20], 0),
        ([20, 2000], 0),
        ([20, 20, 20], 0),
        ([20, 60, 20], 0),
        ([20, 61, 20], 1),
        ([20, 20, 500, 20, 20, 90], 2),
        ([20, 50, 20, 5, 35], 0),
    ],
)
def test_a_step_over_three_times_the_usual_one_is_a_hole(steps, holes):
    times = [T0]
    for step in steps:
        times.append(times[-1] + step)
    assert count_holes(times) == holes


def test_a_hole_between_two_batches_counts_in_the_later_second():
    before = batch(every(20_000, 40, T0 - S), seq=0)
    after = batch(every(20_000, 50), seq=1)
    assert summarized(SECOND, [before, after], None)["gaps"] == 1
    assert summarized(SECOND, [after], None)["gaps"] == 0
