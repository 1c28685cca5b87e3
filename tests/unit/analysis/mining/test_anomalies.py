"""Each fault of the simulated car moves what is measured of it, and nothing else."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bench.proof.fleet import drive_of, simulated
from iort_agent.sources.sim.faults import FaultConfig
from iort_analysis.drives.building import build
from iort_analysis.drives.drive import Drive
from iort_analysis.mining import anomalies
from iort_analysis.results import Mined
from iort_analysis.samples.blocks import Block
from iort_contract.catalog.analysis import KINDS, PARAMETERS
from tests.unit.analysis.simulated import HZ, KEY, START_US, changed, streams

_CAR = 300  # apart from the cars of the proof
HEALTHY = FaultConfig("payload", 1e-9)


@cache
def driven(fault: FaultConfig = HEALTHY) -> tuple[Drive, dict[str, float]]:
    spec = drive_of(_CAR, 0, [fault], seconds=250.0)
    made = simulated(spec, None)
    return build(spec.key, made.streams), made.truth


@cache
def mined(fault: FaultConfig = HEALTHY) -> Mined:
    return anomalies.mine(driven(fault)[0])


@pytest.mark.parametrize(
    ("kind", "field", "moved"),
    [
        ("added_friction", "voltage_input", {"rolling_current_a"}),
        ("dragging_brake", "voltage_input", {"brake_drag_a"}),
        ("payload", "voltage_input", {"inertia_a_per_krpm_s", "rolling_current_a"}),
        ("flat_tyre", "voltage_input", {"rolling_current_a"}),
        ("cooling_lost", "voltage_input", {"controller_lag_s"}),
        ("sensor_drift", "voltage_input", {"voltage_drift_v"}),
        ("sensor_drift", "temperature_pcb", {"temperature_drift_k"}),
        ("worn_battery", "voltage_input", set()),
        ("motor_resistance", "voltage_input", set()),
    ],
)
def test_a_fault_moves_what_belongs_to_it(kind: str, field: str, moved: set[str]) -> None:
    usual, found = mined(), mined(FaultConfig(kind, "strong", field=field))
    assert not usual.events
    assert not found.events
    worse = set()
    for name, estimate in found.estimates.items():
        before, parameter = usual.estimates[name].value, PARAMETERS[name]
        change = estimate.value - before
        wanted = {"up": change, "down": -change, "either": abs(change)}[parameter.worse]
        if wanted > parameter.least_change(before):
            worse.add(name)
    assert worse == moved
    assert found.estimates.keys() == usual.estimates.keys()


def test_a_loose_pinion_slips_under_torque() -> None:
    found = mined(FaultConfig("loose_pinion", "strong")).estimates["slip_under_torque"]
    assert found.low > mined().estimates["slip_under_torque"].high + 0.015


def test_a_current_that_drifts_is_told_from_the_voltage() -> None:
    found = mined(FaultConfig("sensor_drift", "strong", field="current_motor")).estimates
    # 4 A in ten minutes, over a good four.
    assert found["motor_current_drift_a"].value == pytest.approx(4 * 250 / 600, rel=0.1)
    assert abs(found["voltage_drift_v"].value) < 0.1


@pytest.mark.parametrize(
    ("fault", "kind", "fields"),
    [
        (FaultConfig("cell_dropout", "middle"), "cell_dropout", ("voltage_input", "current_input")),
        (FaultConfig("intermittent_can", "middle"), "can_intermittent", ()),
        (FaultConfig("sensor_stuck", "middle", 100.0, "current_motor"), "sensor_stuck", ("current_motor",)),
    ],
)
def test_a_fault_that_comes_and_goes_is_an_event(
    fault: FaultConfig, kind: str, fields: tuple[str, ...]
) -> None:
    (event,) = mined(fault).events
    drive = driven(fault)[0]
    assert (event.kind, event.stream, event.fields) == (kind, "vesc", fields)
    assert event.kind in KINDS
    assert drive.key.start_us <= event.start_us < event.end_us <= drive.end_us
    if kind == "sensor_stuck":
        assert (event.start_us - drive.key.start_us) / 1e6 == pytest.approx(100, abs=0.1)
        assert "the value of current_motor stayed the same for 15 s" in event.text
        assert event.effect.low <= 15 <= event.effect.high < 15.1
    elif kind == "cell_dropout":
        assert event.effect.value == pytest.approx(0.8, abs=0.05)


def test_the_estimates_are_those_of_the_simulators_physics() -> None:
    found, truth = mined().estimates, driven()[1]
    newtons_per_amp = truth["newtons_per_amp"] * truth["drivetrain_efficiency"]
    krpm = truth["speed_to_erpm_gain"] / 1000
    moved_kg = truth["mass_kg"] + truth["rotating_mass_kg"]
    rolling_n = truth["rolling_resistance"] * truth["mass_kg"] * 9.81 + truth["drivetrain_friction_n"]
    # The tyres' slip is in the motor's speed, two percent of it.
    assert found["inertia_a_per_krpm_s"].value == pytest.approx(moved_kg / newtons_per_amp / krpm, rel=0.03)
    assert found["rolling_current_a"].value == pytest.approx(rolling_n / newtons_per_amp, rel=0.08)


def test_the_cars_own_numbers_need_not_be_known() -> None:
    drive = driven()[0]
    assert drive.vehicle is None
    assert not mined().missing


def _standing(column: np.ndarray, *stretches: tuple[int, int]) -> np.ndarray:
    """The column with the value at the beginning of each stretch of seconds all along it."""
    made = column.copy()
    for first_s, last_s in stretches:
        made[first_s * HZ : last_s * HZ] = made[first_s * HZ]
    return made


def test_what_is_no_sensor_may_stand_still() -> None:
    """The controller sets the duty cycle; a board that coasts draws no charge; a receiver is as sure as it
    was; and a servo is told the same angle."""
    vesc, chance = streams(120)["vesc"], np.random.default_rng(1)
    n = len(vesc.times_us)
    grown = np.cumsum(chance.uniform(0, 1e-4, n))
    others = {
        "duty_cycle": _standing(vesc.columns["duty_cycle"], (20, 29)),
        "amp_hours_setup": _standing(grown, (30, 45), (60, 70)),
        "watt_hours_setup": _standing(-40 * grown, (32, 47), (60, 75)),
        "gnss_vAcc": _standing(chance.normal(3, 0.1, n), (30, 60), (70, 90)),
        "position_covariance.0": _standing(chance.normal(3, 0.1, n), (30, 60)),
    }
    angle = chance.normal(0.5, 0.1, n)
    for first in range(0, n, 20 * HZ):
        angle[first : first + 8 * HZ] = 0.5304
    made = {
        **streams(120),
        "vesc": Block(vesc.times_us, {**vesc.columns, **others}),
        "servo": Block(vesc.times_us, {"data": angle}),
    }

    drive = build(KEY, made)

    assert drive.repairs == []
    assert not anomalies.mine(drive).events


def test_a_field_that_stands_twice_is_named_once() -> None:
    vesc, chance = streams(120)["vesc"], np.random.default_rng(1)
    noise = {name: chance.normal(0, 1, len(vesc.times_us)) for name in ("accX", "accY")}
    columns = {
        "accX": _standing(noise["accX"], (10, 50)),
        "accY": _standing(noise["accY"], (12, 25), (30, 45)),
    }

    (event,) = anomalies.mine(build(KEY, {"vesc": vesc, "imu": Block(vesc.times_us, columns)})).events

    assert (event.kind, event.stream, event.fields) == ("sensor_stuck", "imu", ("accX", "accY"))
    assert event.text.startswith("the value of accX and accY stayed the same for 40 s")


def test_samples_that_come_again_are_an_intermittent_link() -> None:
    made = dict(streams(120))
    times, columns = made["vesc"]
    place = np.arange(len(times))
    # Every five seconds the link repeats the last sample for a fifth of a second.
    place = np.where(place % 250 < 10, place - place % 250, place)
    made["vesc"] = Block(times, {name: column[place] for name, column in columns.items()})
    (event,) = anomalies.mine(build(KEY, made)).events
    assert event.kind == "can_intermittent"
    assert event.effect.value == pytest.approx(0.035, abs=0.01)


def test_a_recording_that_is_replayed_quickly_has_no_intermittent_link() -> None:
    """Its samples have the times of the replay, of which a few wait for a tenth of a millisecond."""
    made = dict(streams(120))
    times, columns = made["vesc"]
    steps_us = np.where(np.arange(len(times)) % 40 == 0, 100, 10)
    made["vesc"] = Block(times[0] + np.cumsum(steps_us), columns)
    assert not anomalies.mine(build(KEY, made)).events


def test_a_reported_fault_is_an_event_by_its_name() -> None:
    made = changed("fault_code", slice(1000, 1010), 2.0)
    made["vesc"].columns["fault_code"][2000] = 2.0
    (event,) = anomalies.mine(build(KEY, made)).events
    assert (event.kind, event.text) == ("fault_reported", "fault 2, under voltage: reported 2 times")
    assert (event.start_us, event.end_us) == (START_US + 20_000_000, START_US + 20_180_000)


def test_a_computer_that_pauses_is_no_intermittent_link() -> None:
    made = {}
    for name, block in streams(120).items():
        since = (block.times_us - START_US) % 5_000_000
        made[name] = block.take(since > 300_000)
    assert anomalies.mine(build(KEY, made)).events == []


@settings(max_examples=25, deadline=None)
@given(
    field=st.sampled_from(["speed", "current_motor", "voltage_input", "duty_cycle", "current_input"]),
    first=st.integers(0, 6000),
    length=st.integers(1, 6000),
    value=st.sampled_from([np.nan, 0.0, -1.0, 12.0, 1e9]),
)
def test_any_stretch_of_any_value_gives_a_result(field: str, first: int, length: int, value: float) -> None:
    drive = build(KEY, changed(field, slice(first, first + length), value))
    with np.errstate(all="ignore"):
        found = anomalies.mine(drive)
    for estimate in found.estimates.values():
        assert estimate.low <= estimate.value <= estimate.high


@pytest.mark.parametrize("samples", [0, 1, 2, 10])
def test_a_short_drive_says_so(samples: int) -> None:
    short = {name: block.take(slice(samples)) for name, block in streams(120).items()}
    found = anomalies.mine(build(KEY, short))
    assert not found.estimates
    assert not found.events
    assert "the drive must last 60 s" in found.missing["anomalies"]
