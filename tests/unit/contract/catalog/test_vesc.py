"""The table of the VESC's fields and faults."""

from __future__ import annotations

import pytest

from iort_contract.catalog.vesc import FAULT_CODES, FAULTS, VESC_FIELDS, absent
from iort_contract.messages.batch import Batch, encode_batch
from tests.unit.contract.contract_values import BOOT

# The messages of the drivers, in their order.
ROS1 = [
    "voltage_input",
    "temperature_pcb",
    "current_motor",
    "current_input",
    "speed",
    "duty_cycle",
    "charge_drawn",
    "charge_regen",
    "energy_drawn",
    "energy_regen",
    "displacement",
    "distance_traveled",
    "fault_code",
]
ROS2 = [
    "temp_fet",
    "temp_motor",
    "current_motor",
    "current_input",
    "avg_id",
    "avg_iq",
    "duty_cycle",
    "speed",
    "voltage_input",
    "charge_drawn",
    "charge_regen",
    "energy_drawn",
    "energy_regen",
    "displacement",
    "distance_traveled",
    "fault_code",
    "pid_pos_now",
    "controller_id",
    "ntc_temp_mos1",
    "ntc_temp_mos2",
    "ntc_temp_mos3",
    "avg_vd",
    "avg_vq",
]
UNITS = {"V", "A", "degC", "1", "erpm", "1e-4 Ah", "1e-4 Wh", "counts", "enum", "deg", "id"}


@pytest.mark.parametrize(("version", "expected"), [(1, ROS1), (2, ROS2)])
def test_the_fields_are_those_of_the_message(version, expected):
    assert {name for name, field in VESC_FIELDS.items() if version in field.ros} == set(expected)


def test_ros1_message_has_13_fields():
    assert len(ROS1) == len(set(ROS1)) == 13


@pytest.mark.parametrize("field", VESC_FIELDS.values(), ids=lambda field: field.name)
def test_every_field_is_complete_in_the_table(field):
    assert VESC_FIELDS[field.name] is field
    assert encode_batch(Batch(BOOT, 0, [0], {field.name: [0]}))
    assert field.unit in UNITS
    assert field.meaning.strip() == field.meaning != ""
    assert set(field.ros) <= {1, 2}
    assert (field.ros2_unit in {"Ah", "Wh"}) == field.unit.startswith("1e-4")
    assert field.ros


def test_the_faults_are_the_firmwares_complete_list():
    assert list(FAULTS) == list(range(34))
    assert FAULT_CODES["OVER_TEMP_FET"] == FAULT_CODES["OVER_TEMP_MOTOR"] - 1 == 5
    assert FAULT_CODES["ABS_OVERSPEED"] == 33
    assert len(set(FAULTS.values())) == 34
    assert set(FAULT_CODES.values()) == FAULTS.keys()


@pytest.mark.parametrize(
    ("field", "value", "expected"),
    [
        ("temp_motor", -273.15, True),
        ("temp_motor", -50, True),
        ("temp_motor", -49.9, False),
        ("temp_motor", 0, False),
        ("temp_motor", None, False),
        ("temp_motor", False, False),
        ("temp_motor", "-273", False),
        ("temp_motor", float("nan"), False),
        ("temperature_pcb", -60.0, True),
        ("ntc_temp_mos3", -60.0, True),
        ("current_motor", -60.0, False),
        ("temperature_outside", -60.0, False),
    ],
)
def test_a_sensor_that_is_not_fitted_gives_no_temperature(field, value, expected):
    assert absent(field, value) is expected
