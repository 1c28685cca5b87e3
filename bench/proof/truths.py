"""The truth behind each parameter of the catalogue, from the simulator's parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from iort_agent.sources.sim.parameters import AIR_KG_PER_M3, G_MPS2

Truth = Callable[[Mapping[str, float]], float]


def _same(name: str) -> Truth:
    return lambda truth: truth[name]


def _nothing(_truth: Mapping[str, float]) -> float:
    return 0.0


def _moved_kg(truth: Mapping[str, float]) -> float:
    return truth["mass_kg"] + truth["rotating_mass_kg"]


def _friction_n(truth: Mapping[str, float]) -> float:
    return truth["drivetrain_friction_n"] + truth["rolling_resistance"] * truth["mass_kg"] * G_MPS2


# By the names of `iort_contract.catalog.findings.PARAMETERS`; of a healthy car.
TRUTHS: dict[str, Truth] = {
    "battery_resistance_ohm": _same("battery_resistance_ohm"),
    "battery_slow_resistance_ohm": _same("battery_slow_resistance_ohm"),
    "battery_open_voltage_v": _same("open_voltage_v"),
    "battery_voltage_per_ah": _same("voltage_per_ah"),
    "motor_resistance_25_ohm": lambda truth: truth["motor_resistance_ohm"] + truth["fet_resistance_ohm"],
    "motor_resistance_ohm": _same("motor_resistance_now_ohm"),
    "motor_flux_linkage_wb": _same("flux_linkage_wb"),
    "motor_inductance_h": _same("motor_inductance_h"),
    "motor_torque_nm_per_a": lambda truth: 1.5 * truth["pole_pairs"] * truth["flux_linkage_wb"],
    "speed_to_erpm_gain": _same("driven_erpm_per_mps"),
    # By the tyres' effective radius, which their creep is part of.
    "motor_force_n_per_a": lambda truth: (
        truth["newtons_per_amp"] * truth["driven_erpm_per_mps"] / truth["speed_to_erpm_gain"]
    ),
    "effective_mass_kg": _moved_kg,
    "rotating_mass_kg": _same("rotating_mass_kg"),
    "friction_n": _friction_n,
    "drag_n_s2_per_m2": lambda truth: 0.5 * AIR_KG_PER_M3 * truth["drag_area_m2"],
    "drivetrain_efficiency": _same("drivetrain_efficiency"),
    "brake_drag_n": _nothing,
    "acceleration_per_a_mps2": lambda truth: truth["newtons_per_amp"] / _moved_kg(truth),
    "friction_per_mass_mps2": lambda truth: _friction_n(truth) / _moved_kg(truth),
    "inertia_a_per_krpm_s": lambda truth: (
        1000
        / truth["speed_to_erpm_gain"]
        * _moved_kg(truth)
        / truth["newtons_per_amp"]
        / truth["drivetrain_efficiency"]
    ),
    "rolling_current_a": lambda truth: (
        _friction_n(truth) / truth["newtons_per_amp"] / truth["drivetrain_efficiency"]
    ),
    "brake_drag_a": _nothing,
    "erpm_per_mps": _same("speed_to_erpm_gain"),
    "voltage_drift_v": _nothing,
    "motor_current_drift_a": _nothing,
    "temperature_drift_k": _nothing,
}
