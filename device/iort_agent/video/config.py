"""The section `video` of car.yaml."""

from __future__ import annotations

import os
import re
import stat
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Iterator, Mapping

from iort_agent.common.schema import (
    FILE,
    Place,
    Rule,
    choice,
    load,
    number,
    section,
    setting,
    text,
    variant,
)
from iort_agent.errors import VideoError
from iort_agent.sources import FAIL, OK, WARN, Finding
from iort_agent.sources.ros import ros_name
from iort_agent.video import require
from iort_contract.limits import ContractError
from iort_contract.messages.video import PICTURE_MAX_AGE_MS, IceServer, VideoTerms

TOPIC, V4L2, SIM = "topic", "v4l2", "sim"
VP8, H264, GSTREAMER = "vp8", "h264", "gstreamer"


@dataclass(frozen=True)
class TopicCamera:
    """A ROS topic of `sensor_msgs/Image` or `sensor_msgs/CompressedImage`, heard by the node of the sources.
    A picture's capture time is its header's stamp, unless that is more than five seconds from now."""

    kind: ClassVar[str] = TOPIC
    topic: str = setting(text(ros_name))


@dataclass(frozen=True)
class V4l2Camera:
    """A camera of this machine. ``input_format`` is asked of it, as ``v4l2-ctl --list-formats`` names it in
    ffmpeg's words, for example ``mjpeg`` or ``yuyv422``."""

    kind: ClassVar[str] = V4L2
    device: str = setting(text(), "/dev/video0")
    input_format: str | None = setting(text(), None)


@dataclass(frozen=True)
class SimCamera:
    """The camera of the simulated car. Each picture bears its number, for people and for programs."""

    kind: ClassVar[str] = SIM


CAMERAS: Mapping[str, type[Any]] = {one.kind: one for one in (TopicCamera, V4l2Camera, SimCamera)}


@dataclass(frozen=True)
class BitrateConfig:
    """The bounds of the bitrate, which follows the slowest viewer's network."""

    min: int = setting(number(50, 50_000, whole=True, unit="kbit/s"), 150)
    max: int = setting(number(50, 50_000, whole=True, unit="kbit/s"), 2500)


def _turn_url(value: str) -> str:
    if not re.fullmatch(r"(stun|(turns?)):[^\s:?]+(:[1-9][0-9]{0,4})?(?(2)(\?transport=(udp|tcp))?)", value):
        raise ContractError(
            f"must begin with stun:, turn: or turns:, such as turn:turn.example.com:3478, got {value!r}"
        )
    return value


@dataclass(frozen=True)
class TurnConfig:
    """A STUN or TURN server of your own, for robot and viewers. The password is in ``credential_file``,
    because car.yaml is not private; viewers that may look at this robot are told it."""

    url: str = setting(text(_turn_url))
    username: str | None = setting(text(), None)
    credential_file: Path | None = setting(FILE, None)

    def server(self) -> IceServer:
        """The server with its password. Raises `VideoError` if the file cannot be read."""
        credential = ""
        if self.credential_file is not None:
            try:
                credential = self.credential_file.read_text(encoding="utf-8").strip()
            except (OSError, UnicodeDecodeError) as error:
                raise VideoError(f"{self.credential_file}: {error}") from error
        return IceServer((self.url,), self.username or "", credential)


def _even(low: int, high: int) -> Rule:
    rule = number(low, high, whole=True, unit="pixels")

    def even(value: Any, place: Place) -> int:
        size = int(rule(value, place))
        if size % 2:
            raise place.error(value, "an even number of pixels")
        return size

    return even


@dataclass(frozen=True)
class VideoConfig:
    """Video for driving by sight; without this section there is none. It needs
    `pip install 'iort-agent[video]'`. Nothing is captured unless somebody looks.

    A picture of another shape keeps its shape, between black bars. ``rate_hz`` is the highest rate.
    A motion command whose driver saw a picture older than ``max_age_ms`` is refused. Viewers without WebRTC
    get ``pictures_hz`` small pictures a second over the broker. ``codec: gstreamer`` encodes by ``pipeline``,
    GStreamer elements that take raw I420 and give H.264 at once, for example `nvvidconv ! nvv4l2h264enc` on a
    Jetson (not tried on one); ``{kbps}``, ``{bps}`` and ``{rate}`` in it become the bitrate in kbit/s or
    bit/s, and the pictures a second.
    """

    source: TopicCamera | V4l2Camera | SimCamera = setting(variant("type", CAMERAS))
    width: int = setting(_even(64, 1920), 640)
    height: int = setting(_even(64, 1920), 480)
    rate_hz: float = setting(number(1, 60, unit="Hz"), 15.0)
    bitrate_kbps: BitrateConfig = setting(section(BitrateConfig), BitrateConfig())
    codec: str = setting(choice(VP8, H264, GSTREAMER), VP8)
    pipeline: str | None = setting(text(), None)
    max_age_ms: int = setting(number(100, 10_000, whole=True, unit="ms"), PICTURE_MAX_AGE_MS)
    pictures_hz: float = setting(number(1, 5, unit="Hz"), 4.0)
    turn: TurnConfig | None = setting(section(TurnConfig), None)

    def terms(self) -> VideoTerms:
        """What the robot can show."""
        return VideoTerms(self.width, self.height, self.rate_hz, self.max_age_ms)

    def check(self) -> Iterator[Finding]:
        """The findings of `iort-agent check`."""
        try:
            for name in ("aiortc", "av", "PIL.Image"):
                require(name)
        except VideoError as error:
            yield Finding("video", FAIL, str(error), "install it, or remove the section video")
        else:
            size = f"{self.width}x{self.height} at {self.rate_hz:g} Hz"
            yield Finding("video", OK, f"{self.source.kind}, {size}, {self.codec}")
        if isinstance(self.source, V4l2Camera) and not os.access(self.source.device, os.R_OK | os.W_OK):
            text = f"{self.source.device} is not there, or this user may not read it"
            yield Finding("video.source", FAIL, text, "see `ls -l /dev/video*`; `usermod -aG video USER`")
        if self.turn is not None and self.turn.credential_file is not None:
            mode = stat.S_IMODE(self.turn.credential_file.stat().st_mode)
            if mode & 0o077:
                todo = f"chmod 600 {self.turn.credential_file}"
                yield Finding("video.turn", WARN, "others may read the password", todo)


def video_rule() -> Rule:
    """The rule for the section `video`."""

    def rule(value: Any, place: Place) -> VideoConfig:
        config = load(VideoConfig, value, place)
        if config.bitrate_kbps.min > config.bitrate_kbps.max:
            allowed = f"at most max, which is {config.bitrate_kbps.max}"
            raise place.child("bitrate_kbps.min").error(config.bitrate_kbps.min, allowed)
        if (config.codec == GSTREAMER) != (config.pipeline is not None):
            raise place.child("pipeline").problem(
                "required with codec: gstreamer, and missing"
                if config.pipeline is None
                else f"needs codec: gstreamer, got {config.codec}; remove pipeline, or change codec"
            )
        turn = config.turn
        if turn is not None and not turn.url.startswith("stun:"):
            for name in ("username", "credential_file"):
                if getattr(turn, name) is None:
                    raise place.child(f"turn.{name}").problem("required for a TURN server, and missing")
        return config

    return rule
