"""The process of one drive: clean, integrate, transform, and mine by every miner.

A new miner is a file in `mining` and a line of `MINERS`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from iort_analysis.drives.building import build
from iort_analysis.drives.cleaning import MANY_WILD, wild_share
from iort_analysis.drives.drive import Drive, moving, vescs_of
from iort_analysis.mining import anomalies, battery, drivetrain, laps, motor, thermal
from iort_analysis.mining.gain import with_gain
from iort_analysis.results import DriveResult, Event, Mined, merge
from iort_analysis.samples.blocks import Block
from iort_contract.catalog.derived import Vehicle
from iort_contract.messages.analysis import DriveKey, Estimate

Miner = Callable[[Drive], Mined]
# By the name that a result gives as missing if the miner fails.
MINERS: Mapping[str, Miner] = MappingProxyType(
    {
        "anomalies": anomalies.mine,
        "battery": battery.mine,
        "motor": motor.mine,
        "drivetrain": drivetrain.mine,
        "thermal": thermal.mine,
        "laps": laps.mine,
    }
)


def analyse(
    key: DriveKey,
    streams: Mapping[str, Block],
    vehicle: Vehicle | None = None,
    known: Mapping[str, float] | None = None,
    *,
    miners: Mapping[str, Miner] = MINERS,
) -> DriveResult:
    """Analyse a drive from the samples of its streams, as recorded.

    It never fails because of them: what cannot be computed is in the result's ``missing``, with the reason.
    """
    drive = with_gain(build(key, streams, vehicle, known))
    found = merge(_mined(name, m, drive) for name, m in miners.items())
    if wild := _wild(drive):
        reasons = {name: f"{reason}; {wild}" for name, reason in found.missing.items()}
        found = replace(found, missing=reasons)
    mined = merge([Mined(missing=_unusable(drive)), found])
    repairs = Counter[str]()
    for repair in drive.repairs:
        repairs[repair.kind] += repair.samples
    samples = sum(len(block.times_us) for block in drive.raw.values())
    return DriveResult(key, drive.end_us, samples, dict(repairs), mined, drive.vesc or "")


def _mined(name: str, miner: Miner, drive: Drive) -> Mined:
    """What a miner found; one that fails does not stop the others."""
    try:
        with np.errstate(all="ignore"):
            return _finite(miner(drive))
    except Exception as error:  # noqa: BLE001 - whatever a miner meets in a drive, the others go on
        return Mined(missing={name: f"the miner failed: {type(error).__name__}: {error}"})


def _finite(mined: Mined) -> Mined:
    """The same with plain numbers; an estimate that is not finite is missing, as is an event's effect."""
    estimates, missing = {}, dict(mined.missing)
    for name, one in mined.estimates.items():
        value, low, high = float(one.value), float(one.low), float(one.high)
        if np.isfinite([value, low, high]).all():
            estimates[name] = Estimate(value, low, high, one.unit)
        else:
            missing[name] = "the estimate is not finite"
    return replace(
        mined, estimates=estimates, missing=missing, events=[_finite_event(event) for event in mined.events]
    )


def _finite_event(event: Event) -> Event:
    known = event.effect is not None and np.isfinite(event.effect[:3]).all()
    # A chance that is not known is no evidence.
    p = event.p if event.p is None or np.isfinite(event.p) else 1.0
    return event._replace(effect=event.effect if known else None, p=p)


def _wild(drive: Drive) -> str:
    """The motor controller's fields with wild values that the cleaning left, since they were too many."""
    block = drive.streams.get(drive.vesc or "")
    moves = None if block is None else moving(drive.vesc or "", block.columns)
    if block is None or moves is None:
        return ""
    shares = {name: wild_share(column, moves) for name, column in block.columns.items()}
    return ", ".join(
        f"{share:.0%} of {drive.vesc}.{name} are wild values, far from their neighbours"
        for name, share in shares.items()
        if share > MANY_WILD
    )


def _unusable(drive: Drive) -> dict[str, str]:
    """The streams and fields that no miner can use, with the reason."""
    missing = {}
    if not drive.raw:
        missing["samples"] = "the drive has no samples"
    elif drive.vesc is None:
        missing["vesc"] = "no stream has speed, voltage_input and current_motor"
    for other in vescs_of({name: block.columns for name, block in drive.streams.items()})[1:]:
        missing[other] = f"of several motor controllers only the first is analysed, {drive.vesc}"
    for stream, block in drive.raw.items():
        clean = drive.streams[stream].columns
        for name, column in block.columns.items():
            if name not in clean:
                if bool(np.array([value is None for value in column.tolist()]).all()):
                    missing[f"{stream}.{name}"] = "the field is null in every sample"
            elif bool(np.isnan(clean[name]).all()):
                recorded = column.dtype.kind == "f" and not bool(np.isnan(column).all())
                missing[f"{stream}.{name}"] = (
                    "the sensor is not fitted or not read"
                    if recorded
                    else "the field is null in every sample"
                )
    return missing
