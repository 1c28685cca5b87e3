"""The bitrate follows what a viewer says, and its losses."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from iort_agent.video.rate import Rate


def test_it_begins_in_the_middle_and_follows_the_viewer_within_bounds() -> None:
    rate = Rate(800, 150, 2500)
    assert rate.bps() == 800
    for told, bps in ((1200, 1200), (9000, 2500), (10, 150)):
        rate.told(told)
        assert rate.bps() == bps


def test_many_losses_lower_it_and_few_let_it_grow_again() -> None:
    rate = Rate(800, 150, 2500)
    rate.told(2000)
    rate.lost(0.2)
    assert rate.bps() == 1800
    # As many as a radio loses at any bitrate.
    rate.lost(0.05)
    assert rate.bps() == 1800
    rate.lost(0.0)
    assert rate.bps() == 1800 * 1.08
    for _ in range(10):
        rate.lost(0.0)
    assert rate.bps() == 2000


@given(st.lists(st.tuples(st.booleans(), st.floats(0, 1))))
def test_it_never_leaves_its_bounds(events: list[tuple[bool, float]]) -> None:
    rate = Rate(800, 150, 2500)
    for told, value in events:
        if told:
            rate.told(value * 5000)
        else:
            rate.lost(value)
        assert 150 <= rate.bps() <= 2500
    # Not lost for good: it recovers within a minute.
    rate.told(2500)
    for _ in range(60):
        rate.lost(0.0)
    assert rate.bps() == 2500
