"""The VESC: its fields, its faults, and which of its sensors are fitted."""

from __future__ import annotations

from functools import partial
from typing import Mapping

from iort_contract.catalog.entries import Field, Stream
from iort_contract.limits import Value

# A thermistor that is not fitted reads colder than this, down to absolute zero.
NO_SENSOR_DEGC = -50.0
_NUMBERS = (int, float)

# Sources: vesc_msgs/VescState.msg of the ROS 1 and the ROS 2 driver, and COMM_GET_VALUES of the firmware.
# Charge and energy are in the unit that the ROS 1 driver really sends, despite its comments: the raw integer
# of 1e-4 Ah and Wh. The ROS 2 driver divides by 1e4 first. Nothing on the way to the tables converts either,
# so fractional values come from the ROS 2 driver.
VESC_STREAM = "vesc"
# The counts of the tachometer in an electrical revolution of the motor.
TACHOMETER_COUNTS = 6
# The fields behind alert mails.
FAULT_FIELD, VOLTAGE_FIELD = "fault_code", "voltage_input"
# Of the drivers of ROS 1 and ROS 2, or of ROS 2 alone.
_both, _ros2 = partial(Field, ros=(1, 2)), partial(Field, ros=(2,))
VESC = Stream(
    VESC_STREAM,
    "the state of a VESC motor controller",
    (
        _both(VOLTAGE_FIELD, "V", "battery voltage at the controller", "battery", label="Battery voltage"),
        Field(
            "temperature_pcb",
            "degC",
            "temperature of the controller's board",
            "temperature",
            (1,),
            label="Board temperature",
        ),
        _ros2("temp_fet", "degC", "temperature of the MOSFETs (driver may leave 0)", "temperature"),
        _ros2("temp_motor", "degC", "temperature of the motor (driver may leave 0)", "temperature"),
        _both("current_motor", "A", "motor current, negative while braking", "motor", label="Motor current"),
        _both(
            "current_input",
            "A",
            "battery current, negative while regenerating",
            "battery",
            label="Battery current",
        ),
        _ros2("avg_id", "A", "direct-axis current", "motor"),
        _ros2("avg_iq", "A", "quadrature-axis current", "motor"),
        _both("speed", "erpm", "electrical speed of the motor, revolutions per minute", "motion"),
        _both("duty_cycle", "1", "share of the battery voltage on the motor, -1 to 1", "motor"),
        _both("charge_drawn", "1e-4 Ah", "charge drawn since power-on", "battery", ros2_unit="Ah"),
        _both("charge_regen", "1e-4 Ah", "charge recovered since power-on", "battery", ros2_unit="Ah"),
        _both("energy_drawn", "1e-4 Wh", "energy drawn since power-on", "battery", ros2_unit="Wh"),
        _both("energy_regen", "1e-4 Wh", "energy recovered since power-on", "battery", ros2_unit="Wh"),
        _both("displacement", "counts", "tachometer, net", "motion"),
        _both("distance_traveled", "counts", "tachometer, absolute", "motion"),
        _both(FAULT_FIELD, "enum", "0 none, otherwise see FAULTS", "state"),
        _ros2("pid_pos_now", "deg", "rotor position of the position controller", "motion"),
        _ros2("controller_id", "id", "CAN id of the controller", "state"),
        _ros2("ntc_temp_mos1", "degC", "temperature of MOSFET 1", "temperature"),
        _ros2("ntc_temp_mos2", "degC", "temperature of MOSFET 2", "temperature"),
        _ros2("ntc_temp_mos3", "degC", "temperature of MOSFET 3", "temperature"),
        _ros2("avg_vd", "V", "direct-axis voltage", "motor"),
        _ros2("avg_vq", "V", "quadrature-axis voltage", "motor"),
    ),
)
VESC_FIELDS = {field.name: field for field in VESC.fields}
# Field -> the value at and below which its sensor is not fitted; for whole columns.
ABSENT_FROM = {f.name: NO_SENSOR_DEGC for f in VESC_FIELDS.values() if f.unit == "degC"}
# What the controller's sensors measure. Its counters and codes may stand still for long, and so may the duty
# cycle, which it sets itself.
MEASURED = frozenset(f.name for f in VESC_FIELDS.values() if f.unit in {"V", "A", "degC", "erpm", "deg"})


