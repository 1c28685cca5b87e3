"""Styles of a drive whose parts are known."""

from __future__ import annotations

import numpy as np
import pytest

from iort_analysis.mining import style
from tests.unit.analysis.drives import START_US, sampled


def test_the_styles_of_a_drive_have_their_shares_of_time():
    # A minute each: standing, then 10 times up 1 s, fast 2 s, down 1 s, slow 2 s.
    up, down = np.linspace(1, 6, 50), np.linspace(6, 1, 50)
    lap = np.concatenate([up, np.full(100, 6.0), down, np.full(100, 1.0)])
    speed = np.concatenate([np.zeros(3000), np.tile(lap, 10)])
    vesc = [{"speed": v * 4614} for v in speed]
    mined = style.mine(sampled(vesc, [], START_US + 20_000 * np.arange(len(speed))))
    truth = {"standing": 1 / 2, "steady_fast": 1 / 6, "steady_slow": 1 / 6, "hard_braking": 1 / 12}
    for name, share in truth.items():
        estimate = mined.estimates[f"style_{name}_share"]
        assert estimate.value == pytest.approx(share, abs=0.03), name
        assert estimate.low < share < estimate.high
    assert mined.tables["style"]["share"].sum() == pytest.approx(1)
    assert "needs a heading" in mined.missing["style_cornering_share"]


def test_a_car_in_corners_at_its_grip_is_told_from_one_on_a_straight():
    n = 6000
    corner = (np.arange(n) // 300) % 2 == 1
    heading = np.cumsum(np.where(corner, 1.5, 0.0)) / 50
    vesc = [{"speed": 4 * 4614} for _ in range(n)]
    poses = [{"x": 0.0, "y": 0.0, "heading": h} for h in (heading + np.pi) % (2 * np.pi) - np.pi]
    mined = style.mine(sampled(vesc, poses, START_US + 20_000 * np.arange(n)))
    assert mined.estimates["style_corner_at_the_limit_share"].value == pytest.approx(0.5, abs=0.03)
    assert mined.estimates["style_steady_fast_share"].value == pytest.approx(0.5, abs=0.03)


def test_a_short_drive_says_that_it_is_too_short():
    mined = style.mine(sampled([{"speed": 1.0}] * 100, [], START_US + 20_000 * np.arange(100)))
    assert mined.missing["style_standing_share"] == "the drive has 4 half seconds, at least 60 are needed"
