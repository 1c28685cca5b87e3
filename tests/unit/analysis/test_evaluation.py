"""Findings are what differs from earlier drives, and not by chance."""

from __future__ import annotations

import random
from collections.abc import Iterable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iort_analysis.baselines import US_PER_DAY, baseline, combined, fleet_baseline
from iort_analysis.evaluation import evaluate
from iort_analysis.results import DriveResult, Event, Measured, Mined
from iort_contract.messages.analysis import DriveKey, Estimate, Finding

NAME = "battery_resistance_ohm"


def ohms(value: float, half: float = 0.001) -> Estimate:
    return Estimate(value, value - half, value + half, "ohm")


def key(day: int, robot: str = "car7") -> DriveKey:
    return DriveKey(robot, 1_700_000_000_000_000 + day * US_PER_DAY, "00c0ffee")


def drives(values: Iterable[float], robot: str = "car7") -> list[Measured]:
    return [Measured(key(day, robot), {NAME: ohms(value)}) for day, value in enumerate(values)]


def result(value: float, *events: Event, day: int = 100) -> DriveResult:
    drive = key(day)
    return DriveResult(
        drive, drive.start_us + 600_000_000, 30_000, {}, Mined({NAME: ohms(value)}, events=events)
    )


USUAL = [0.030, 0.031, 0.029, 0.0305, 0.0295]


def test_a_worn_battery_is_found_with_its_numbers() -> None:
    (finding,) = evaluate([result(0.045)], drives(USUAL), [])
    assert (finding.kind, finding.subject, finding.stream) == ("battery_worn", NAME, "vesc")
    assert finding.fields == ("voltage_input", "current_input")
    assert finding.effect.low < 0.015 < finding.effect.high
    assert finding.p <= finding.q < 0.01
    assert (
        "0.045 ohm (0.044 to 0.046), 50% above its own baseline of 0.03 ohm over 5 earlier drives"
        in finding.text
    )


@pytest.mark.parametrize("value", [0.0305, 0.034, 0.015])
def test_usual_weak_and_better_is_no_finding(value: float) -> None:
    assert evaluate([result(value)], drives(USUAL), []) == []


def test_an_uncertain_estimate_is_no_finding() -> None:
    drive = result(0.045)
    wide = DriveResult(drive.drive, drive.end_us, 9, {}, Mined({NAME: ohms(0.045, 0.02)}))
    assert evaluate([wide], drives(USUAL), []) == []


def test_a_robot_without_history_is_compared_with_the_fleet() -> None:
    fleet = [drive for i in range(5) for drive in drives(USUAL, f"car{i}")]
    (finding,) = evaluate([result(0.09)], drives(USUAL[:2]), fleet)
    assert "the fleet's baseline of 0.03 ohm over 5 other robots" in finding.text
    assert evaluate([result(0.09)], drives(USUAL[:2]), fleet[:10]) == []


def test_later_drives_and_the_drive_itself_are_no_baseline() -> None:
    assert evaluate([result(0.045, day=1)], drives(USUAL), []) == []
    again = [*drives(USUAL), Measured(key(100), {NAME: ohms(0.045)})]
    assert len(evaluate([result(0.045)], again, [])) == 1


def test_a_bad_night_does_not_become_its_own_baseline() -> None:
    night = [result(0.045, day=100 + i) for i in range(20)]
    assert len(evaluate(night, drives(USUAL), [])) == 20


def test_sag_that_grows_over_weeks_is_found() -> None:
    chance = random.Random(3)
    slow = [0.030 + 0.0003 * day + chance.gauss(0, 0.0007) for day in range(30)]
    (finding,) = evaluate([result(slow[-1], day=30)], drives(slow), [])
    assert finding.subject == f"{NAME}_trend"
    assert "rose by 0.00" in finding.text


def test_an_event_counts_by_its_chance_or_by_its_miner() -> None:
    at = key(100).start_us
    likely, unlikely, judged = (
        Event("analysis_failed", at + i, at + i, "vesc", (), "text", p=p)
        for i, p in enumerate((0.2, 1e-6, None))
    )
    found = evaluate([result(0.03, likely, unlikely, judged)], drives(USUAL), [])
    assert [finding.from_us - at for finding in found] == [1, 2]


def test_a_findings_numbers_have_the_digits_that_their_interval_deserves() -> None:
    effects = [Estimate(5.63999, 5.63999, 5.720001, "s"), Estimate(3.0, 3.0, 3.0, "1"), None]
    at = key(100).start_us
    events = [Event("analysis_failed", at + i, at, "", (), "text", one) for i, one in enumerate(effects)]

    found = evaluate([result(0.03, *events)], [], [])

    assert [finding.effect for finding in found] == [Estimate(5.64, 5.64, 5.72, "s"), effects[1], None]


