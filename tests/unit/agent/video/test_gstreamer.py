"""An encoder that is a pipeline of GStreamer, in a process of its own."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path
from typing import Any, Iterator

import pytest

from iort_agent.errors import VideoError
from iort_agent.video import gstreamer as module
from iort_agent.video.config import GSTREAMER, BitrateConfig, SimCamera, VideoConfig
from iort_agent.video.encoder import make_encoder
from iort_agent.video.gstreamer import PROGRAM, GstreamerEncoder
from testkit.video import counter_of, decoded
from testkit.waiting import GUARD_S, until
from tests.unit.agent.video.test_encoder import driving

X264 = "x264enc tune=zerolatency speed-preset=ultrafast bitrate={kbps} key-int-max=1000"


def _has_elements() -> bool:
    inspect = shutil.which("gst-inspect-1.0")
    return inspect is not None and all(
        subprocess.run([inspect, "--exists", element], check=False).returncode == 0
        for element in ("x264enc", "h264parse", "rawvideoparse", "gdppay")
    )


needs_gstreamer = pytest.mark.skipif(
    not _has_elements(), reason="gstreamer1.0-tools, -plugins-base, -plugins-bad or -plugins-ugly is missing"
)


def config(pipeline: str = X264, size: tuple[int, int] = (640, 480)) -> VideoConfig:
    return VideoConfig(
        SimCamera(),
        *size,
        codec=GSTREAMER,
        pipeline=pipeline,
        bitrate_kbps=BitrateConfig(200, 2000),
    )


@pytest.fixture
def encoders(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[GstreamerEncoder]]:
    # A busy machine may leave a process no time.
    for name in ("_BEGIN_S", "_PICTURE_S"):
        monkeypatch.setattr(module, name, GUARD_S)
    made: list[GstreamerEncoder] = []
    yield made
    for encoder in made:
        encoder.close()


def made(encoders: list[GstreamerEncoder], pipeline: str = X264) -> GstreamerEncoder:
    encoder = make_encoder(config(pipeline))
    assert isinstance(encoder, GstreamerEncoder)
    encoders.append(encoder)
    return encoder


@needs_gstreamer
def test_each_picture_comes_out_at_once_and_can_be_decoded(encoders: list[GstreamerEncoder]) -> None:
    encoder = made(encoders)
    encoded = [encoder.encode(frame) for frame in driving(20)]
    assert [one.frame.number for one in encoded if one is not None] == list(range(1, 21))
    assert [one.key for one in encoded if one is not None] == [True] + [False] * 19
    pictures = decoded(GSTREAMER, [one.data for one in encoded if one is not None])
    assert [counter_of(picture) for picture in pictures] == list(range(1, 21))
    assert encoder.report() == {"encoded": 20, "processes": 1, "kbps": 2000}


@needs_gstreamer
def test_a_key_picture_that_the_pipeline_does_not_make_is_had_by_another_process(
    encoders: list[GstreamerEncoder],
) -> None:
    encoder = made(encoders)
    keys = [
        one.frame.number
        for one in (encoder.encode(f, key=f.number in {10, 40}) for f in driving(45))
        if one and one.key
    ]
    assert keys == [1, 40], "the first one was a moment ago"
    assert encoder.report()["processes"] == 2


@needs_gstreamer
def test_another_bitrate_is_had_by_another_process_not_too_often(encoders: list[GstreamerEncoder]) -> None:
    encoder = made(encoders)
    commands = []
    for frame in driving(200):
        encoder.encode(frame)
        encoder.set_bitrate(500 if frame.number < 100 else 1)
        assert isinstance(encoder._process, subprocess.Popen)
        arguments: Any = encoder._process.args
        commands.append(next(one for one in arguments if one.startswith("bitrate=")))
    assert list(dict.fromkeys(commands)) == ["bitrate=2000", "bitrate=500", "bitrate=200"]
    assert commands.index("bitrate=500") >= 75, "after five seconds"
    assert encoder.report()["processes"] == 3


@needs_gstreamer
@pytest.mark.parametrize(
    ("pipeline", "said"),
    [
        ("nosuchelement", "no element"),
        ("x264enc tune=zerolatency no-such-setting=1", "no-such-setting"),
        ("x264enc rc-lookahead=60", "its encoder must give each at once"),
        ("fakesink", "failed"),
    ],
)
def test_a_pipeline_that_cannot_work_is_an_error_that_quotes_it(
    encoders: list[GstreamerEncoder], pipeline: str, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if "lookahead" in pipeline:
        monkeypatch.setattr(module, "_BEGIN_S", 3.0)
    encoder = made(encoders, pipeline)
    with pytest.raises(VideoError, match=said) as raised:
        encoder.encode(next(driving(1)))
    assert repr(pipeline) in str(raised.value)
    assert encoder._process is None


@needs_gstreamer
def test_a_process_that_dies_is_an_error_and_the_next_picture_begins_anew(
    encoders: list[GstreamerEncoder],
) -> None:
    encoder = made(encoders)
    frames = list(driving(4))
    encoder.encode(frames[0])
    assert encoder._process is not None
    encoder._process.kill()
    encoder._process.wait()
    with pytest.raises(VideoError, match=r"the pipeline .* failed"):
        encoder.encode(frames[1])
    one = encoder.encode(frames[2])
    assert one is not None
    assert one.key


@needs_gstreamer
def test_its_process_ends_with_it(encoders: list[GstreamerEncoder]) -> None:
    encoder = made(encoders)
    encoder.encode(next(driving(1)))
    assert encoder._process is not None
    group = os.getpgid(encoder._process.pid)
    assert group == encoder._process.pid, "a group of its own"
    encoder.close()
    until(lambda: not Path(f"/proc/{group}").exists())
    encoder.close()


def test_without_gstreamer_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(VideoError, match=f"needs {PROGRAM}: apt install gstreamer1.0-tools"):
        make_encoder(config())


@pytest.mark.parametrize("content", [b"\xff" * 100, b"not GStreamer's data protocol, by far" * 3])
def test_output_of_something_else_is_an_error(content: bytes) -> None:
    encoder = GstreamerEncoder.__new__(GstreamerEncoder)
    encoder._buffer = bytearray(content)
    with pytest.raises(VideoError, match="is not GStreamer's data protocol"):
        encoder._unit()
