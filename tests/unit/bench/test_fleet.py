"""The search for the largest fleet whose summaries keep up."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from bench.fleet import look_for
from bench.load.fleet.generator import laps


@pytest.mark.parametrize(("limit", "first"), [(137, 200), (640, 50), (1, 50), (0, 4)])
def test_the_limit_is_found_to_a_tenth(limit, first):
    driven = []

    def drive(robots):
        driven.append(robots)
        return SimpleNamespace(keeps_up=robots <= limit)

    found = look_for(drive, first)
    assert found <= limit <= max(found * 1.12, found + 1)
    assert 0 not in driven
    assert len(driven) == len(set(driven)) < 12


def test_a_lap_has_every_sample_of_its_second():
    assert [len(lap["voltage_input"]) for lap in laps(20)] == [20] * 60
