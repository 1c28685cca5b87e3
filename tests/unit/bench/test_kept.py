"""The verdicts about a kept cloud that is killed."""

from __future__ import annotations

from dataclasses import replace

import pytest

from bench.sections import kept
from bench.sections.kept import OPEN_MOST_S, Counted, Kills
from local.figures import Spread

CAR = Counted(
    samples=100, batches=2, duplicated=0, lost=0, incomplete=(), killed_runs=1, summarized=100, expected=100
)
DRIVE = Kills(
    killed={"killed agent": 1},
    seed=1,
    seconds=10.0,
    restart_s=Spread.of([]),
    cars={"car1": CAR},
    open_s={"car1": [0.9]},
)


@pytest.mark.parametrize(
    ("change", "good"),
    [
        ({}, True),
        ({"open_s": {"car1": [None]}}, True),
        ({"open_s": {"car1": [OPEN_MOST_S + 0.1]}}, False),
        # An agent ended badly, and nobody had killed it.
        ({"open_s": {}}, False),
        ({"cars": {"car1": replace(CAR, lost=50, incomplete=("vesc",))}}, False),
        ({"cars": {"car1": replace(CAR, summarized=99)}}, False),
    ],
)
def test_a_killed_agent_may_lose_its_open_batch_and_nothing_else(change, good):
    (ratio,) = kept.report(replace(DRIVE, **change)).ratios
    assert ratio.reached is good


def test_the_table_names_what_was_open():
    (table,) = kept.report(replace(DRIVE, open_s={"car1": [0.9, None]})).tables
    assert "| 0.90, all |" in table.as_markdown()