def absent(field: str, value: Value) -> bool:
    """Whether a value means that its sensor is not fitted.

    Such values are recorded and exported unchanged. Everything that calculates with them or shows them uses
    null instead: the summary, queries, plots, live updates and the health metrics.
    """
    limit = ABSENT_FROM.get(field)
    return limit is not None and type(value) in _NUMBERS and value <= limit  # type: ignore[operator]  # a number


TEMPERATURES = tuple(name for name, field in VESC_FIELDS.items() if field.group == "temperature")


def measured_degc(field: str, value: Value) -> float | None:
    """A temperature; None from a sensor that is not fitted, or that the driver does not read: it sends 0."""
    if not isinstance(value, _NUMBERS) or isinstance(value, bool) or not value or absent(field, value):
        return None
    return float(value)


def hottest_degc(sample: Mapping[str, Value]) -> float | None:
    """The highest of a controller's temperatures: alarms, `iort watch` and the page show the same."""
    measured = (measured_degc(name, sample.get(name)) for name in TEMPERATURES)
    return max((value for value in measured if value is not None), default=None)


# Columns that VESC Tool writes into a log beside the fields above, where the unit is sure.
LOG_UNITS = {
    "gnss_lat": "deg",
    "gnss_lon": "deg",
    "gnss_alt": "m",
    "gnss_gVel": "m/s",
    "gnss_vVel": "m/s",
    "gnss_hAcc": "m",
    "gnss_vAcc": "m",
    "speed_meters_per_sec": "m/s",
    "tacho_meters": "m",
    "tacho_abs_meters": "m",
    "current_in_setup": "A",
    "current_motor_setup": "A",
    "battery_wh_tot": "Wh",
}

# The firmware's mc_fault_code, in order: the code is the index. Each has its own name, as in VESC Tool's
# logs, and its meaning.
_FAULTS = (
    ("NONE", "none"),
    ("OVER_VOLTAGE", "over voltage"),
    ("UNDER_VOLTAGE", "under voltage"),
    ("DRV", "gate driver (DRV8302)"),
    ("ABS_OVER_CURRENT", "absolute over-current"),
    ("OVER_TEMP_FET", "MOSFET over-temperature"),
    ("OVER_TEMP_MOTOR", "motor over-temperature"),
    ("GATE_DRIVER_OVER_VOLTAGE", "gate driver over voltage"),
    ("GATE_DRIVER_UNDER_VOLTAGE", "gate driver under voltage"),
    ("MCU_UNDER_VOLTAGE", "controller under voltage"),
    ("BOOTING_FROM_WATCHDOG_RESET", "booting from a watchdog reset"),
    ("ENCODER_SPI", "encoder SPI"),
    ("ENCODER_SINCOS_BELOW_MIN_AMPLITUDE", "sin/cos encoder below its minimum amplitude"),
    ("ENCODER_SINCOS_ABOVE_MAX_AMPLITUDE", "sin/cos encoder above its maximum amplitude"),
    ("FLASH_CORRUPTION", "flash corruption"),
    ("HIGH_OFFSET_CURRENT_SENSOR_1", "high offset of current sensor 1"),
    ("HIGH_OFFSET_CURRENT_SENSOR_2", "high offset of current sensor 2"),
    ("HIGH_OFFSET_CURRENT_SENSOR_3", "high offset of current sensor 3"),
    ("UNBALANCED_CURRENTS", "unbalanced currents"),
    ("BRK", "hardware brake input"),
    ("RESOLVER_LOT", "resolver, loss of tracking"),
    ("RESOLVER_DOS", "resolver, degradation of signal"),
    ("RESOLVER_LOS", "resolver, loss of signal"),
    ("FLASH_CORRUPTION_APP_CFG", "flash corruption, application configuration"),
    ("FLASH_CORRUPTION_MC_CFG", "flash corruption, motor configuration"),
    ("ENCODER_NO_MAGNET", "encoder without magnet"),
    ("ENCODER_MAGNET_TOO_STRONG", "encoder magnet too strong"),
    ("PHASE_FILTER", "phase filter"),
    ("ENCODER_FAULT", "encoder fault"),
    ("LV_OUTPUT_FAULT", "low-voltage output"),
    ("ENCODER_SLIP", "encoder slip"),
    ("OVERSPEED", "overspeed"),
    ("UNDERSPEED", "underspeed"),
    ("ABS_OVERSPEED", "absolute overspeed"),
)
FAULTS = {code: meaning for code, (_, meaning) in enumerate(_FAULTS)}
# Older firmware named the gate driver by its type.
FAULT_CODES = {**{name: code for code, (name, _) in enumerate(_FAULTS)}, "DRV8302": 3}
