"""The section `video`: its settings and its errors; and the capture times of pictures."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import yaml

from iort_agent.config import Config, load_config
from iort_agent.errors import ConfigError, VideoError
from iort_agent.video import KEPT_S, Frame, Pictures, require
from iort_agent.video.config import TurnConfig, V4l2Camera, VideoConfig
from iort_contract.messages.video import IceServer, VideoTerms, check_terms

SIM: dict[str, Any] = {"type": "sim"}
ROS1 = {"type": "ros1", "topics": {"/imu": {"time": "arrival"}}}
ROS2 = {"type": "ros2", "topics": {"/imu": {"time": "arrival"}}}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("cert.pem", "key.pem", "turn.password"):
        (tmp_path / name).write_text("secret\n")
    return tmp_path


def load(folder: Path, video: Any = None, *sources: dict[str, Any]) -> Config:
    file = folder / "car.yaml"
    content: dict[str, Any] = {
        "robot": "car1",
        "endpoint": "localhost",
        "certificate": "cert.pem",
        "private_key": "key.pem",
        "sources": list(sources or [SIM]),
    }
    if video is not None:
        content["video"] = video
    file.write_text(yaml.safe_dump(content))
    return load_config(file)


def test_without_the_section_there_is_no_video(folder: Path) -> None:
    assert load(folder).video is None


def test_a_short_section_is_enough(folder: Path) -> None:
    video = load(folder, {"source": SIM}).video
    assert video is not None
    assert (video.source.kind, video.codec, video.pictures_hz, video.turn) == ("sim", "vp8", 4, None)
    assert (video.bitrate_kbps.min, video.bitrate_kbps.max) == (150, 2500)
    assert check_terms(video.terms()) == VideoTerms(640, 480, 15.0, 500)


def test_every_setting_is_read(folder: Path) -> None:
    video = load(
        folder,
        {
            "source": {"type": "v4l2", "device": "/dev/video2", "input_format": "mjpeg"},
            "width": 320,
            "height": 240,
            "rate_hz": 30,
            "bitrate_kbps": {"min": 100, "max": 900},
            "codec": "gstreamer",
            "pipeline": "x264enc",
            "max_age_ms": 300,
            "pictures_hz": 2,
            "turn": {
                "url": "turn:turn.example:3478",
                "username": "car",
                "credential_file": "turn.password",
            },
        },
    ).video
    assert video is not None
    assert (video.source.kind, video.pipeline, video.bitrate_kbps.max) == ("v4l2", "x264enc", 900)
    assert video.terms() == VideoTerms(320, 240, 30.0, 300)
    assert video.turn is not None
    assert video.turn.server() == IceServer(("turn:turn.example:3478",), "car", "secret")


@pytest.mark.parametrize("source", [ROS1, ROS2])
def test_a_topic_is_heard_by_the_node_of_the_sources(folder: Path, source: dict[str, Any]) -> None:
    video = load(folder, {"source": {"type": "topic", "topic": "/camera/image"}}, source).video
    assert video is not None
    assert video.source.kind == "topic"


@pytest.mark.parametrize(
    ("video", "sources", "said"),
    [
        ({}, [SIM], "video.source: required, and missing"),
        ({"source": {"type": "usb"}}, [SIM], "video.source.type: must be one of topic, v4l2, sim"),
        ({"source": {"type": "topic", "topic": "/image"}}, [SIM], "add one to sources"),
        ({"source": {"type": "topic", "topic": "image"}}, [ROS1], "must be a full name"),
        ({"source": SIM}, [ROS1], "needs a simulated car: a source of the type sim"),
        ({"source": SIM, "width": 641}, [SIM], "video.width: must be an even number of pixels, got 641"),
        ({"source": SIM, "height": 20}, [SIM], "video.height: must be a whole number from 64 to 1920"),
        ({"source": SIM, "rate_hz": 0}, [SIM], "video.rate_hz: must be a number from 1 to 60 (Hz)"),
        (
            {"source": SIM, "bitrate_kbps": {"min": 900, "max": 500}},
            [SIM],
            "video.bitrate_kbps.min: must be at most max, which is 500, got 900",
        ),
        ({"source": SIM, "codec": "gstreamer"}, [SIM], "video.pipeline: required with codec: gstreamer"),
        ({"source": SIM, "pipeline": "x264enc"}, [SIM], "video.pipeline: needs codec: gstreamer, got vp8"),
        ({"source": SIM, "turn": {"url": "http://x"}}, [SIM], "video.turn.url: must begin with stun:"),
        *(
            ({"source": SIM, "turn": {"url": url}}, [SIM], "such as turn:turn.example.com:3478")
            for url in (
                "turn:",
                "stun:x?transport=udp",
                "turn:x:y",
                "turns:[::1]:443",
                "turn:x?transport=tls",
            )
        ),
        ({"source": SIM, "turn": {"url": "turn:x"}}, [SIM], "video.turn.username: required for a TURN"),
        (
            {"source": SIM, "turn": {"url": "turn:x", "username": "a", "credential_file": "none"}},
            [SIM],
            "video.turn.credential_file: must be the path of a file that exists",
        ),
    ],
)
def test_a_mistake_is_named_with_what_is_allowed(
    folder: Path, video: Any, sources: list[dict[str, Any]], said: str
) -> None:
    with pytest.raises(ConfigError) as raised:
        load(folder, video, *sources)
    assert said in str(raised.value)


def test_a_server_of_stun_needs_no_password() -> None:
    assert TurnConfig("stun:stun.example:3478").server() == IceServer(("stun:stun.example:3478",))


def test_a_password_that_is_gone_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(VideoError, match=r"turn\.password"):
        TurnConfig("turn:x", "a", tmp_path / "turn.password").server()


def test_the_check_tells_who_may_read_the_password(folder: Path) -> None:
    video = load(
        folder,
        {"source": SIM, "turn": {"url": "turn:x", "username": "a", "credential_file": "turn.password"}},
    ).video
    assert isinstance(video, VideoConfig)
    (folder / "turn.password").chmod(0o644)
    assert [finding.level for finding in video.check()] == ["ok", "warn"]
    (folder / "turn.password").chmod(0o600)
    assert [finding.level for finding in video.check()] == ["ok"]


@pytest.mark.parametrize("there", [True, False])
def test_the_check_tells_of_a_camera_that_is_not_there(tmp_path: Path, there: bool) -> None:
    device = tmp_path / "video9"
    if there:
        device.touch()
    findings = [*VideoConfig(V4l2Camera(str(device))).check()]
    assert [finding.level for finding in findings] == (["ok"] if there else ["ok", "fail"])
    assert there or "video9 is not there" in findings[-1].text


def test_a_package_that_is_missing_is_named_with_its_cure() -> None:
    with pytest.raises(VideoError, match=r"needs the package iort_none: pip install 'iort-agent\[video\]'"):
        require("iort_none")


def frame(number: int, monotonic: float) -> Frame:
    return Frame(number, 0, monotonic, None)  # type: ignore[arg-type]  # nobody looks at the picture


def test_the_age_of_a_picture_is_from_its_capture() -> None:
    pictures = Pictures()
    assert pictures.age_ms(1, 100.0) is None, "never captured"
    pictures.add(frame(1, 100.0))
    pictures.add(frame(2, 100.5))
    assert pictures.age_ms(1, 101.0) == 1000.0
    assert pictures.age_ms(2, 101.0) == 500.0
    assert pictures.age_ms(3, 101.0) is None, "not captured yet"
    assert pictures.age_ms(0, 101.0) is None


def test_a_picture_before_those_that_are_kept_is_of_any_age() -> None:
    pictures = Pictures()
    for number in range(1, 100):
        pictures.add(frame(number, number * 1.0))
    assert pictures.age_ms(99, 99.0) == 0
    assert pictures.age_ms(99 - int(KEPT_S), 99.0) == KEPT_S * 1000
    assert pictures.age_ms(50, 99.0) == math.inf
