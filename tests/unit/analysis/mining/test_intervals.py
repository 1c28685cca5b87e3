"""The intervals of a car's parameters, on a few cars of any lab: `make bench ONLY=analysis` has more."""

from __future__ import annotations

import math
from collections import defaultdict

from bench.proof.fleet import ANY_CARS, drive_of, simulated
from bench.proof.judging import INDICATORS, SPANNING, TRUTHS
from iort_agent.sources.sim import ALL
from iort_analysis.process import MINERS, analyse
from iort_contract.catalog.derived import F1TENTH

# Apart from those of the proof.
_CARS, _SECONDS = range(3000, 3010), 240.0
# Without the motor's flux linkage only.
_RATIOS = {"acceleration_per_a_mps2", "friction_per_mass_mps2"}
_MINERS = {name: MINERS[name] for name in ("battery", "motor", "drivetrain", "thermal")}


def test_intervals_are_neither_too_narrow_nor_too_wide() -> None:
    off = defaultdict(list)
    for car in _CARS:
        spec = drive_of(car, 0, seconds=_SECONDS, cars=ANY_CARS)
        streams, truth = simulated(spec, None)
        truth |= {"seconds": _SECONDS, "motor_sensor": float(spec.fields == ALL)}
        known = {"mass_kg": spec.vehicle.mass_kg, "pole_pairs": float(spec.vehicle.pole_pairs)}
        for name, one in analyse(spec.key, streams, F1TENTH, known, miners=_MINERS).mined.estimates.items():
            if name in TRUTHS:
                off[name].append((one.value - TRUTHS[name](truth)) / (one.high - one.low) * 2)

    # In half widths; of errors that are as the intervals say, 0.6.
    errors = {name: math.sqrt(sum(one * one for one in some) / len(some)) for name, some in off.items()}
    assert errors.keys() == TRUTHS.keys() - INDICATORS - SPANNING - _RATIOS
    assert {name: error for name, error in errors.items() if not 0.15 < error < 1.25} == {}
    every = [one for some in off.values() for one in some]
    assert 0.8 < sum(abs(one) < 1 for one in every) / len(every) < 0.97
