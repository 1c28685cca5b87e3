"""A board's temperature that drifts away from how the board warms up.

    temperature = a + b * lag(1) + c * lag(current^2) + d * time

where the lag is the board's own time, found by the fit, and ``d`` is the drift. A board that cools worse has
a longer lag and still no drift. A motor that warms the board for an hour, and air that warms up, have one.
"""

from __future__ import annotations

import numpy as np

from iort_analysis.drives.drive import Drive
from iort_analysis.mining.anomalies.readings import Array, Readings
from iort_analysis.results import Mined
from iort_analysis.statistics.fitting import Fit, fit
from iort_analysis.statistics.signals import binned, bridged, lagged
from iort_contract.catalog.vesc import TEMPERATURES
from iort_contract.messages.analysis import Estimate

TEMPERATURE_DRIFT, LAG = "temperature_drift_k", "controller_lag_s"
_STEP_S, _LEAST_S = 2.0, 240.0
_LAGS_S = tuple(float(lag) for lag in np.geomspace(20, 2000, 14))
_ROUNDS = 4


def mine_warming(drive: Drive, samples: Readings) -> Mined:
    """The drift of the controller's temperature over the drive."""
    column = next((c for name in TEMPERATURES if (c := drive.of(drive.vesc, name)) is not None), None)
    if column is None:
        return _missing("the drive has no temperature of the controller")
    if samples.seconds[-1] < _LEAST_S:
        return _missing(f"the drive must last {_LEAST_S:g} s")
    degc = binned(samples.seconds, np.asarray(column, dtype=np.float64), _STEP_S)
    heat = bridged(binned(samples.seconds, samples.motor_a**2, _STEP_S))
    found = _best(degc, heat)
    if found is None:
        return _missing("the temperature says too little")
    fitted, lag_s = found
    # The last coefficient is what the logarithm of the lag is still off.
    value, low, high = (lag_s * float(np.exp(off)) for off in fitted.of(4, "1")[:3])
    lag = Estimate(value, low, high, "s")
    return Mined(estimates={TEMPERATURE_DRIFT: fitted.of(3, "K"), LAG: lag})


def _best(degc: Array, heat: Array) -> tuple[Fit, float] | None:
    """The fit with the best lag, whose uncertainty is in the others' covariance; and the lag in seconds."""
    fits = [(lag, found) for lag in _LAGS_S if (found := fit(_columns(heat, lag)[:4], degc)) is not None]
    if not fits:
        return None
    lag, found = min(fits, key=lambda one: float(np.nansum(np.abs(one[1].residuals))))
    for _ in range(_ROUNDS):
        columns = _columns(heat, lag)
        # How the model moves with the logarithm of the lag.
        nudged = _columns(heat, lag * 1.02)
        parts = zip(columns, nudged, found.coefficients, strict=False)
        tangent = sum((size * (other - column) / 0.02 for column, other, size in parts), np.zeros(len(degc)))
        joint = fit([*columns, tangent], degc)
        if joint is None:
            return None
        found, fitted_at = joint, lag
        lag *= float(np.exp(np.clip(joint.coefficients[4], -0.3, 0.3)))
    return found, fitted_at


def _missing(reason: str) -> Mined:
    return Mined(missing={TEMPERATURE_DRIFT: reason, LAG: reason})


def _columns(heat: Array, lag_s: float) -> list[Array]:
    steps = lag_s / _STEP_S
    mean = float(heat.mean())
    return [
        np.ones(len(heat)),
        lagged(np.ones(len(heat)), steps),
        lagged((heat - mean) / max(mean, 1e-9), steps),
        np.linspace(0, 1, len(heat)),
    ]
