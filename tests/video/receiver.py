"""A viewer by aiortc that reads the number in the simulated camera's pictures: see `testkit.video_viewer`."""

from __future__ import annotations

from testkit.video import counter_of
from testkit.video_viewer import main

if __name__ == "__main__":
    main(counter_of)
