"""The recordings of real cars, whose truth nobody knows: what is estimated, and what speaks for it."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.report import Section
from iort_analysis.drives.building import build
from iort_analysis.drives.drive import Drive
from iort_analysis.mining.motor import RAD_S_PER_ERPM
from iort_analysis.process import analyse
from iort_analysis.samples.blocks import Block, column_of
from iort_contract.catalog.car import GROUPS
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.messages.analysis import DriveKey, Estimate
from iort_contract.recordings import Message
from iort_contract.recordings.rosbag import Recording, Unread
from iort_contract.recordings.tool_csv import VescLog
from testkit import ROOT

Array = NDArray[np.float64]

FOLDER = Path(os.environ.get("IORT_RECORDINGS") or ROOT.parent / "shared" / "data")
RIDE, F1TENTH_BAG = "vesc-tool-ride.csv", "f1tenth-motor-servo.bag"
# Neither recording says on which day it was made.
_FIRST_US = 1_700_000_000_000_000
# The ride ends with a throttle that is let go: seconds at load before, and without load after.
_LOADED_S, _FREE_S = (57.0, 67.0), (67.6, 73.8)
_COASTS_ERPM, _STANDS_ERPM, _STANDS_A = 5000.0, 100.0, 10.0


def streams_of(recording: AbstractContextManager[Iterator[Message]]) -> dict[str, Block]:
    """All samples of a recording."""
    rows: dict[str, list[Message]] = {}
    with recording as messages:
        for message in messages:
            rows.setdefault(message.stream, []).append(message)
    return {
        stream: Block(
            np.array([_FIRST_US + one.at_ns // 1000 for one in found], dtype=np.int64),
            {
                name: column_of([one.values.get(name) for one in found])
                for name in dict.fromkeys(name for one in found for name in one.values)
            },
        )
        for stream, found in rows.items()
    }


def ride(folder: Path = FOLDER) -> dict[str, Block]:
    """An electric skateboard's log of VESC Tool, 74 s."""
    return streams_of(VescLog(folder / RIDE, VESC_STREAM, original=False))


def f1tenth(folder: Path = FOLDER) -> dict[str, Block]:
    """An F1TENTH car's bag, 45 s."""
    return streams_of(Recording(folder / F1TENTH_BAG, None, VESC_STREAM, Unread()))


def step_ohm(drive: Drive) -> Estimate:
    """The battery's resistance by the step of the ride's voltage as the throttle is let go: no model."""
    voltage, current = (drive.of(drive.vesc, name) for name in ("voltage_input", "current_input"))
    if voltage is None or current is None:
        raise ValueError("the ride has voltage_input and current_input")
    loaded, free = ((drive.seconds > first) & (drive.seconds < last) for first, last in (_LOADED_S, _FREE_S))
    amps = float(current[loaded].mean() - current[free].mean())
    ohm = float(voltage[free].mean() - voltage[loaded].mean()) / amps
    error = math.sqrt(sum(float(voltage[part].var()) / int(part.sum()) for part in (loaded, free))) / amps
    return Estimate(ohm, ohm - 1.645 * error, ohm + 1.645 * error, "ohm")


def coasting_wb(drive: Drive) -> tuple[float, float]:
    """The flux linkage by the voltage of the motor that coasts without current, from and to: no model."""
    speed, volts, amps = _phase(drive)
    within = (speed > _COASTS_ERPM) & (np.abs(amps) < 0.05)
    low, high = np.quantile(volts[within] / (speed[within] * RAD_S_PER_ERPM), (0.1, 0.9))
    return float(low), float(high)


def standing_ohm(drive: Drive) -> tuple[float, float]:
    """The motor's resistance by the voltage for the current while it stands, from and to: no model."""
    speed, volts, amps = _phase(drive)
    within = (np.abs(speed) < _STANDS_ERPM) & (amps > _STANDS_A)
    low, high = np.quantile(volts[within] / amps[within], (0.1, 0.9))
    return float(low), float(high)


def _phase(drive: Drive) -> tuple[Array, Array, Array]:
    """Speed, length of the phase's voltage, and current."""
    fields = (drive.of(drive.vesc, name) for name in ("speed", "avg_vd", "avg_vq", "avg_iq"))
    speed, direct, quadrature, amps = (np.zeros(0) if column is None else column for column in fields)
    return speed, np.hypot(direct, quadrature), amps


def sections(folder: Path = FOLDER) -> list[Section]:
    """The report's section; none without the recordings."""
    if not all((folder / name).is_file() for name in (RIDE, F1TENTH_BAG)):
        return []
    section = Section("recordings", "Recordings of real cars")
    own = [parameter.name for group in GROUPS.values() for parameter in group]
    head = ["parameter", "value", "from", "to", "unit", "what speaks for it"]
    for title, streams in (("skateboard", ride(folder)), ("F1TENTH car", f1tenth(folder))):
        key = DriveKey(title.split()[0].lower(), _FIRST_US, "recorded")
        mined = analyse(key, streams).mined
        speaks = _speaks(build(key, streams)) if title == "skateboard" else {}
        estimates = {name: mined.estimates[name] for name in own if name in mined.estimates}
        section.table(
            f"{title}: estimates with 90 % intervals",
            head,
            [
                [name, *(f"{value:.4g}" for value in estimate[:3]), estimate.unit, speaks.get(name, "")]
                for name, estimate in estimates.items()
            ],
        )
        missing = [[name, mined.missing[name]] for name in own if name in mined.missing]
        section.table(f"{title}: what it does not tell", ["parameter", "why"], missing)
    return [section]


def _speaks(drive: Drive) -> dict[str, str]:
    step, flux, stands = step_ohm(drive), coasting_wb(drive), standing_ohm(drive)
    return {
        "battery_resistance_ohm": f"step as the throttle is let go: {step.low:.3f} to {step.high:.3f} ohm",
        "motor_resistance_ohm": f"current while it stands: {stands[0]:.3f} to {stands[1]:.3f} ohm",
        "motor_flux_linkage_wb": f"voltage while it coasts: {flux[0]:.5f} to {flux[1]:.5f} Wb",
    }
