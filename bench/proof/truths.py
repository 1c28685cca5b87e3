"""The truth behind each parameter of the catalogue, from the simulator's parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping

Truth = Callable[[Mapping[str, float]], float]


def _same(name: str) -> Truth:
    return lambda truth: truth[name]


# By the names of `iort_contract.catalog.findings.PARAMETERS`.
TRUTHS: dict[str, Truth] = {
    "battery_resistance_ohm": _same("battery_resistance_ohm"),
}
