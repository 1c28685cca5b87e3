"""Pictures of any format and size as yuv420p of the size that viewers get, and as JPEG."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

from iort_agent.errors import VideoError
from iort_agent.video import require

if TYPE_CHECKING:
    import av

# What encoders take.
FORMAT = "yuv420p"
_BLACK = (16, 128, 128)
_LEAST_QUALITY, _LEAST_WIDTH = 25, 64


def from_planes(width: int, height: int, *planes: Any) -> av.VideoFrame:
    """A picture of three of Pillow's grey images: the brightness, and two of half the size for the
    colours."""
    picture: av.VideoFrame = require("av").VideoFrame(width, height, FORMAT)
    for plane, image in zip(picture.planes, planes):
        plane.update(image.tobytes("raw", "L", plane.line_size))
    return picture


def from_rows(
    pixel_format: str, width: int, height: int, rows: list[tuple[memoryview, int, int]]
) -> av.VideoFrame:
    """A picture of its planes' rows: for each plane the bytes, the bytes from a row to the next, and the
    bytes of a row that are pixels."""
    picture: av.VideoFrame = require("av").VideoFrame(width, height, pixel_format)
    for plane, (content, step, used) in zip(picture.planes, rows):
        target, size = memoryview(plane), plane.line_size
        lines = min(len(content) // step, plane.buffer_size // size)
        if step == size:
            target[: lines * size] = content[: lines * size]
            continue
        for line in range(lines):
            target[line * size : line * size + used] = content[line * step : line * step + used]
    return picture


def packed(picture: av.VideoFrame) -> bytes:
    """The bytes of a picture in yuv420p, without gaps between its rows."""
    parts = []
    for plane in picture.planes:
        content, width, size = memoryview(plane), plane.width, plane.line_size
        if width == size:
            parts.append(content[: width * plane.height])
        else:
            parts += [content[line * size : line * size + width] for line in range(plane.height)]
    return b"".join(parts)


def fitted(picture: av.VideoFrame, width: int, height: int) -> av.VideoFrame:
    """The picture in yuv420p and another size. One of another shape keeps its shape, between black bars."""
    scale = min(width / picture.width, height / picture.height)
    inner_width, inner_height = (
        max(2, round(size * scale / 2) * 2) for size in (picture.width, picture.height)
    )
    inner = picture.reformat(inner_width, inner_height, FORMAT, dst_color_range="MPEG")
    if (inner_width, inner_height) == (width, height):
        return inner
    whole: av.VideoFrame = require("av").VideoFrame(width, height, FORMAT)
    for plane, part, black, half in zip(whole.planes, inner.planes, _BLACK, (1, 2, 2)):
        target, content = memoryview(plane), memoryview(part)
        target[:] = bytes([black]) * plane.buffer_size
        left, top = (width - inner_width) // 2 // half, (height - inner_height) // 2 // half
        used = inner_width // half
        for line in range(inner_height // half):
            at, start = (top + line) * plane.line_size + left, line * part.line_size
            target[at : at + used] = content[start : start + used]
    return whole


def jpeg(
    picture: av.VideoFrame, *, quality: int = 75, width: int | None = None, most_bytes: int | None = None
) -> bytes:
    """The picture as JPEG, at most ``width`` wide. One of more than ``most_bytes`` is made again, of less
    quality, and then smaller. Raises `VideoError` if even a thumbnail has more."""
    wide = min(width or picture.width, picture.width)
    while True:
        high = max(1, round(picture.height * wide / picture.width))
        out = io.BytesIO()
        image: Any = picture.to_image(width=wide, height=high)  # type: ignore[no-untyped-call]  # PyAV's
        image.save(out, "JPEG", quality=quality)
        if most_bytes is None or out.tell() <= most_bytes:
            return out.getvalue()
        if quality > _LEAST_QUALITY:
            quality = max(_LEAST_QUALITY, quality * 2 // 3)
        elif wide > _LEAST_WIDTH:
            wide = max(_LEAST_WIDTH, wide * 2 // 3)
        else:
            raise VideoError(f"a picture of {wide} by {high} has {out.tell()} bytes, more than {most_bytes}")
