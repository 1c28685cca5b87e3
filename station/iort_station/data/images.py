"""Images of ROS messages as pixels. Their size has a bound: a robot may be anybody's."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from iort_contract.limits import ContractError
from iort_contract.ros.decode import Decoder, Large
from iort_contract.ros.definition import parse, short_kind
from iort_station.errors import StationError

# Height, width, and red, green, blue.
Pixels: TypeAlias = NDArray[np.uint8]

IMAGE, COMPRESSED = "sensor_msgs/Image", "sensor_msgs/CompressedImage"
MOST_PIXELS = 20_000_000
# A progressive JPEG needs about ten passes over its pixels. One of thousands takes hours in a few kilobytes.
_SCAN, _MOST_SCANS = b"\xff\xda", 64
_PNG = b"\x89PNG"


class ImageError(StationError):
    """A message is no image, or a damaged one."""


class Images:
    """Decodes messages of a type of images: CompressedImage with JPEG or PNG, or Image in the encodings of
    `sensor_msgs/image_encodings.hpp` that `_LAYOUTS` has. ``definition`` is the type's text.

    Raises `ImageError` for another type.
    """

    def __init__(self, kind: str, definition: str) -> None:
        name = short_kind(kind)
        if name not in {IMAGE, COMPRESSED}:
            raise ImageError(f"a camera must have messages of {IMAGE} or {COMPRESSED}, got {kind}")
        self._compressed = name == COMPRESSED
        try:
            self._decoder = Decoder(parse(kind, definition), large=True)
        except ContractError as error:
            raise ImageError(str(error)) from error

    def pixels(self, raw: bytes, least: int = 0) -> Pixels | None:
        """A message's pixels; None for one whose content was not kept.

        With ``least``, a large image may lose pixels, but keeps so many on its shorter side. Raises
        `StationError` for a damaged image, an unknown encoding, and one of more than `MOST_PIXELS`.
        """
        sample, data = self._decoded(raw)
        if not data:
            return None
        return _decompressed(data, least) if self._compressed else _of_pixels(sample, data, least)

    def file(self, raw: bytes) -> tuple[bytes, str]:
        """A message's image as a file, and its ending: JPEG and PNG as they came, pixels as a PNG.

        Raises `StationError` as `pixels`, and if its content was not kept.
        """
        from PIL import Image  # noqa: PLC0415 - as below

        pixels = self.pixels(raw)
        if pixels is None:
            raise ImageError("the image's content was not kept")
        if self._compressed:
            data = self._decoded(raw)[1]
            return bytes(data), "png" if data.startswith(_PNG) else "jpg"
        out = io.BytesIO()
        Image.fromarray(pixels).save(out, "PNG")
        return out.getvalue(), "png"

    def _decoded(self, raw: bytes) -> tuple[dict[str, Any], Large]:
        """The fields of a message, and its bytes."""
        try:
            sample: dict[str, Any] = dict(self._decoder.decode(raw))
        except ContractError as error:
            raise ImageError(str(error)) from error
        data = sample.get("data")
        if not isinstance(data, Large):
            raise ImageError("the image has no data")
        return sample, data


def resized(pixels: Pixels, width: int, height: int) -> Pixels:
    """The image in another size."""
    # A tenth of a second of import.
    from PIL import Image  # noqa: PLC0415 - see above

    return np.asarray(Image.fromarray(pixels).resize((width, height), Image.Resampling.BILINEAR))


def _decompressed(data: bytes, least: int) -> Pixels:
    from PIL import Image  # noqa: PLC0415 - as above

    try:
        with Image.open(io.BytesIO(data), formats=("JPEG", "PNG")) as image:
            if image.width * image.height > MOST_PIXELS:
                raise ImageError(
                    f"an image must have at most {MOST_PIXELS} pixels, got {image.width} by {image.height}"
                )
            if image.format == "JPEG" and data.count(_SCAN) > _MOST_SCANS:
                raise ImageError(f"a JPEG must have at most {_MOST_SCANS} scans")
            if least:
                # A JPEG is decoded at a part of its size.
                image.draft("RGB", (least, least))
            return np.asarray(image.convert("RGB"))
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise ImageError(f"the image is damaged: {error}") from error


def _of_pixels(sample: dict[str, Any], data: bytes, least: int) -> Pixels:
    from PIL import Image  # noqa: PLC0415 - as above

    width, height, step = (int(sample[name]) for name in ("width", "height", "step"))
    encoding = str(sample["encoding"])
    layout = _LAYOUTS.get(encoding)
    if layout is None:
        raise ImageError(f"an image's encoding must be one of {', '.join(_LAYOUTS)}, got {encoding[:20]!r}")
    kind = np.dtype(layout.kind).newbyteorder(">" if sample["is_bigendian"] else "<")
    used = width * layout.values * kind.itemsize
    if not 0 < width * height <= MOST_PIXELS or step < used or len(data) < height * step:
        raise ImageError(f"an image of {width} by {height} {encoding} has {len(data)} bytes, {step} a row")
    rows = np.frombuffer(data, np.uint8, height * step).reshape(height, step)
    pixels = rows[:, :used].view(kind).reshape(height, width, layout.values)
    # An even step keeps a pattern of two by two.
    part = max(1, min(width, height) // least if least else 1) * layout.cell
    shown = layout.shown(pixels, part)
    size = shown.shape[1], shown.shape[0]
    if not all(size):
        raise ImageError(f"an image of {width} by {height} {encoding} is too small")
    return np.asarray(Image.frombytes(layout.mode, size, shown.astype(np.uint8).tobytes()).convert("RGB"))


class _Layout(NamedTuple):
    """How an encoding has its pixels: values of a ``kind`` for each. ``shown`` gives some of them in 8 bit as
    Pillow's ``mode``; a pattern repeats after ``cell`` pixels."""

    values: int
    shown: Callable[[Any, int], Any]
    mode: str = "RGB"
    kind: str = "u1"
    cell: int = 1


