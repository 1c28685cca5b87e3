"""Pictures of four colours, in the encodings that cameras have."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Callable

if TYPE_CHECKING:
    Colour = tuple[int, int, int]
RED, GREEN, BLUE, GREY = (200, 30, 40), (20, 180, 60), (50, 60, 220), (120, 120, 120)
SIZE = 64


def colour_at(x: int, y: int, size: int = SIZE) -> Colour:
    """A quarter each: red and green above, blue and grey below."""
    return ((RED, GREEN), (BLUE, GREY))[y * 2 // size][x * 2 // size]


def yuv(colour: Colour) -> Colour:
    """A colour as studio video has it, by BT.601."""
    r, g, b = (part / 255 for part in colour)
    y = 16 + 65.481 * r + 128.553 * g + 24.966 * b
    u = 128 - 37.797 * r - 74.203 * g + 112.0 * b
    v = 128 + 112.0 * r - 93.786 * g - 18.214 * b
    return round(y), round(u), round(v)


def _pixels(write: Callable[[int, int], bytes], width: int = SIZE, height: int = SIZE) -> list[bytes]:
    return [b"".join(write(x, y) for x in range(width)) for y in range(height)]


def _order(*order: int, wide: str = "") -> list[bytes]:
    """Colours in an order, of which 3 is the opacity; ``wide`` is the byte order of 16 bit."""

    def write(x: int, y: int) -> bytes:
        values = [(*colour_at(x, y), 255)[i] for i in order]
        return struct.pack(f"{wide}{len(values)}H", *(v * 257 for v in values)) if wide else bytes(values)

    return _pixels(write)


def _grey(wide: str = "") -> list[bytes]:
    def write(x: int, y: int) -> bytes:
        grey = sum(colour_at(x, y)) // 3
        return struct.pack(f"{wide}H", grey * 257) if wide else bytes([grey])

    return _pixels(write)


def _bayer(pattern: str, wide: str = "") -> list[bytes]:
    def write(x: int, y: int) -> bytes:
        value = colour_at(x, y)["rgb".index(pattern[y % 2 * 2 + x % 2])]
        return struct.pack(f"{wide}H", value * 257) if wide else bytes([value])

    return _pixels(write)


def _pairs(order: str) -> list[bytes]:
    def write(x: int, y: int) -> bytes:
        y_, u, v = yuv(colour_at(x, y))
        return bytes({"y": y_, "c": (u, v)[x % 2]}[letter] for letter in order)

    return _pixels(write)


def _semi(order: int, part: int) -> list[bytes]:
    """The brightness, and below it pairs of colours for each square of ``part`` pixels."""
    rows = _pixels(lambda x, y: bytes([yuv(colour_at(x, y))[0]]))
    for y in range(0, SIZE, part):
        pairs = [yuv(colour_at(x, y))[1:][::order] for x in range(0, SIZE, part)]
        row = bytes(value for pair in pairs for value in pair)
        rows += [row[:SIZE], row[SIZE:]] if part == 1 else [row]
    return rows


# Encoding and whether its numbers are big-endian -> the rows.
ENCODED: dict[tuple[str, bool], list[bytes]] = {
    ("rgb8", False): _order(0, 1, 2),
    ("bgr8", False): _order(2, 1, 0),
    ("8UC3", False): _order(2, 1, 0),
    ("rgba8", False): _order(0, 1, 2, 3),
    ("bgra8", True): _order(2, 1, 0, 3),
    ("rgb16", False): _order(0, 1, 2, wide="<"),
    ("bgr16", True): _order(2, 1, 0, wide=">"),
    ("bayer_rggb8", False): _bayer("rggb"),
    ("bayer_bggr8", False): _bayer("bggr"),
    ("bayer_gbrg8", False): _bayer("gbrg"),
    ("bayer_grbg8", False): _bayer("grbg"),
    ("bayer_rggb16", True): _bayer("rggb", ">"),
    ("yuv422", False): _pairs("cy"),
    ("uyvy", False): _pairs("cy"),
    ("yuv422_yuy2", False): _pairs("yc"),
    ("yuyv", False): _pairs("yc"),
    ("nv12", False): _semi(1, 2),
    ("nv21", False): _semi(-1, 2),
    ("nv24", False): _semi(1, 1),
}
GREYS: dict[tuple[str, bool], list[bytes]] = {
    ("mono8", False): _grey(),
    ("8UC1", False): _grey(),
    ("mono16", False): _grey("<"),
    ("mono16", True): _grey(">"),
}
