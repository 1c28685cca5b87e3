"""A camera of this machine, in whose place ffmpeg makes the pictures."""

from __future__ import annotations

import os
import threading
from pathlib import Path
from typing import Iterator

import pytest

from iort_agent.common.threads import SystemClock
from iort_agent.errors import VideoError
from iort_agent.video import Frame, device_camera
from iort_agent.video.config import V4l2Camera, VideoConfig
from iort_agent.video.device_camera import DeviceCamera, v4l2
from iort_agent.video.pictures import packed
from testkit.agent import ManualClock
from testkit.waiting import GUARD_S

CONFIG = VideoConfig(V4l2Camera(), width=320, height=240, rate_hz=10)
# 30 a second by the clock, of another shape than what is asked for.
SOURCE = "testsrc2=size=640x360:rate=30,realtime"


class Rig:
    def __init__(self) -> None:
        self.stop, self.number = threading.Event(), 0
        self.cameras: list[DeviceCamera] = []

    def open(self, source: str, form: str = "lavfi", **options: str) -> DeviceCamera:
        camera = DeviceCamera(source, CONFIG, SystemClock(), form=form, options=options)
        self.cameras.append(camera)
        camera.open()
        return camera

    def read(self, camera: DeviceCamera) -> Frame:
        self.number += 1
        frame = camera.read(self.number, self.stop)
        assert frame is not None
        return frame

    def read_all(self, camera: DeviceCamera) -> None:
        while True:
            self.read(camera)


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Iterator[Rig]:
    for name in ("FIRST_S", "SILENT_S"):
        monkeypatch.setattr(device_camera, name, GUARD_S)
    rig = Rig()
    yield rig
    for camera in rig.cameras:
        camera.close()


def test_its_pictures_come_in_the_size_and_at_the_rate_that_are_asked_for(rig: Rig) -> None:
    camera = rig.open(SOURCE)
    frames = [rig.read(camera) for _ in range(6)]
    assert [frame.number for frame in frames] == [1, 2, 3, 4, 5, 6]
    assert {(frame.picture.width, frame.picture.height) for frame in frames} == {(320, 240)}
    assert len({packed(frame.picture) for frame in frames}) == 6, "each is another picture"
    assert packed(frames[0].picture)[:320] == bytes([16]) * 320, "a bar above"
    # After a late picture the next one comes sooner.
    assert frames[-1].monotonic - frames[0].monotonic > 0.4, "not all thirty"
    assert all(abs(frame.captured_us / 1e6 - SystemClock().now_us() / 1e6) < 60 for frame in frames)


def test_a_compressed_stream_is_decoded_whole(rig: Rig, tmp_path: Path) -> None:
    """Pictures that need those before them; a damaged file gives those that are good."""
    import av

    path = tmp_path / "camera.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 640, 360, "yuv420p"
        with av.open("testsrc2=size=640x360:rate=30", format="lavfi") as source:
            for i, picture in enumerate(source.decode(video=0)):
                if i == 60:
                    break
                container.mux(stream.encode(picture.reformat(format="yuv420p")))
        container.mux(stream.encode())
    camera = rig.open(str(path), "matroska")
    assert rig.read(camera).picture.width == 320
    with pytest.raises(VideoError, match=r"camera\.mkv has ended"):
        rig.read_all(camera)


@pytest.mark.parametrize(
    ("source", "form"), [("/dev/no-such-camera", "v4l2"), ("nosuchsource", "lavfi"), ("/dev/null", "v4l2")]
)
def test_a_camera_that_is_not_there_is_an_error_that_says_what_to_look_at(
    rig: Rig, source: str, form: str
) -> None:
    camera = rig.open(source, form)
    with pytest.raises(VideoError, match=f"{source} cannot be read: does it exist, is it free, and may"):
        rig.read(camera)


def test_a_camera_that_is_unplugged_is_an_error(rig: Rig) -> None:
    camera = rig.open("testsrc2=size=64x64:rate=30:duration=0.5")
    with pytest.raises(VideoError, match="has ended"):
        rig.read_all(camera)


def test_reading_ends_when_nobody_looks(rig: Rig) -> None:
    camera = rig.open("testsrc2=size=64x64:rate=0.01,realtime")
    rig.stop.set()
    assert camera.read(1, rig.stop) is None


def test_what_is_asked_of_a_driver() -> None:
    make = v4l2(V4l2Camera("/dev/video9", "mjpeg"), CONFIG, SystemClock())
    camera = make()
    assert isinstance(camera, DeviceCamera)
    assert camera._device == "/dev/video9"
    assert camera._options == {
        "video_size": "320x240",
        "framerate": "10",
        "timestamps": "abs",
        "input_format": "mjpeg",
    }


def test_a_driver_that_hangs_is_an_error_and_no_hang(tmp_path: Path) -> None:
    path = tmp_path / "camera"
    os.mkfifo(path)
    # Opening it waits for a writer, as the call to a driver waits.
    camera = DeviceCamera(str(path), CONFIG, ManualClock(), form="rawvideo")
    camera.open()
    with pytest.raises(VideoError, match=rf"{path} gave no picture for 10 s"):
        camera.read(1, threading.Event())
    camera.close()
    with path.open("wb"):
        pass
