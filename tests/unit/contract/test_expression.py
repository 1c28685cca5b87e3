"""Conditions are also read by the Python of a robot; what they mean is tested against numpy's columns."""

from __future__ import annotations

from iort_contract import expression


def test_a_condition_is_read_without_numpy() -> None:
    node = expression.parse("0 < speed <= 2 and abs(current) > 1.5 and mode in ('a', 'b') or pose.x is None")
    columns = {
        "speed": [1, 3, 3],
        "current": [-2, -2, -2],
        "mode": ["b", "b", "b"],
        "pose.x": [0.5, 0.5, None],
    }
    assert expression.names(node) == set(columns)
    assert expression.holds(node, columns, 3) == [True, False, True]
