"""The simulated car's streams as arrays, and drives of them with the truth that its physics know."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from iort_agent.sources.sim import Sensors
from iort_agent.sources.sim.vehicle import Vehicle, VehicleConfig
from iort_analysis.drives.drive import Drive
from iort_analysis.samples.blocks import Block
from iort_contract.catalog.derived import F1TENTH
from iort_contract.messages.analysis import DriveKey

START_US, HZ = 1_700_000_000_000_000, 50
KEY = DriveKey("car7", START_US, "00c0ffee")
VEHICLE = F1TENTH


@cache
def ride(seconds: float, seed: int) -> tuple[dict[str, Block], np.ndarray]:
    """The car's VESC at 50 Hz and its pose at 25 Hz, and its true pose; do not change the shared arrays."""
    car = Vehicle(VehicleConfig(), seed)
    measured = Sensors(car, seed)
    vesc, poses, truth = [], [], []
    for i in range(round(seconds * HZ)):
        car.step(1 / HZ)
        vesc.append(measured.vesc())
        truth.append(car.pose)
        if i % 2 == 0:
            poses.append(measured.pose())
    times = START_US + np.arange(len(vesc), dtype=np.int64) * (1_000_000 // HZ)
    streams = {"vesc": Block(times, _columns(vesc)), "pose": Block(times[::2], _columns(poses))}
    return streams, np.array(truth)


def _columns(samples: list) -> dict:
    return {name: np.array([float(one[name]) for one in samples]) for name in samples[0]}


def streams(seconds: int = 120, seed: int = 1) -> dict[str, Block]:
    return ride(seconds, seed)[0]


def changed(field: str, where: slice, value: float, seconds: int = 120) -> dict[str, Block]:
    """The streams with a value of the VESC replaced."""
    made = dict(streams(seconds))
    column = made["vesc"].columns[field].copy()
    column[where] = value
    made["vesc"] = Block(made["vesc"].times_us, {**made["vesc"].columns, field: column})
    return made


class Driven(NamedTuple):
    """A drive, and the true position every 20 ms."""

    drive: Drive
    seconds: np.ndarray
    x_m: np.ndarray
    y_m: np.ndarray


def sampled(streams: Mapping[str, Block], **given: Any) -> Drive:
    """A drive of these streams as they are, not cleaned."""
    times_us, columns = streams["vesc"]
    samples = Block(times_us, {f"vesc.{name}": column for name, column in columns.items()})
    told = {"vesc": "vesc", "pose": "pose" if "pose" in streams else None, "vehicle": F1TENTH}
    key = DriveKey("car", int(times_us[0]), "0badcafe")
    return Drive(key, int(times_us[-1]) + 1, dict(streams), samples, **{**told, **given})


def driven(seconds: float, seed: int = 1, **given: Any) -> Driven:
    """The simulated car's laps of its hall."""
    made, truth = ride(seconds, seed)
    x, y, _ = truth.T
    return Driven(sampled(made, **given), np.arange(len(x)) / HZ, x, y)


def crossed_s(driven: Driven, x_m: float, y_m: float, heading_rad: float, half_width_m: float) -> np.ndarray:
    """When the car truly passed a gate, in seconds of the drive."""
    dx, dy = driven.x_m - x_m, driven.y_m - y_m
    along = dx * math.cos(heading_rad) + dy * math.sin(heading_rad)
    beside = np.abs(dy * math.cos(heading_rad) - dx * math.sin(heading_rad)) < half_width_m
    at = np.flatnonzero((along[:-1] < 0) & (along[1:] >= 0) & beside[1:])
    share = -along[at] / (along[at + 1] - along[at])
    return driven.seconds[at] + share * (driven.seconds[at + 1] - driven.seconds[at])
