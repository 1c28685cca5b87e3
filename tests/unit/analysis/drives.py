"""Drives of the simulated car, with the truth that its physics know."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from iort_agent.sources.sim import Sensors
from iort_agent.sources.sim.vehicle import Vehicle as SimulatedCar
from iort_agent.sources.sim.vehicle import VehicleConfig
from iort_analysis.drives.drive import Drive
from iort_analysis.samples.blocks import Block
from iort_contract.catalog.derived import F1TENTH
from iort_contract.messages.analysis import DriveKey

START_US = 1_700_000_000_000_000
_STEP_US = 20_000


class Driven(NamedTuple):
    """A drive, and the true position every 20 ms."""

    drive: Drive
    seconds: np.ndarray
    x_m: np.ndarray
    y_m: np.ndarray


def sampled(
    vesc: list[dict[str, Any]], poses: list[dict[str, Any]], times_us: np.ndarray, **given: Any
) -> Drive:
    """A drive of these samples, with as many poses as there are."""

    def block(stream: str, rows: list[dict[str, Any]], at: np.ndarray) -> Block:
        return Block(
            at, {f"{stream}{name}": np.array([float(row[name]) for row in rows]) for name in rows[0]}
        )

    streams = {"vesc": block("", vesc, times_us)}
    samples = block("vesc.", vesc, times_us)
    if poses:
        streams["pose"] = block("", poses, times_us[:: len(vesc) // len(poses)][: len(poses)])
    told = {"vesc": "vesc", "pose": "pose" if poses else None, "vehicle": F1TENTH}
    key = DriveKey("car", int(times_us[0]), "0badcafe")
    return Drive(key, int(times_us[-1]) + 1, streams, samples, **{**told, **given})


def driven(seconds: float, seed: int = 1, **given: Any) -> Driven:
    """The simulated car's laps of its hall."""
    car = SimulatedCar(VehicleConfig(), seed)
    measured = Sensors(car, seed)
    vesc, poses, truth = [], [], []
    n = round(seconds * 50)
    for i in range(n):
        car.step(_STEP_US / 1e6)
        vesc.append(measured.vesc())
        truth.append(car.pose)
        if i % 2 == 0:
            poses.append(measured.pose())
    times_us = START_US + _STEP_US * np.arange(n)
    drive = sampled(vesc, poses, times_us, **given)
    x, y, _ = np.array(truth).T
    return Driven(drive, np.arange(n) * _STEP_US / 1e6, x, y)


def crossed_s(driven: Driven, x_m: float, y_m: float, heading_rad: float, half_width_m: float) -> np.ndarray:
    """When the car truly passed a gate, in seconds of the drive."""
    dx, dy = driven.x_m - x_m, driven.y_m - y_m
    along = dx * math.cos(heading_rad) + dy * math.sin(heading_rad)
    beside = np.abs(dy * math.cos(heading_rad) - dx * math.sin(heading_rad)) < half_width_m
    at = np.flatnonzero((along[:-1] < 0) & (along[1:] >= 0) & beside[1:])
    share = -along[at] / (along[at + 1] - along[at])
    return driven.seconds[at] + share * (driven.seconds[at + 1] - driven.seconds[at])
