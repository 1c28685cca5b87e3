"""The section on the processor for video: the agent's cameras, and floors that encode the same pictures."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import av
import pytest

from bench.sections import video
from iort_agent.video import RTP_HZ, Frame
from iort_agent.video.config import H264, VP8, BitrateConfig, SimCamera, VideoConfig
from iort_agent.video.encoder import make_encoder
from iort_agent.video.pictures import packed
from testkit.video import counter_of, decoded
from testkit.waiting import InstrumentError

COUNT = 12


@pytest.fixture(scope="module")
def raw(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path, camera = tmp_path_factory.mktemp("video") / "pictures.yuv", video.hall()
    path.write_bytes(b"".join(packed(camera.picture(i)) for i in range(COUNT)))
    return path


def ours(codec: str) -> list[bytes]:
    config = VideoConfig(SimCamera(), codec=codec, bitrate_kbps=BitrateConfig(video.KBPS, video.KBPS))
    encoder, camera, made = make_encoder(config), video.hall(), []
    for i in range(COUNT):
        picture = camera.picture(i)
        picture.pts = i * RTP_HZ // 15
        encoded = encoder.encode(Frame(i + 1, 0, i / 15, picture))
        assert encoded is not None
        made.append(encoded.data)
    return made


def test_its_cameras_give_what_the_agent_encodes() -> None:
    hall, topic = video.hall(), video.topic(3)
    assert [counter_of(hall.picture(i)) for i in range(3)] == [1, 2, 3]
    pictures = [topic.picture(i) for i in range(3)]
    assert {(one.width, one.height, one.format.name) for one in pictures} == {(640, 480, "yuv420p")}
    assert len({packed(one) for one in pictures}) == 3


@pytest.mark.parametrize("codec", [VP8, H264])
def test_the_floor_of_ffmpeg_encodes_the_same_pictures_as_well(codec: str, raw: Path, tmp_path: Path) -> None:
    program = shutil.which("ffmpeg")
    if program is None:
        pytest.skip("ffmpeg is missing")
    command = video._ffmpeg(program, codec, 15)(raw, COUNT)
    assert command[-3:] == ["-f", "null", "-"]
    out = tmp_path / "out.mkv"
    subprocess.run([*command[:-3], str(out)], check=True)
    with av.open(str(out)) as container:
        floor = [bytes(packet) for packet in container.demux(video=0) if packet.size]
    assert len(floor) == COUNT
    mine = ours(codec)
    assert sum(map(len, floor)) == pytest.approx(sum(map(len, mine)), rel=0.2)
    if codec == VP8:
        # H.264's parameters are in the file's head.
        assert [counter_of(one) for one in decoded(codec, floor)] == list(range(1, COUNT + 1))


@pytest.mark.parametrize("codec", [VP8, H264])
def test_each_command_of_a_floor_takes_processor_time(codec: str, raw: Path) -> None:
    assert video._child_s(video._pyav(codec, 15)(raw, COUNT)) > 0


def test_a_floor_that_fails_is_an_error_that_quotes_it(raw: Path) -> None:
    with pytest.raises(InstrumentError, match="nosuchcodec"):
        video._child_s(video._pyav("nosuchcodec", 15)(raw, COUNT))
