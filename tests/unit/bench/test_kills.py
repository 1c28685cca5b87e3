"""The verdict of `make bench-kept` about a drive with kills."""

from __future__ import annotations

import json
from dataclasses import replace

from bench.keeping.counted import Counted
from bench.keeping.kills import OPEN_MOST_S, Kills
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
    agent_kills={"car1": 1},
    open_s={"car1": [0.9]},
)


def test_a_killed_agent_may_lose_its_open_batch_and_nothing_else():
    assert DRIVE.good
    assert replace(DRIVE, open_s={"car1": [None]}).good
    assert not replace(DRIVE, open_s={"car1": [OPEN_MOST_S + 0.1]}).good
    # An agent ended badly, and nobody had killed it.
    assert not replace(DRIVE, agent_kills={}).good
    assert not replace(DRIVE, cars={"car1": replace(CAR, lost=50, incomplete=("vesc",))}).good
    assert not replace(DRIVE, cars={"car1": replace(CAR, summarized=99)}).good


def test_the_figures_are_json_and_the_table_names_what_was_open():
    assert json.loads(json.dumps(DRIVE.as_json()))["cars"]["car1"]["killed_runs"] == 1
    assert "| 0.90, all |" in replace(DRIVE, open_s={"car1": [0.9, None]}).table().as_markdown()
