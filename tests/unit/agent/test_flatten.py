"""From nested ROS messages to flat samples."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from iort_agent.errors import SourceError
from iort_agent.sources.flatten import flatten


class Numbers:
    """Stands in for numpy's arrays and numbers."""

    def __init__(self, value: Any) -> None:
        self._value = value

    def tolist(self) -> Any:
        return self._value


def message(**fields: Any) -> SimpleNamespace:
    return SimpleNamespace(**fields)


def members(value: Any) -> dict[str, Any] | None:
    # As with rosbags, the constants are on the object but not among the fields.
    return (
        {n: v for n, v in vars(value).items() if n.islower()} if isinstance(value, SimpleNamespace) else None
    )


HEADER = message(seq=1, stamp=message(sec=1, nanosec=2), frame_id="")


@pytest.mark.parametrize(
    ("ros", "flat"),
    [
        (message(data=1.5), {"data": 1.5}),
        (message(header=HEADER, state=message(speed=1.0, FAULT_NONE=0, fault_code=0)),
         {"speed": 1.0, "fault_code": 0}),
        (message(header=HEADER, pose=message(position=message(x=1.0, y=2.0), ok=True)),
         {"position.x": 1.0, "position.y": 2.0, "ok": True}),
        (message(header=HEADER, a=message(x=1), b=message(x=2)), {"a.x": 1, "b.x": 2}),
        (message(header=HEADER, x=1.0), {"x": 1.0}),
        (message(twist=message(x=1.0)), {"twist.x": 1.0}),
        (message(header=HEADER, state=message(header=HEADER, x=1)), {"x": 1}),
        (message(header=HEADER, ranges=Numbers([1.0, 2.0])), {"ranges.0": 1.0, "ranges.1": 2.0}),
        (message(cells=[message(v=3), message(v=4)]), {"cells.0.v": 3, "cells.1.v": 4}),
        (message(header=HEADER, state=message(cells=(5, Numbers(6)))), {"cells.0": 5, "cells.1": 6}),
        (message(raw=b"\x01\x02"), {"raw.0": 1, "raw.1": 2}),
        (message(header=HEADER), {}),
        (message(), {}),
    ],
)  # fmt: skip
def test_flatten(ros: Any, flat: dict[str, Any]) -> None:
    found = flatten(ros, members)
    assert found == flat
    assert list(map(type, found.values())) == list(map(type, flat.values()))


def test_an_image_is_not_a_sample() -> None:
    with pytest.raises(SourceError, match="field data has 100000 elements"):
        flatten(message(data=Numbers([0] * 100_000)), members)