def test_one_cause_is_one_finding() -> None:
    usual = {"speed_to_erpm_gain": 4614.0, "rolling_current_a": 4.0, "voltage_drift_v": 0.0}
    units = {"speed_to_erpm_gain": "erpm per m/s", "rolling_current_a": "A", "voltage_drift_v": "V"}

    def estimates(**changes: float) -> dict[str, Estimate]:
        return {
            name: Estimate(value, value - 0.01, value + 0.01, units[name])
            for name, value in {**usual, **changes}.items()
        }

    history = [Measured(key(day), estimates()) for day in range(5)]

    def found(**changes: float) -> list[Finding]:
        drive = key(100)
        one = DriveResult(drive, drive.start_us + 600_000_000, 9, {}, Mined(estimates(**changes)))
        return evaluate([one], history, [])

    (friction,) = found(rolling_current_a=6.0)
    assert friction.kind == "friction_added"
    assert "The data cannot tell this from a softer ground" in friction.text
    # A flat tyre rolls worse, too.
    (tyre,) = found(rolling_current_a=6.0, speed_to_erpm_gain=4850.0)
    assert tyre.kind == "tyre_flat"
    assert "This goes with it: motor current that rolling takes" in tyre.text
    # A sensor that drifts is no flat tyre.
    assert [one.kind for one in found(voltage_drift_v=-0.4, speed_to_erpm_gain=4850.0)] == [
        "sensor_drift",
        "tyre_flat",
    ]


def test_a_parameter_that_nobody_knows_is_passed_over() -> None:
    drive = result(0.03)
    newer = Mined({**drive.mined.estimates, "of_another_version": ohms(1.0)})
    assert evaluate([DriveResult(drive.drive, drive.end_us, 9, {}, newer)], drives(USUAL), []) == []


@given(st.randoms(use_true_random=False))
def test_the_order_of_the_arguments_is_nothing(chance: random.Random) -> None:
    results, history = [result(0.045), result(0.05, day=101)], drives(USUAL)
    fleet = [drive for i in range(3) for drive in drives(USUAL, f"car{i}")]
    expected = evaluate(results, history, fleet)
    for order in (results, history, fleet):
        chance.shuffle(order)
    assert evaluate(results, history, fleet) == expected


def test_healthy_drives_give_next_to_no_finding() -> None:
    chance = random.Random(4)
    found = 0
    for _ in range(300):
        values = [chance.gauss(0.03, 0.0015) for _ in range(6)]
        found += len(evaluate([result(values[5])], drives(values[:5]), []))
    assert found == 0


def test_the_interval_of_a_baseline_holds_the_next_drive_as_often_as_it_says() -> None:
    chance = random.Random(5)
    held = 0
    for _ in range(500):
        values = [chance.gauss(1.0, 0.1) for _ in range(6)]
        expected = baseline([Estimate(v, v - 0.01, v + 0.01, "1") for v in values[:5]], 0.1)
        _, low, high, _ = expected.interval("1")
        held += low <= values[5] <= high
    assert 0.86 < held / 500 < 0.94


@given(st.floats(1e-3, 1e3), st.floats(-10, 10))
def test_a_baseline_follows_scale_and_shift(scale: float, shift: float) -> None:
    values = [1.0, 1.1, 0.9, 1.05, 3.0]
    one = baseline([Estimate(v, v - 0.1, v + 0.1, "1") for v in values], 0.1)
    moved = [scale * (v + shift) for v in values]
    other = baseline([Estimate(v, v - scale / 10, v + scale / 10, "1") for v in moved], scale / 10)
    assert other.value == pytest.approx(scale * (one.value + shift), abs=1e-9 * scale)
    assert other.spread == pytest.approx(scale * one.spread)


def test_one_bad_drive_moves_the_baseline_little() -> None:
    estimates = [ohms(value) for value in [*USUAL, 0.3]]
    assert baseline(estimates, 0.002).value == pytest.approx(0.03, rel=0.1)


def test_one_drive_that_is_far_surer_than_the_others_is_no_division_by_zero() -> None:
    sure, unsure = Estimate(0.03, 0.03, 0.03, "ohm"), Estimate(0.04, -1e6, 1e6, "ohm")

    assert 0.03 <= baseline([sure, unsure, unsure], 0.001).value <= 0.04
    assert combined([sure, unsure, unsure]).value == pytest.approx(0.03)


def test_robots_that_differ_widen_the_fleets_baseline() -> None:
    alike = fleet_baseline([[ohms(0.03)] * 3] * 4, 0.001)
    different = fleet_baseline([[ohms(value)] * 3 for value in (0.02, 0.03, 0.04, 0.05)], 0.001)
    assert different.spread > 3 * alike.spread
