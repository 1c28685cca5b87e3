"""A recording's file appears only after it is complete."""

from __future__ import annotations

import pytest

from iort_station.data import bags
from iort_station.errors import StationError


@pytest.mark.parametrize("ending", bags.KINDS)
def test_an_interrupted_export_leaves_no_file(tmp_path, ending):
    path = tmp_path / f"ride{ending}"
    with pytest.raises(StationError, match="broke off"), bags.KINDS[ending](path):
        raise StationError("broke off")
    assert list(tmp_path.iterdir()) == []
    with bags.KINDS[ending](path):
        pass
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(StationError, match="exists"), bags.KINDS[ending](path):
        pass
