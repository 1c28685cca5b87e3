"""`iort analyse`: what it says while it waits."""

from __future__ import annotations

import pytest

from iort_station.cli.verbs.operations import analyse
from iort_station.operations.analysis import RUNNING, Progress


@pytest.mark.parametrize(
    ("done", "told"),
    [
        (0, "0 of 40 drives"),
        (10, "10 of 40 drives, 0:01:30 left"),
        (40, "40 drives analysed; comparing them with earlier ones"),
    ],
)
def test_who_waits_sees_how_far_it_is(done, told):
    assert analyse.progress(Progress(RUNNING, 40, done), 30.0) == told
