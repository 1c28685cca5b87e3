"""The message of the bench, VescStateStamped of the ROS 1 driver, as text and as bytes."""

from __future__ import annotations

import struct

TYPE = "vesc_msgs/VescStateStamped"
FIELDS = (
    "voltage_input temperature_pcb current_motor current_input speed duty_cycle charge_drawn charge_regen "
    "energy_drawn energy_regen displacement distance_traveled"
).split()
STATE = "\n".join([*(f"float64 {name}" for name in FIELDS), "int32 fault_code"])
# The firmware sends integers; the driver divides these fields by the number, and the others by 1.
_PARTS = {
    "voltage_input": 10,
    "temperature_pcb": 10,
    "current_motor": 100,
    "current_input": 100,
    "duty_cycle": 1000,
}


def values(i: int) -> list[float]:
    """Return the fields of the i-th message with a VESC's digits; the speed is ``i``."""
    return [float(i) if name == "speed" else (115 + i % 97) / _PARTS.get(name, 1) for name in FIELDS]


def body(i: int) -> bytes:
    """Return the i-th message as ROS 1 serializes it, from the frame_id on."""
    return struct.pack(f"<I9s{len(FIELDS)}di", 9, b"base_link", *values(i), 0)
