"""Two laps at the same places of the track."""

from __future__ import annotations

import numpy as np

from iort_analysis.errors import AnalysisError
from iort_analysis.results import Table


def compare(places: Table, one: int, other: int) -> Table:
    """The delta-time of two laps against distance: positive where ``other`` is behind ``one``.

    ``places`` is the table of when each lap passed each place. Raises `AnalysisError` for a lap that is not
    there.
    """
    rows = {lap: np.flatnonzero(places["lap"] == lap) for lap in (one, other)}
    for lap, found in rows.items():
        if not len(found):
            laps = int(np.max(places["lap"], initial=0))
            raise AnalysisError(f"lap must be from 1 to {laps}, got {lap}")
    first, second = rows[one], rows[other]
    return {
        "place_m": places["place_m"][first],
        "delta_s": places["since_s"][second] - places["since_s"][first],
        "one_mps": places["speed_mps"][first],
        "other_mps": places["speed_mps"][second],
    }
