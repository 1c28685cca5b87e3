"""One encoder for all viewers: VP8 or H.264 by PyAV, or H.264 by a pipeline of GStreamer in a process of its
own (`iort_agent.video.gstreamer`).

No picture waits in it for a later one. The bitrate may change at any time. libvpx takes another one only in a
new context, whose first picture is a key picture; libx264 takes a lower one at once, and a higher one than it
began with in a new context. A context is renewed for a change of more than `_CHANGE`, and not sooner than
`_LOWER_S` or `_HIGHER_S` after the last: a network that gets worse cannot wait."""

from __future__ import annotations

import os
import time
from fractions import Fraction
from typing import Any, Mapping, Protocol

from iort_agent.errors import VideoError
from iort_agent.video import RTP_HZ, Encoded, Frame, require
from iort_agent.video.config import GSTREAMER, H264, VP8, VideoConfig
from iort_agent.video.gstreamer import GstreamerEncoder

_CHANGE, _LOWER_S, _HIGHER_S = 0.15, 1.0, 4.0
# Less than this share of the bitrate that libx264 began with: its buffer would let key pictures be too large.
_MUCH_LESS = 0.3
# After a longer pause the context is a new one: libvpx takes the pause for bits that it may use.
_PAUSE_S = 2.0
# No key pictures but those that are asked for, which viewers do when they begin and after a loss.
_NEVER = 1_000_000
_MOST_THREADS = 4
LIBRARIES = {VP8: "libvpx", H264: "libx264"}
MIMES = {VP8: "video/VP8", H264: "video/H264", GSTREAMER: "video/H264"}


class Encoder(Protocol):
    """Encodes pictures in the order of their capture, in one thread."""

    def set_bitrate(self, kbps: float) -> None:
        """Aim at a bitrate, within car.yaml's bounds; from any thread."""

    def encode(self, frame: Frame, *, key: bool = False) -> Encoded | None:
        """The encoded picture; with ``key`` a viewer can begin with it. None for one that is left out so that
        the next ones are in time. Raises `VideoError`."""

    def report(self) -> Mapping[str, Any]:
        """The pictures that were encoded and left out, and the bitrate that is aimed at."""

    def close(self) -> None:
        """Give up what it holds."""


class PyavEncoder:
    """VP8 or H.264 by PyAV; use `make_encoder`."""

    def __init__(self, config: VideoConfig) -> None:
        self._av, self._config = require("av"), config
        require("av.video.frame")
        self._kbps = self._aim = config.bitrate_kbps.max
        self._context: Any = None
        self._opened = self._last = 0.0
        self._pts = -1
        self.encoded = self.left_out = self.renewed = 0

    def set_bitrate(self, kbps: float) -> None:
        bounds = self._config.bitrate_kbps
        self._aim = round(max(bounds.min, min(bounds.max, kbps)))

    def encode(self, frame: Frame, *, key: bool = False) -> Encoded | None:
        began = time.perf_counter()
        picture, kinds = frame.picture, self._av.video.frame.PictureType
        # A camera's own key pictures are none of ours.
        picture.pict_type = kinds.I if key else kinds.NONE
        if frame.monotonic - self._last > _PAUSE_S:
            self._context = None
        self._last = frame.monotonic
        self._adapt(frame.monotonic)
        # An encoder takes no time twice.
        self._pts = max(self._pts + 1, picture.pts or 0)
        picture.pts = self._pts
        try:
            packets = self._context.encode(picture)
        except self._av.error.FFmpegError as error:
            self._context = None
            raise VideoError(f"{self._config.codec}: {error}") from error
        if not packets:
            self.left_out += 1
            return None
        self.encoded += 1
        encode_ms = (time.perf_counter() - began) * 1000
        return Encoded(frame, b"".join(map(bytes, packets)), bool(packets[0].is_keyframe), encode_ms)

    def report(self) -> Mapping[str, Any]:
        return {
            "encoded": self.encoded,
            "left_out": self.left_out,
            "renewed": self.renewed,
            "kbps": self._aim,
        }

    def close(self) -> None:
        self._context = None

    def _adapt(self, now: float) -> None:
        aim, lower = self._aim, self._aim < self._kbps
        if self._context is not None and self._config.codec == H264:
            # Lower needs no new context, unless it is much lower.
            self._context.bit_rate = min(aim, self._kbps) * 1000
            lower = aim < self._kbps * _MUCH_LESS
            if aim <= self._kbps and not lower:
                return
        patience_s = _LOWER_S if lower else _HIGHER_S
        much = abs(aim - self._kbps) > self._kbps * _CHANGE
        if self._context is None or (much and now - self._opened >= patience_s):
            self.renewed += self._context is not None
            self._kbps, self._opened = aim, now
            self._context = self._open()

    def _open(self) -> Any:
        config, bits = self._config, self._kbps * 1000
        try:
            context = self._av.CodecContext.create(LIBRARIES[config.codec], "w")
        except (ValueError, self._av.error.FFmpegError) as error:
            name = LIBRARIES[config.codec]
            raise VideoError(f"this PyAV has no {name}: choose another codec in car.yaml") from error
        context.width, context.height, context.pix_fmt = config.width, config.height, "yuv420p"
        context.time_base = Fraction(1, RTP_HZ)
        context.framerate = Fraction(config.rate_hz).limit_denominator(1000)
        context.bit_rate, context.gop_size = bits, _NEVER
        # Half of the processors are for the rest of the robot.
        context.thread_count = max(1, min(_MOST_THREADS, (os.cpu_count() or 1) // 2))
        context.options = options(config.codec, bits)
        return context


def options(codec: str, bits: int) -> dict[str, str]:
    """The settings of libvpx or libx264 for so many bits a second, by ffmpeg's names."""
    return _vp8(bits) if codec == VP8 else _h264(bits)


def _vp8(bits: int) -> dict[str, str]:
    return {
        "deadline": "realtime",
        "cpu-used": "8",
        "lag-in-frames": "0",
        "minrate": str(bits),
        "maxrate": str(bits),
        # A second.
        "bufsize": str(bits),
        "rc_init_occupancy": str(bits // 2),
        "undershoot-pct": "100",
        "overshoot-pct": "15",
        # A key picture may have the bits of two.
        "max-intra-rate": "200",
        "static-thresh": "1",
        "qmin": "4",
        "qmax": "56",
        # Fewer pictures, not later ones.
        "drop-threshold": "30",
    }


def _h264(bits: int) -> dict[str, str]:
    return {
        "preset": "ultrafast",
        # No B-pictures, and no picture waits for the next.
        "tune": "zerolatency",
        "profile": "baseline",
        "level": "31",
        "maxrate": str(bits),
        # A quarter of a second: the largest key picture.
        "bufsize": str(bits // 4),
        "forced-idr": "1",
    }


def make_encoder(config: VideoConfig) -> Encoder:
    """The encoder of a configuration. Raises `VideoError` without PyAV, or without GStreamer."""
    if config.codec == GSTREAMER:
        return GstreamerEncoder(config)
    return PyavEncoder(config)