def _colours(*order: int) -> Callable[[Any, int], Any]:
    return lambda pixels, part: pixels[::part, ::part][:, :, list(order)]


def _grey(pixels: Any, part: int) -> Any:
    return pixels[::part, ::part, 0]


def _stretched(pixels: Any, part: int) -> Any:
    """Depths or light of more than 8 bit, from the least to the most."""
    values = pixels[::part, ::part, 0].astype(np.float32)
    known = values[np.isfinite(values)]
    low, high = np.percentile(known, (1, 99)) if known.size else (0.0, 1.0)
    scaled = (np.nan_to_num(values, nan=low, posinf=high, neginf=low) - low) / max(high - low, 1e-6)
    return (np.clip(scaled, 0, 1) * 255).astype(np.uint8)


def _bayer(pattern: str) -> Callable[[Any, int], Any]:
    """The colours of each cell of two by two pixels, of which two are green."""
    places = {colour: divmod(pattern.index(colour), 2) for colour in "rgb"}

    def shown(pixels: Any, part: int) -> Any:
        height, width = (size // 2 * 2 for size in pixels.shape[:2])
        whole = pixels[:height, :width, 0]
        return np.dstack([whole[row::part, column::part] for row, column in places.values()])

    return shown


def _yuv(y: int, u: int, v: int) -> Callable[[Any, int], Any]:
    """Two pixels of four values share their colour; one of the two is shown."""

    def shown(pixels: Any, part: int) -> Any:
        height, width = pixels.shape[:2]
        pairs = pixels[:, : width // 2 * 2].reshape(height, width // 2, 4)
        return pairs[::part, :: part // 2][:, :, [y, u, v]]

    return shown


_LAYOUTS = {
    **dict.fromkeys(("mono8", "8UC1"), _Layout(1, _grey, "L")),
    **dict.fromkeys(("mono16", "16UC1"), _Layout(1, _stretched, "L", "u2")),
    "32FC1": _Layout(1, _stretched, "L", "f4"),
    "rgb8": _Layout(3, _colours(0, 1, 2)),
    **dict.fromkeys(("bgr8", "8UC3"), _Layout(3, _colours(2, 1, 0))),
    "rgba8": _Layout(4, _colours(0, 1, 2)),
    "bgra8": _Layout(4, _colours(2, 1, 0)),
    **{
        f"bayer_{pattern}8": _Layout(1, _bayer(pattern), cell=2)
        for pattern in ("rggb", "bggr", "gbrg", "grbg")
    },
    **dict.fromkeys(("uyvy", "yuv422"), _Layout(2, _yuv(1, 0, 2), "YCbCr", cell=2)),
    **dict.fromkeys(("yuyv", "yuv422_yuy2"), _Layout(2, _yuv(0, 1, 3), "YCbCr", cell=2)),
}
