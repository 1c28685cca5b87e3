"""Pictures in another size, their bytes, and JPEG within a number of bytes."""

from __future__ import annotations

import io
import random

import pytest
from av import VideoFrame
from PIL import Image

from iort_agent.errors import VideoError
from iort_agent.video.pictures import fitted, from_planes, jpeg, packed


def gradient(width: int, height: int) -> VideoFrame:
    """A picture whose brightness goes from left to right; its colours are grey."""
    rows = bytes(16 + 219 * x // width for x in range(width)) * height
    grey = Image.new("L", ((width + 1) // 2, (height + 1) // 2), 128)
    return from_planes(width, height, Image.frombytes("L", (width, height), rows), grey, grey)


def noise(width: int = 640, height: int = 480) -> VideoFrame:
    """What compresses worst."""
    chance = random.Random(1)
    planes = [
        Image.frombytes("L", size, bytes(chance.getrandbits(8) for _ in range(size[0] * size[1])))
        for size in ((width, height), (width // 2, height // 2), (width // 2, height // 2))
    ]
    return from_planes(width, height, *planes)


@pytest.mark.parametrize("size", [(640, 480), (66, 70), (64, 64), (482, 270)])
def test_the_bytes_of_a_picture_are_without_gaps(size: tuple[int, int]) -> None:
    width, height = size
    content = packed(gradient(width, height))
    assert len(content) == width * height * 3 // 2
    assert content[:width] == bytes(16 + 219 * x // width for x in range(width))
    assert content[: width * height] == content[:width] * height
    assert set(content[width * height :]) == {128}


@pytest.mark.parametrize(
    ("source", "inner"),
    [
        ((640, 480), (0, 0, 320, 240)),
        ((1280, 480), (0, 60, 320, 120)),
        ((480, 480), (40, 0, 240, 240)),
        ((100, 1000), (148, 0, 24, 240)),
        ((64, 48), (0, 0, 320, 240)),
    ],
)
def test_a_picture_keeps_its_shape(source: tuple[int, int], inner: tuple[int, int, int, int]) -> None:
    left, top, wide, high = inner
    content = packed(fitted(gradient(*source), 320, 240))
    assert len(content) == 320 * 240 * 3 // 2
    row = content[120 * 320 : 121 * 320]
    assert set(row[: max(0, left - 2)] + row[left + wide + 2 :]) <= {16}, "bars at the sides"
    bars = content[: top * 320] + content[(top + high) * 320 : 240 * 320]
    assert set(bars) <= {16}, "bars above and below"
    assert len(set(row[left : left + wide])) > 10, "the picture between them"
    assert row[left + wide // 2] == pytest.approx(125, abs=6)


def test_a_picture_of_full_range_becomes_one_of_studio_range() -> None:
    full = VideoFrame(64, 64, "yuvj420p")
    for plane, level in zip(full.planes, (255, 128, 128)):
        plane.update(bytes([level]) * plane.buffer_size)
    assert fitted(full, 64, 64).planes[0].buffer_size
    assert packed(fitted(full, 64, 64))[0] == pytest.approx(235, abs=1)


def opened(content: bytes) -> Image.Image:
    image = Image.open(io.BytesIO(content))
    image.load()
    assert image.format == "JPEG"
    return image


def test_a_jpeg_shows_the_picture() -> None:
    image = opened(jpeg(gradient(640, 480)))
    assert image.size == (640, 480)
    light = [image.convert("L").getpixel((x, 240)) for x in (10, 320, 630)]
    assert light == pytest.approx([4, 127, 251], abs=6)
    assert opened(jpeg(gradient(640, 480), width=320)).size == (320, 240)
    assert opened(jpeg(gradient(640, 480), width=2000)).size == (640, 480), "never larger"


def test_less_quality_has_fewer_bytes() -> None:
    picture = noise()
    assert len(jpeg(picture, quality=30)) < len(jpeg(picture, quality=60)) < len(jpeg(picture, quality=90))


@pytest.mark.parametrize("most", [100_000, 30_000, 5_000, 3_000])
def test_a_jpeg_keeps_within_its_bytes(most: int) -> None:
    content = jpeg(noise(), quality=90, most_bytes=most)
    assert len(content) <= most
    assert opened(content).width >= 64
    assert len(content) > most // 4, "and is not smaller than it must be"


def test_bytes_for_which_there_is_no_picture_are_refused() -> None:
    with pytest.raises(VideoError, match="more than 500"):
        jpeg(noise(), most_bytes=500)
