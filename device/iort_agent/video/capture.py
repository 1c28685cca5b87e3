"""The thread that takes a camera's pictures while somebody looks.

```
 camera ── read ──► Capture (numbers, times) ──► take(Frame)
```

A camera that is silent, or gone, raises: the thread is supervised, so there is an alarm, and the camera is
opened again."""

from __future__ import annotations

import threading
from fractions import Fraction
from typing import Any, Callable

from iort_agent.common.threads import Clock, Supervised
from iort_agent.ros import Graph
from iort_agent.sources.sim import SimSource
from iort_agent.video import RTP_HZ, Frame, Pictures
from iort_agent.video.camera import SILENT_S, Camera
from iort_agent.video.config import TopicCamera, V4l2Camera, VideoConfig
from iort_agent.video.device_camera import v4l2
from iort_agent.video.ros_camera import RosCamera
from iort_agent.video.sim_camera import HallCamera


class Capture:
    """Takes a camera's pictures in a thread of its own while they are wanted. ``make`` gives the camera, and
    ``take`` gets each picture, in that thread: it must not block. ``first`` is the first picture's number.
    Safe to use from several threads."""

    def __init__(
        self,
        make: Callable[[], Camera],
        clock: Clock,
        *,
        take: Callable[[Frame], None],
        pictures: Pictures,
        first: int = 1,
    ) -> None:
        self._make, self._clock, self._take, self._pictures = make, clock, take, pictures
        self._lock = threading.Lock()
        self._wanted, self._idle, self._ended = threading.Event(), threading.Event(), False
        self._camera: Camera | None = None
        self._first, self._number, self._pts = first, first - 1, -1
        self._thread = Supervised("camera", self._run)

    def start(self) -> None:
        """Begin; nothing is captured yet."""
        self._thread.start()

    def want(self, *, wanted: bool) -> None:
        """Whether somebody looks."""
        with self._lock:
            if self._ended:
                return
            if wanted:
                self._idle.clear()
                self._wanted.set()
            else:
                self._wanted.clear()
                self._idle.set()

    def close(self) -> None:
        """End."""
        with self._lock:
            self._ended = True
            self._idle.set()
            self._wanted.set()
        self._thread.join(SILENT_S)

    def report(self) -> dict[str, Any]:
        """How many pictures are captured, and the open camera's own counts."""
        camera, captured = self._camera, self._number - self._first + 1
        return {"captured": captured, "open": camera is not None, **(camera.report() if camera else {})}

    def _run(self) -> None:
        while True:
            self._clock.wait(self._wanted, None)
            if self._ended:
                return
            self._camera = camera = self._make()
            try:
                camera.open()
                while (frame := camera.read(self._number + 1, self._idle)) is not None:
                    self._number = frame.number
                    # No two pictures have one time, whatever their stamps say.
                    self._pts = max(self._pts + 1, round(frame.monotonic * RTP_HZ))
                    frame.picture.pts, frame.picture.time_base = self._pts, Fraction(1, RTP_HZ)
                    self._pictures.add(frame)
                    self._take(frame)
            finally:
                self._camera = None
                camera.close()


def make_camera(
    config: VideoConfig, clock: Clock, *, graph: Graph | None = None, car: SimSource | None = None
) -> Callable[[], Camera]:
    """What makes the camera of a configuration, which `load_config` has checked: ``graph`` is the node of
    the sources, which its owner starts and closes; ``car`` is the simulated one. Raises `VideoError` without
    the packages of video."""
    source = config.source
    if isinstance(source, V4l2Camera):
        return v4l2(source, config, clock)
    if isinstance(source, TopicCamera):
        assert graph is not None, "as above"
        topic, node = source.topic, graph
        return lambda: RosCamera(node, topic, config, clock)
    assert car is not None, "as above"
    camera = HallCamera(car, config, clock)
    return lambda: camera
