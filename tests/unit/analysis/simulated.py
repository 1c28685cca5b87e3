"""Streams of the simulated car, as arrays."""

from __future__ import annotations

from functools import cache

import numpy as np

from iort_agent.sources.sim import Sensors
from iort_agent.sources.sim.vehicle import Vehicle, VehicleConfig
from iort_analysis.samples.blocks import Block
from iort_contract.catalog.derived import F1TENTH
from iort_contract.messages.analysis import DriveKey

START_US, HZ = 1_700_000_000_000_000, 50
KEY = DriveKey("car7", START_US, "00c0ffee")
VEHICLE = F1TENTH


@cache
def streams(seconds: int = 120, seed: int = 1) -> dict[str, Block]:
    """The car's VESC at 50 Hz, and its pose at 25 Hz; do not change the arrays, they are shared."""
    car = Vehicle(VehicleConfig(), seed)
    measured = Sensors(car, seed)
    vesc, poses = [], []
    for i in range(seconds * HZ):
        car.step(1 / HZ)
        vesc.append(measured.vesc())
        if i % 2 == 0:
            poses.append(measured.pose())
    times = START_US + np.arange(len(vesc), dtype=np.int64) * (1_000_000 // HZ)
    return {
        "vesc": Block(times, _columns(vesc)),
        "pose": Block(times[::2], _columns(poses)),
    }


def changed(field: str, where: slice, value: float, seconds: int = 120) -> dict[str, Block]:
    """The streams with a value of the VESC replaced."""
    made = dict(streams(seconds))
    column = made["vesc"].columns[field].copy()
    column[where] = value
    made["vesc"] = Block(made["vesc"].times_us, {**made["vesc"].columns, field: column})
    return made


def _columns(samples: list) -> dict:
    return {name: np.array([float(one[name]) for one in samples]) for name in samples[0]}
