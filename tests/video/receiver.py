"""A viewer by aiortc that reads the number in the simulated camera's pictures: see `testkit.video_viewer`."""

from __future__ import annotations

from typing import Any

from iort_contract.counter import read_counter
from testkit.video_viewer import main


def number_in(picture: Any) -> int | None:
    """The number that a decoded picture shows."""
    plane = picture.planes[0]
    luma, line = memoryview(plane), plane.line_size
    return read_counter(lambda x, y: luma[y * line + x], picture.width, picture.height)


if __name__ == "__main__":
    main(number_in)
