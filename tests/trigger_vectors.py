"""Samples and the edges that they make: the evaluator, the agent and the dry-run find the same ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from iort_contract.catalog.derived import Vehicle

MS = 1_000


class Vector(NamedTuple):
    """A condition, samples as (stream, milliseconds, values), and its edges' milliseconds and values."""

    when: str
    samples: Sequence[tuple[str, int, Mapping[str, Any]]]
    edges: Sequence[tuple[int, Mapping[str, Any]]]
    others: tuple[str, ...] = ()
    vehicle: Vehicle | None = None


def _of(field: str, *values: Any, every: int = 100, stream: str = "vesc") -> list[tuple[str, int, Any]]:
    return [(stream, i * every, {field: value}) for i, value in enumerate(values)]


def _mixed(*parts: Sequence[tuple[str, int, Any]]) -> list[tuple[str, int, Any]]:
    return sorted((sample for part in parts for sample in part), key=lambda sample: sample[1])


VECTORS = {
    "a rising edge, once": Vector(
        "x > 1", _of("x", 0, 2, 3, 0, 2), [(100, {"x": 2}), (400, {"x": 2})]
    ),
    "true from the first sample on": Vector("x > 1", _of("x", 2, 2), [(0, {"x": 2})]),
    "null is no number": Vector(
        "x > 1", _of("x", 2, None, 2, float("nan"), 2), [(0, {"x": 2}), (200, {"x": 2}), (400, {"x": 2})]
    ),
    "a missing field is null": Vector("y is None", [("vesc", 0, {"x": 1})], [(0, {"y": None})]),
    "flags and texts": Vector(
        "on and frame == 'map'",
        [("vesc", i * 100, {"on": on, "frame": "map"}) for i, on in enumerate((False, True))],
        [(100, {"on": True, "frame": "map"})],
    ),
    "for: the edge is when it has been true for that long": Vector(
        "x > 1 for 250ms", _of("x", 0, 2, 2, 2, 2, 2), [(350, {"x": 2})]
    ),
    "for: not if it ends at that moment": Vector("x > 1 for 200ms", _of("x", 0, 2, 2, 0, 0), []),
    "for: begins anew": Vector("x > 1 for 200ms", _of("x", 0, 2, 0, 2, 2, 2, 2), [(500, {"x": 2})]),
    "for: a field keeps its value between samples": Vector(
        "x > 1 for 2s", _of("x", 2, 0, every=9_000), [(2_000, {"x": 2})]
    ),
    "delta: since the newest sample that is old enough": Vector(
        "delta(x, 200ms) >= 5",
        _of("x", 0, 2, 4, 6, 9),
        [(400, {"x": 9, "delta(x, 200ms)": 5.0})],
    ),
    "delta: of null is null": Vector("delta(x, 100ms) > 1", _of("x", None, 9, None, 9), []),
    "delta: two of one field": Vector(
        "delta(x, 100ms) > 0 and delta(x, 300ms) < 0",
        _of("x", 9, 5, 1, 2),
        [(300, {"x": 2, "delta(x, 100ms)": 1.0, "delta(x, 300ms)": -7.0})],
    ),
    "silent: at the moment when it is that long, noticed later": Vector(
        "silent(scan, 500ms)",
        _mixed(_of("a", *[0] * 4, stream="scan"), _of("a", *[0] * 20, stream="vesc")),
        [(800, {"silent(scan, 500ms)": True})],
    ),
    "silent: not before the first sample": Vector("silent(scan, 500ms)", _of("a", *[0] * 20), []),
    "silent: not while samples come": Vector(
        "silent(scan, 100ms)", _of("a", *[0] * 5, stream="scan"), []
    ),
    "silent: noticed at its own next sample": Vector(
        "silent(scan, 1s)", _of("a", 0, 0, stream="scan", every=5_000), [(1_000, {"silent(scan, 1s)": True})]
    ),
    "silent for a while, and a field": Vector(
        "x > 1 and silent(scan, 200ms) for 300ms",
        _mixed(_of("x", *[2] * 12), _of("a", 0, 0, stream="scan")),
        [(600, {"x": 2, "silent(scan, 200ms)": True})],
    ),
    "a field of another stream keeps its value": Vector(
        "x > 1 and pose.y > 5",
        _mixed(_of("x", 0, 2, 2, 2), _of("y", 9, 1, 9, stream="pose", every=150)),
        [(100, {"x": 2, "pose.y": 9}), (300, {"x": 2, "pose.y": 9})],
        others=("pose",),
    ),
    "samples of one moment are taken together": Vector(
        "x > 1 and pose.y > 5",
        [("vesc", 100, {"x": 2}), ("pose", 100, {"y": 1}), ("vesc", 200, {"x": 0}), ("pose", 200, {"y": 9})],
        [],
        others=("pose",),
    ),
    "a derived field": Vector(
        "speed_mps > 1 and power_w < -5",
        [("vesc", 0, {"speed": 0.0, "voltage_input": 10.0, "current_input": -1.0}),
         ("vesc", 100, {"speed": 9_228.0, "voltage_input": 10.0, "current_input": -1.0})],
        [(100, {"speed_mps": 2.0, "power_w": -10.0})],
        vehicle=Vehicle(4_614.0),
    ),
    "a nested field and an element": Vector(
        "pose.position.x > 1 and ranges[0] < 2",
        [("vesc", 0, {"pose.position.x": 2.0, "ranges.0": 1.5})],
        [(0, {"pose.position.x": 2.0, "ranges.0": 1.5})],
    ),
}  # fmt: skip
