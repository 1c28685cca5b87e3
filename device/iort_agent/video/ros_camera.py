"""A topic of images of ROS 1 or ROS 2 as a camera.

`sensor_msgs/Image` may have the encodings of `sensor_msgs/image_encodings.hpp` that `_FORMATS` has;
`sensor_msgs/CompressedImage` is JPEG or PNG. A damaged message is counted and logged, and the next one is
awaited."""

from __future__ import annotations

import functools
import io
import logging
import threading
from typing import TYPE_CHECKING, Any, Mapping, NamedTuple

from iort_agent.common.logs import ThrottledLog
from iort_agent.common.threads import Clock
from iort_agent.errors import VideoError
from iort_agent.ros import Graph
from iort_agent.video import Frame, require
from iort_agent.video.camera import FIRST_S, SILENT_S, Camera, Moment, Newest, Pacer, captured, moment
from iort_agent.video.config import VideoConfig
from iort_agent.video.pictures import fitted, from_rows
from iort_contract.limits import ContractError
from iort_contract.ros.decode import Decoder, Large, stamp_ns
from iort_contract.ros.definition import parse, short_kind

if TYPE_CHECKING:
    import av

_log = logging.getLogger(__name__)

IMAGE, COMPRESSED = "sensor_msgs/Image", "sensor_msgs/CompressedImage"
MOST_PIXELS = 20_000_000
# A progressive JPEG needs about ten passes over its pixels. One of thousands takes hours in a few kilobytes.
_JPEG, _SCAN, _MOST_SCANS = b"\xff\xd8", b"\xff\xda", 64
# A topic's publishers have one type, and rarely another after a restart.
_MAX_KINDS = 8


class _Format(NamedTuple):
    """How an encoding has its pixels: ffmpeg's name, without its byte order if a value has two bytes; the
    bytes of a pixel in the first plane; and, for what has its colours in a second plane below the first, how
    many of its rows have one of colours, and how long that is in rows of the first."""

    name: str
    size: int
    wide: bool = False
    halved: int = 0
    colours: int = 1


