"""The truth behind each parameter of the catalogue, from the simulator's parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from iort_agent.sources.sim.vehicle import AIR_KG_PER_M3, G_MPS2, WIND_MPS

# Estimates that are only compared with the car's own earlier drives, in a VESC's units: their interval says
# how well a drive repeats, and a bias that all drives share changes no finding.
INDICATORS = frozenset(
    {
        "inertia_a_per_krpm_s",
        "rolling_current_a",
        "brake_drag_a",
        "voltage_drift_v",
        "motor_current_drift_a",
        "temperature_drift_k",
    }
)
# Estimates whose interval spans what nobody tells: the make and the age of a battery's cells. The simulated
# cars have one make, so they must hold more often than nine times in ten.
SPANNING = frozenset({"battery_drawn_share", "battery_charge_left", "battery_range_left_km"})
Truth = Callable[[Mapping[str, float]], float]


def _same(name: str) -> Truth:
    return lambda truth: truth[name]


def _nothing(_truth: Mapping[str, float]) -> float:
    return 0.0


def _drawn(truth: Mapping[str, float]) -> float:
    return truth["charge"] - truth["charge_left"]


def _moved_kg(truth: Mapping[str, float]) -> float:
    return truth["mass_kg"] + truth["rotating_mass_kg"]


def _friction_n(truth: Mapping[str, float]) -> float:
    return truth["drivetrain_friction_n"] + truth["rolling_resistance"] * truth["mass_kg"] * G_MPS2


def _motor_w_per_k(truth: Mapping[str, float]) -> float:
    return truth["motor_cooling_w_per_k"] * _wind(truth) + truth["motor_to_board_w_per_k"]


def _wind(truth: Mapping[str, float]) -> float:
    return 1 + truth["distance_m"] / truth["seconds"] / WIND_MPS


def _motor_rise(truth: Mapping[str, float]) -> float:
    return 1.5 * truth["motor_resistance_ohm"] / _motor_w_per_k(truth)


def _controller_rise(truth: Mapping[str, float]) -> float:
    """Beside a motor of known temperature; else with what comes from the motor."""
    across = truth["motor_to_board_w_per_k"]
    watts_per_k = truth["board_cooling_w_per_k"] * _wind(truth) + across
    own = 1.5 * truth["fet_resistance_ohm"]
    if truth["motor_sensor"]:
        return own / watts_per_k
    warm = 1.5 * (truth["motor_resistance_now_ohm"] - truth["fet_resistance_ohm"]) / _motor_w_per_k(truth)
    return (own + across * warm) / (watts_per_k - across**2 / _motor_w_per_k(truth))


def _phase_ohm(truth: Mapping[str, float]) -> float:
    """A phase's resistance as a drive's fields give it: at 25 degC with the motor's temperature, else now."""
    if truth["motor_sensor"]:
        return truth["motor_resistance_ohm"] + truth["fet_resistance_ohm"]
    return truth["motor_resistance_now_ohm"]


# By the names of `iort_contract.catalog.analysis.PARAMETERS`; of a healthy car.
TRUTHS: dict[str, Truth] = {
    "battery_resistance_ohm": _same("battery_resistance_ohm"),
    "battery_slow_resistance_ohm": _same("battery_slow_resistance_ohm"),
    "battery_open_voltage_v": _same("open_voltage_v"),
    "battery_voltage_per_ah": _same("voltage_per_ah"),
    "battery_drawn_share": _drawn,
    "battery_charge_left": _same("charge_left"),
    "battery_range_left_km": lambda truth: truth["distance_m"] / 1000 / _drawn(truth) * truth["charge_left"],
    "motor_resistance_25_ohm": _phase_ohm,
    "motor_resistance_ohm": _same("motor_resistance_now_ohm"),
    "motor_flux_linkage_wb": _same("flux_linkage_wb"),
    "motor_inductance_h": _same("motor_inductance_h"),
    "motor_torque_nm_per_a": lambda truth: 1.5 * truth["pole_pairs"] * truth["flux_linkage_wb"],
    "speed_to_erpm_gain": _same("driven_erpm_per_mps"),
    "motor_force_n_per_a": _same("newtons_per_amp"),
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
    "motor_rise_k_per_a2": _motor_rise,
    "motor_thermal_resistance_k_per_w": lambda truth: _motor_rise(truth) / 1.5 / _phase_ohm(truth),
    "controller_rise_k_per_a2": _controller_rise,
    "controller_thermal_resistance_k_per_w": lambda truth: _controller_rise(truth) / 1.5 / _phase_ohm(truth),
    "voltage_drift_v": _nothing,
    "motor_current_drift_a": _nothing,
    "temperature_drift_k": _nothing,
}
