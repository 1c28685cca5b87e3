"""The truth behind each parameter of the catalogue, from the simulator's parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping

Truth = Callable[[Mapping[str, float]], float]


def _same(name: str) -> Truth:
    return lambda truth: truth[name]


# By the names of `iort_contract.catalog.findings.PARAMETERS`.
TRUTHS: dict[str, Truth] = {
    "battery_resistance_ohm": _same("battery_resistance_ohm"),
    "battery_slow_resistance_ohm": _same("battery_slow_resistance_ohm"),
    "battery_open_voltage_v": _same("open_voltage_v"),
    "battery_voltage_per_ah": _same("voltage_per_ah"),
}
