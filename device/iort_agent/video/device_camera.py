"""A camera of this machine, by PyAV."""

from __future__ import annotations

import logging
import threading
from typing import Any, Callable, Mapping

from iort_agent.common.logs import ThrottledLog
from iort_agent.common.threads import Clock, brief
from iort_agent.errors import VideoError
from iort_agent.video import Frame, require
from iort_agent.video.camera import FIRST_S, SILENT_S, Camera, Moment, Newest, Pacer, captured, moment
from iort_agent.video.config import V4l2Camera, VideoConfig
from iort_agent.video.pictures import fitted

_log = logging.getLogger(__name__)

# Pictures that stand alone, so that one that is left out need not be decoded.
_ALONE = {"rawvideo", "mjpeg", "wrapped_avframe"}


class DeviceCamera:
    """A camera of this machine, or another input of ffmpeg's ``form``. A thread of its own reads it, since a
    call to a driver that hangs does not return: the reader then raises, and that thread is left behind."""

    def __init__(
        self,
        device: str,
        config: VideoConfig,
        clock: Clock,
        *,
        form: str = "v4l2",
        options: Mapping[str, str] | None = None,
    ) -> None:
        self._device, self._config, self._clock = device, config, clock
        self._form, self._options = form, dict(options or {})
        self._av = require("av")
        self._ended = threading.Event()
        self._newest: Newest[tuple[Any, Moment]] = Newest(clock, device)
        self._within_s, self._bad = FIRST_S, 0
        self._throttled = ThrottledLog(_log, clock)

    def open(self) -> None:
        brief("camera device", self._hear)

    def read(self, number: int, stop: threading.Event) -> Frame | None:
        taken = self._newest.take(stop, self._within_s)
        if taken is None:
            return None
        self._within_s = SILENT_S
        picture, at = taken
        return Frame(number, at.us, at.monotonic, fitted(picture, self._config.width, self._config.height))

    def report(self) -> Mapping[str, Any]:
        return {"bad": self._bad}

    def close(self) -> None:
        self._ended.set()

    def _hear(self) -> None:
        try:
            with self._av.open(self._device, format=self._form, options=self._options) as container:
                stream = container.streams.video[0]
                stream.codec_context.thread_count = 1
                alone = stream.codec_context.name in _ALONE
                pacer = Pacer(self._config.rate_hz)
                for packet in container.demux(stream):
                    if self._ended.is_set():
                        return
                    arrival = moment(self._clock)
                    if not alone or pacer.takes(arrival.monotonic):
                        self._decode(packet, arrival, None if alone else pacer)
            self._newest.fail(VideoError(f"{self._device} has ended"))
        except (OSError, ValueError, IndexError, self._av.error.FFmpegError) as error:
            todo = f": does it exist, is it free, and may this user read it? {error}"
            self._newest.fail(VideoError(f"{self._device} cannot be read{todo}"))

    def _decode(self, packet: Any, arrival: Moment, pacer: Pacer | None) -> None:
        try:
            pictures = packet.decode()
        except (ValueError, self._av.error.FFmpegError) as error:
            self._bad += 1
            self._throttled.warn("damaged", f"{self._device} gave a damaged picture: {error}")
            return
        for picture in pictures:
            if pacer is None or pacer.takes(arrival.monotonic):
                # The driver's time, in the robot's clock (`timestamps` below).
                stamp_us = None if picture.pts is None else round(picture.pts * picture.time_base * 1_000_000)
                self._newest.put((picture, captured(stamp_us, arrival)))


def v4l2(source: V4l2Camera, config: VideoConfig, clock: Clock) -> Callable[[], Camera]:
    """What makes a camera of the kernel's; the driver gives what is nearest to what is asked of it. Raises
    `VideoError` without PyAV."""
    require("av")
    options = {
        "video_size": f"{config.width}x{config.height}",
        "framerate": f"{config.rate_hz:g}",
        # Wall time, whichever clock the driver has.
        "timestamps": "abs",
    }
    if source.input_format is not None:
        options["input_format"] = source.input_format
    return lambda: DeviceCamera(source.device, config, clock, options=options)
