"""Anomalies: sensors that fail, and faults that show in how a drive's fields go together."""

from __future__ import annotations

from iort_analysis.drives.drive import Drive
from iort_analysis.mining.anomalies.balance import mine_balance
from iort_analysis.mining.anomalies.discords import mine_discords
from iort_analysis.mining.anomalies.drift import mine_drift
from iort_analysis.mining.anomalies.dropouts import mine_dropouts
from iort_analysis.mining.anomalies.faults import mine_faults
from iort_analysis.mining.anomalies.frozen import mine_frozen
from iort_analysis.mining.anomalies.gaps import mine_gaps
from iort_analysis.mining.anomalies.motionless import mine_motionless
from iort_analysis.mining.anomalies.readings import readings
from iort_analysis.mining.anomalies.slip import mine_slip
from iort_analysis.mining.anomalies.underway import mine_underway
from iort_analysis.mining.anomalies.warming import mine_warming
from iort_analysis.results import Mined


def mine(drive: Drive) -> Mined:
    """All anomalies of a drive."""
    parts = [mine_motionless(drive), mine_faults(drive), mine_frozen(drive), mine_gaps(drive)]
    samples = readings(drive)
    if isinstance(samples, str):
        parts.append(Mined(missing={"anomalies": samples}))
    else:
        parts += [mine_balance(samples), mine_drift(samples)]
        parts += [
            test(drive, samples)
            for test in (mine_warming, mine_slip, mine_dropouts, mine_underway, mine_discords)
        ]
    return Mined(
        estimates={name: estimate for part in parts for name, estimate in part.estimates.items()},
        missing={name: reason for part in parts for name, reason in part.missing.items()},
        events=[event for part in parts for event in part.events],
    )
