"""The fields of the VESC and of the agent itself, with their units."""

from __future__ import annotations

from typing import NamedTuple

from iort_contract.limits import Value

# A thermistor that is not fitted reads colder than this, down to absolute zero.
NO_SENSOR_DEGC = -50.0


_NUMBERS = (int, float)


class Field(NamedTuple):
    """One field of VescStateStamped: unit, meaning and the drivers that report it. ``ros2_unit`` is the ROS 2
    driver's unit if it differs."""

    name: str
    unit: str
    meaning: str
    ros: tuple[int, ...]
    ros2_unit: str | None = None


# Sources: vesc_msgs/VescState.msg of the ROS 1 and the ROS 2 driver, and COMM_GET_VALUES of the firmware.
# Charge and energy are in the unit that the ROS 1 driver really sends, despite its comments: the raw integer
# of 1e-4 Ah and Wh. The ROS 2 driver divides by 1e4 first. Nothing on the way to the tables converts either,
# so fractional values come from the ROS 2 driver.
VESC_STREAM = "vesc"
# The fields behind alert mails.
FAULT_FIELD, VOLTAGE_FIELD = "fault_code", "voltage_input"
VESC_FIELDS: dict[str, Field] = {
    f.name: f
    for f in (
        Field(VOLTAGE_FIELD, "V", "battery voltage at the controller", (1, 2)),
        Field("temperature_pcb", "degC", "temperature of the controller's board", (1,)),
        Field("temp_fet", "degC", "temperature of the MOSFETs (driver may leave 0)", (2,)),
        Field("temp_motor", "degC", "temperature of the motor (driver may leave 0)", (2,)),
        Field("current_motor", "A", "motor current, negative while braking", (1, 2)),
        Field("current_input", "A", "battery current, negative while regenerating", (1, 2)),
        Field("avg_id", "A", "direct-axis current", (2,)),
        Field("avg_iq", "A", "quadrature-axis current", (2,)),
        Field("speed", "erpm", "electrical speed of the motor, revolutions per minute", (1, 2)),
        Field("duty_cycle", "1", "share of the battery voltage on the motor, -1 to 1", (1, 2)),
        Field("charge_drawn", "1e-4 Ah", "charge drawn since power-on", (1, 2), "Ah"),
        Field("charge_regen", "1e-4 Ah", "charge recovered since power-on", (1, 2), "Ah"),
        Field("energy_drawn", "1e-4 Wh", "energy drawn since power-on", (1, 2), "Wh"),
        Field("energy_regen", "1e-4 Wh", "energy recovered since power-on", (1, 2), "Wh"),
        Field("displacement", "counts", "tachometer, net", (1, 2)),
        Field("distance_traveled", "counts", "tachometer, absolute", (1, 2)),
        Field(FAULT_FIELD, "enum", "0 none, otherwise see FAULTS", (1, 2)),
        Field("pid_pos_now", "deg", "rotor position of the position controller", (2,)),
        Field("controller_id", "id", "CAN id of the controller", (2,)),
        Field("ntc_temp_mos1", "degC", "temperature of MOSFET 1", (2,)),
        Field("ntc_temp_mos2", "degC", "temperature of MOSFET 2", (2,)),
        Field("ntc_temp_mos3", "degC", "temperature of MOSFET 3", (2,)),
        Field("avg_vd", "V", "direct-axis voltage", (2,)),
        Field("avg_vq", "V", "quadrature-axis voltage", (2,)),
    )
}
# Field -> the value at and below which its sensor is not fitted; for whole columns.
ABSENT_FROM = {f.name: NO_SENSOR_DEGC for f in VESC_FIELDS.values() if f.unit == "degC"}


def absent(field: str, value: Value) -> bool:
    """Whether a value means that its sensor is not fitted.

    Such values are recorded and exported unchanged. Everything that calculates with them or shows them uses
    null instead: the summary, queries, plots, live updates and the health metrics.
    """
    limit = ABSENT_FROM.get(field)
    return limit is not None and type(value) in _NUMBERS and value <= limit  # type: ignore[operator]  # a number


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
# The agent's own figures. Counts grow from 0 at its start. The clock offset converts the car's clock to the
# cloud's by addition; it is null before the first pong.
AGENT_FIELDS = {
    "cpu_percent": "% of one core, since the sample before",
    "rss_mb": "MB of memory in use",
    "samples_per_s": "samples/s from all sources, since the sample before",
    "backlog_batches": "batches in the spool",
    "backlog_bytes": "bytes in the spool",
    "dropped_batches": "batches dropped because the spool was full",
    "connects": "connections made",
    "clock_offset_ms": "ms, cloud minus car",
    "clock_uncertainty_ms": "ms, either way",
    "files_waiting": "files waiting to be uploaded",
    "files_sent_bytes": "bytes of files sent",
}
# Derived in the summary from the vehicle's parameters (robots table) and the fields above.
DERIVED_UNITS = {"speed_mps": "m/s", "power_w": "W"}