_FORMATS = {
    **dict.fromkeys(("mono8", "8UC1"), _Format("gray", 1)),
    "mono16": _Format("gray16", 2, wide=True),
    "rgb8": _Format("rgb24", 3),
    **dict.fromkeys(("bgr8", "8UC3"), _Format("bgr24", 3)),
    "rgba8": _Format("rgba", 4),
    **dict.fromkeys(("bgra8", "8UC4"), _Format("bgra", 4)),
    "rgb16": _Format("rgb48", 6, wide=True),
    "bgr16": _Format("bgr48", 6, wide=True),
    "rgba16": _Format("rgba64", 8, wide=True),
    "bgra16": _Format("bgra64", 8, wide=True),
    **{
        f"bayer_{pattern}{bits}": _Format(f"bayer_{pattern}{bits}", bits // 8, wide=bits == 16)
        for pattern in ("rggb", "bggr", "gbrg", "grbg")
        for bits in (8, 16)
    },
    **dict.fromkeys(("uyvy", "yuv422"), _Format("uyvy422", 2)),
    **dict.fromkeys(("yuyv", "yuv422_yuy2"), _Format("yuyv422", 2)),
    "nv12": _Format("nv12", 1, halved=2),
    "nv21": _Format("nv21", 1, halved=2),
    "nv24": _Format("nv24", 1, halved=1, colours=2),
}


class Images:
    """Pictures of messages of one type; see `images_of`."""

    def __init__(self, kind: str, definition: str) -> None:
        name = short_kind(kind)
        if name not in {IMAGE, COMPRESSED}:
            raise VideoError(
                f"a camera must have messages of {IMAGE} or {COMPRESSED}, got {kind or 'no type'}"
            )
        self._compressed = name == COMPRESSED
        self._decoder = Decoder(parse(kind, definition), large=True)

    def picture(self, data: bytes) -> tuple[int | None, av.VideoFrame, bytes | None]:
        """The stamp in microseconds, the picture in a format of its own, and the JPEG that it was, if it was
        one. Raises `VideoError` and `ContractError` for a message that is damaged, or has another
        encoding."""
        sample: Mapping[str, Any] = self._decoder.decode(data)
        content = sample.get("data")
        if not isinstance(content, Large) or not content:
            raise VideoError("the image has no data")
        stamp = stamp_ns(data, ros2=self._decoder.ros2)
        picture = _decompressed(content) if self._compressed else _of_pixels(sample, content)
        jpeg = bytes(content) if self._compressed and content.startswith(_JPEG) else None
        return None if stamp is None else stamp // 1000, picture, jpeg


@functools.lru_cache(maxsize=_MAX_KINDS)
def images_of(kind: str, definition: str) -> Images:
    """The images of a type. Raises `VideoError` for another type, `ContractError` for a definition that
    cannot be read."""
    return Images(kind, definition)


def _of_pixels(sample: Mapping[str, Any], content: bytes) -> av.VideoFrame:
    width, height, step = (int(sample[name]) for name in ("width", "height", "step"))
    encoding = str(sample["encoding"])
    form = _FORMATS.get(encoding)
    if form is None:
        raise VideoError(f"an image's encoding must be one of {', '.join(_FORMATS)}, got {encoding[:20]!r}")
    used, lines = width * form.size, height
    if form.halved:
        lines += height // form.halved * form.colours
    if not 0 < width * height <= MOST_PIXELS or step < used or len(content) < lines * step:
        raise VideoError(f"an image of {width} by {height} {encoding} has {len(content)} bytes, {step} a row")
    if (form.halved == 2 and height % 2) or (
        form.name in {"uyvy422", "yuyv422", "nv12", "nv21"} and width % 2
    ):
        raise VideoError(f"an image in {encoding} must have even sizes, got {width} by {height}")
    name = form.name
    if form.wide:
        name += "be" if sample["is_bigendian"] else "le"
    whole = memoryview(content)
    rows = [(whole[: height * step], step, used)]
    if form.halved:
        rows.append((whole[height * step : lines * step], step * form.colours, used * form.colours))
    picture = from_rows(name, width, height, rows)
    # ffmpeg's own way from these to YUV exchanges red and blue.
    return picture.reformat(format="rgb24") if name.startswith("bayer") else picture


def _decompressed(content: bytes) -> av.VideoFrame:
    pyav, image = require("av"), require("PIL.Image")
    try:
        # Reads the head alone.
        with image.open(io.BytesIO(content), formats=("JPEG", "PNG")) as head:
            width, height, form = head.width, head.height, head.format
    except (OSError, SyntaxError, ValueError, image.DecompressionBombError) as error:
        raise VideoError(f"a compressed image must be JPEG or PNG: {error}") from error
    if width * height > MOST_PIXELS:
        raise VideoError(f"an image must have at most {MOST_PIXELS} pixels, got {width} by {height}")
    if form == "JPEG" and content.count(_SCAN) > _MOST_SCANS:
        raise VideoError(f"a JPEG must have at most {_MOST_SCANS} scans")
    decoder = pyav.CodecContext.create("mjpeg" if form == "JPEG" else "png", "r")
    # Half a picture is worse than none.
    decoder.options = {"err_detect": "explode"}
    decoder.thread_count = 1
    try:
        pictures = decoder.decode(pyav.Packet(content)) or decoder.decode(None)
    except (ValueError, pyav.error.FFmpegError) as error:
        raise VideoError(f"the {form} is damaged: {error}") from error
    if not pictures:
        raise VideoError(f"the {form} is damaged")
    picture: av.VideoFrame = pictures[0]
    return picture


class RosCamera(Camera):
    """The pictures of a topic. Only the newest message waits, as its bytes; it is decoded when it is read."""

    def __init__(self, graph: Graph, topic: str, config: VideoConfig, clock: Clock) -> None:
        self._graph, self._topic, self._config, self._clock = graph, topic, config, clock
        self._newest: Newest[tuple[Mapping[str, str], bytes, Moment]] = Newest(clock, f"the topic {topic}")
        self._pacer = Pacer(config.rate_hz)
        self._throttled = ThrottledLog(_log, clock)
        self._within_s, self._why = FIRST_S, ""
        self._stamp_us: int | None = None

    def open(self) -> None:
        self._graph.subscribe(self._topic, self._on_message)

    def read(self, number: int, stop: threading.Event) -> Frame | None:
        until = self._clock.monotonic() + self._within_s
        while True:
            try:
                taken = self._newest.take(stop, max(0.0, until - self._clock.monotonic()))
            except VideoError as error:
                why = f", the last: {self._why}" if self._why else ""
                text = f"the topic {self._topic} gave no picture for {self._within_s:g} s{why}"
                raise VideoError(text) from error
            if taken is None:
                return None
            header, data, arrival = taken
            try:
                images = images_of(header.get("type", ""), header.get("message_definition", ""))
                stamp_us, picture, jpeg = images.picture(data)
            except (VideoError, ContractError) as error:
                self._why = str(error)
                self._throttled.warn("bad", f"the topic {self._topic} gave no good picture: {error}")
                continue
            if stamp_us and stamp_us == self._stamp_us:
                # A relay or a camera that repeats its last picture shows nothing new.
                self._why = "it has the stamp of the one before"
                continue
            self._within_s, self._why, self._stamp_us = SILENT_S, "", stamp_us
            at = captured(stamp_us, arrival)
            old_s = arrival.monotonic - at.monotonic
            if old_s * 1000 > self._config.max_age_ms:
                self._throttled.warn(
                    "late",
                    f"the topic {self._topic} gives pictures that are {old_s:.1f} s old by their stamps: "
                    "nobody can drive by them; is the clock of the camera's machine right?",
                )
            whole = fitted(picture, self._config.width, self._config.height)
            return Frame(number, at.us, at.monotonic, whole, jpeg)

    def report(self) -> Mapping[str, Any]:
        return self._throttled.counts()

    def close(self) -> None:
        self._graph.unsubscribe(self._topic, self._on_message)

    def _on_message(self, header: Mapping[str, str], data: bytes) -> None:
        arrival = moment(self._clock)
        if self._pacer.takes(arrival.monotonic):
            self._newest.put((header, data, arrival))
