"""The encoder of all viewers: nothing waits in it, keys come when asked for, and the bitrate follows."""

from __future__ import annotations

import threading
from typing import Callable, Iterator
from unittest.mock import Mock

import pytest
from av import VideoFrame
from av.error import InvalidDataError
from av.video.frame import PictureType

from iort_agent.errors import VideoError
from iort_agent.video import RTP_HZ, Encoded, Frame
from iort_agent.video.config import H264, VP8, BitrateConfig, SimCamera, VideoConfig
from iort_agent.video.encoder import MIMES, PyavEncoder, make_encoder
from iort_agent.video.pictures import packed
from testkit.video import decoded
from tests.unit.agent.video.test_pictures import noise
from tests.unit.agent.video.test_sim_camera import NOW_US, hall, pose

CODECS = pytest.mark.parametrize("codec", [VP8, H264])


def config(codec: str, *, least: int = 150, most: int = 2500, rate_hz: float = 15) -> VideoConfig:
    return VideoConfig(SimCamera(), codec=codec, rate_hz=rate_hz, bitrate_kbps=BitrateConfig(least, most))


@pytest.fixture(scope="module")
def noises() -> list[VideoFrame]:
    """Pictures that need every bit: noise that moves."""
    content = packed(noise())
    made = []
    for shift in range(0, 640, 32):
        picture = VideoFrame(640, 480, "yuv420p")
        at = 0
        for plane in picture.planes:
            size = plane.width * plane.height
            part = content[at : at + size]
            at += size
            # A third of the noise, so that pictures resemble each other.
            even = bytes(100 + value // 3 for value in part[shift:] + part[:shift])
            plane.update(even)
        made.append(picture)
    return made


def numbered(pictures: Callable[[int], VideoFrame], count: int, start: int = 0) -> Iterator[Frame]:
    for i in range(start, start + count):
        picture = pictures(i)
        picture.pts = i * RTP_HZ // 15
        yield Frame(i + 1, 0, i / 15, picture)


def driving(count: int, start: int = 0) -> Iterator[Frame]:
    one = hall()
    return numbered(lambda i: one.draw(pose(i * 4 % 480), i + 1, NOW_US), count, start)


def kbps(encoded: list[Encoded | None], seconds: float) -> float:
    return sum(len(one.data) for one in encoded if one is not None) * 8 / 1000 / seconds


@CODECS
def test_each_picture_comes_out_at_once_and_can_be_decoded(codec: str) -> None:
    encoder = make_encoder(config(codec))
    frames = list(driving(30))
    encoded = [encoder.encode(frame) for frame in frames]
    assert [one.frame for one in encoded if one is not None] == frames, "one for one"
    whole = [one for one in encoded if one is not None]
    assert [one.key for one in whole] == [True] + [False] * 29
    pictures = decoded(codec, [one.data for one in whole])
    assert len(pictures) == 30
    for frame, picture in zip(frames, pictures):
        # Away from edges, which any encoder blurs.
        off = [abs(a - b) for a, b in zip(packed(frame.picture)[::997], packed(picture)[::997])]
        assert sum(off) / len(off) < 4
    assert encoder.report()["encoded"] == 30


@CODECS
def test_a_viewer_can_begin_with_a_key_picture_and_only_with_that(codec: str) -> None:
    encoder = make_encoder(config(codec))
    encoded = [encoder.encode(frame, key=frame.number == 11) for frame in driving(20)]
    keys = [one.frame.number for one in encoded if one is not None and one.key]
    assert keys == [1, 11]
    later = [one.data for one in encoded[10:] if one is not None]
    assert len(decoded(codec, later)) == 10


@CODECS
def test_key_pictures_of_a_camera_are_none_of_the_encoders(codec: str) -> None:
    encoder = make_encoder(config(codec))
    keys = []
    for frame in driving(5):
        frame.picture.pict_type = PictureType.I
        one = encoder.encode(frame)
        assert one is not None
        keys.append(one.key)
    assert keys == [True, False, False, False, False]


@CODECS
def test_no_key_picture_comes_by_itself(codec: str) -> None:
    encoder = make_encoder(config(codec, rate_hz=60))
    still = hall(640, 480).draw(pose(0), 1, NOW_US)
    frames = numbered(lambda _: still, 400)
    assert sum(one.key for one in map(encoder.encode, frames) if one is not None) == 1


@CODECS
def test_the_bitrate_is_what_is_asked_for_within_the_bounds(codec: str, noises: list[VideoFrame]) -> None:
    encoder = make_encoder(config(codec, least=300, most=1500))

    def second(at: int) -> list[Encoded | None]:
        return [encoder.encode(frame) for frame in numbered(lambda i: noises[i % 20], 15, at * 15)]

    def settled(at: int) -> float:
        second(at), second(at + 1), second(at + 2)
        return kbps(second(at + 3) + second(at + 4), 2)

    assert settled(0) == pytest.approx(1500, rel=0.25), "it begins with the most"
    encoder.set_bitrate(600)
    assert settled(10) == pytest.approx(600, rel=0.25)
    encoder.set_bitrate(10)
    assert settled(20) == pytest.approx(300, rel=0.25), "the least"
    encoder.set_bitrate(1e9)
    second(30)
    assert settled(40) == pytest.approx(1500, rel=0.25), "the most"


@CODECS
def test_a_worse_network_is_believed_within_a_second_and_a_better_one_later(codec: str) -> None:
    encoder, at = make_encoder(config(codec)), 0

    def began(seconds: float) -> list[int]:
        """The numbers of the key pictures in this time, after which the bitrate is another."""
        nonlocal at
        frames = driving(round(seconds * 15), at)
        at += round(seconds * 15)
        return [one.frame.number for one in map(encoder.encode, frames) if one is not None and one.key]

    assert began(5) == [1]
    encoder.set_bitrate(2400)
    assert began(5) == [], "a change that is not worth a key picture"
    encoder.set_bitrate(500)
    assert began(1) == [151], "at once"
    encoder.set_bitrate(150)
    # H.264 lowers the bitrate without one.
    assert began(1) == ([166] if codec == VP8 else [])
    encoder.set_bitrate(1000)
    (number,) = began(6)
    assert number >= 151 + 4 * 15, "not before four seconds have passed"
    for kilobits in range(1000, 200, -20):
        encoder.set_bitrate(kilobits)
        began(1 / 15)
    assert encoder.report()["renewed"] <= 6, "each key picture costs"


def test_what_does_not_fit_is_left_out_so_that_nothing_is_late(noises: list[VideoFrame]) -> None:
    encoder = make_encoder(config(VP8, least=100, most=100))
    encoded = [encoder.encode(frame) for frame in numbered(lambda i: noises[i % 20], 150)]
    left_out = sum(one is None for one in encoded)
    assert left_out > 30
    assert encoder.report()["left_out"] == left_out
    assert kbps(encoded, 10) < 150
    shown = [one.data for one in encoded if one is not None]
    assert len(decoded(VP8, shown)) == len(shown), "the others do not need them"


@CODECS
def test_times_that_do_not_rise_are_made_to(codec: str) -> None:
    encoder, times = make_encoder(config(codec)), []
    for frame in driving(5):
        frame.picture.pts = 1000 - frame.number
        one = encoder.encode(frame)
        assert one is not None
        times.append(one.frame.picture.pts)
    assert times == [999, 1000, 1001, 1002, 1003]


@CODECS
def test_it_takes_half_of_the_processors_at_most(codec: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for processors, threads in ((1, 1), (2, 1), (4, 2), (64, 4)):
        monkeypatch.setattr("os.cpu_count", lambda processors=processors: processors)
        encoder = make_encoder(config(codec))
        assert isinstance(encoder, PyavEncoder)
        before = set(threading.enumerate())
        encoder.encode(next(driving(1)))
        assert encoder._context.thread_count == threads
        # One of an earlier test may end meanwhile.
        assert set(threading.enumerate()) <= before


@CODECS
def test_after_an_error_the_next_picture_is_a_key_picture(codec: str) -> None:
    encoder = make_encoder(config(codec))
    assert isinstance(encoder, PyavEncoder)
    frames = list(driving(3))
    assert encoder.encode(frames[0]) is not None
    encoder._context = Mock()
    encoder._context.encode.side_effect = InvalidDataError(1, "no memory")
    with pytest.raises(VideoError, match=f"^{codec}: .*no memory"):
        encoder.encode(frames[1])
    one = encoder.encode(frames[2])
    assert one is not None
    assert one.key


@CODECS
def test_after_a_pause_the_next_picture_is_a_key_picture(codec: str) -> None:
    encoder = make_encoder(config(codec))
    keys = [one.key for one in map(encoder.encode, [*driving(3), *driving(3, 60)]) if one is not None]
    assert keys == [True, False, False] * 2


def test_each_codec_has_its_name_in_webrtc() -> None:
    assert MIMES == {"vp8": "video/VP8", "h264": "video/H264", "gstreamer": "video/H264"}
