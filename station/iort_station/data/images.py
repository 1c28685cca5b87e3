"""Images of ROS messages as pixels."""

from __future__ import annotations

from io import BytesIO
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from iort_contract.limits import ContractError
from iort_contract.ros.decode import Decoder, Large
from iort_contract.ros.definition import parse, short_kind
from iort_contract.ros.message import MessageType
from iort_station.errors import StationError

# Height, width, and red, green, blue.
Pixels: TypeAlias = NDArray[np.uint8]

IMAGE, COMPRESSED = "sensor_msgs/Image", "sensor_msgs/CompressedImage"
# A robot chooses the size: a small file may become gigabytes of pixels.
_MOST_PIXELS = 4096 * 4096
# The place of red, green and blue in an encoding's pixel of so many bytes: sensor_msgs/image_encodings.hpp.
_ENCODINGS = {
    "rgb8": (3, (0, 1, 2)),
    "8UC3": (3, (2, 1, 0)),
    "bgr8": (3, (2, 1, 0)),
    "rgba8": (4, (0, 1, 2)),
    "bgra8": (4, (2, 1, 0)),
    "8UC4": (4, (2, 1, 0)),
    "mono8": (1, (0, 0, 0)),
    "8UC1": (1, (0, 0, 0)),
}


def is_image(kind: MessageType) -> bool:
    """Whether messages of a type are images."""
    return _name(kind) in {IMAGE, COMPRESSED}


class Images:
    """Decodes a topic's messages of one type: CompressedImage, or Image of 8 bits a channel.

    Raises `StationError` for a type without images.
    """

    def __init__(self, kind: MessageType) -> None:
        self._compressed = _name(kind) == COMPRESSED
        if not is_image(kind):
            raise StationError(f"{kind.topic} must have messages of {IMAGE} or {COMPRESSED}, got {kind.kind}")
        try:
            self._decoder = Decoder(parse(kind.kind, kind.definition), large=True)
        except ContractError as error:
            raise StationError(f"{kind.topic}: {error}") from error

    def pixels(self, raw: bytes) -> Pixels | None:
        """A message's pixels; None for one whose content was not kept. Raises `StationError` for a damaged
        one, and for an unknown encoding."""
        try:
            values = self._decoder.decode(raw)
        except ContractError as error:
            raise StationError(str(error)) from error
        data: Any = values.get("data")
        if not isinstance(data, Large):
            raise StationError("the image has no data")
        if not data:
            return None
        if self._compressed:
            return _decompressed(data)
        height, width, step = (int(values[name] or 0) for name in ("height", "width", "step"))
        encoding = str(values["encoding"])
        if encoding not in _ENCODINGS:
            raise StationError(f"an image's encoding must be {', '.join(_ENCODINGS)}, got {encoding!r}")
        size, places = _ENCODINGS[encoding]
        if not height or not width or step < width * size or len(data) < height * step:
            raise StationError(f"an image of {width}x{height} {encoding} has {len(data)} bytes, {step} a row")
        rows = np.frombuffer(data, dtype=np.uint8, count=height * step).reshape(height, step)
        return rows[:, : width * size].reshape(height, width, size)[:, :, list(places)]


def resized(pixels: Pixels, width: int, height: int) -> Pixels:
    """The image in another size."""
    # A tenth of a second of import.
    from PIL import Image  # noqa: PLC0415 - see above

    return np.asarray(Image.fromarray(pixels).resize((width, height), Image.Resampling.BILINEAR))


def _decompressed(data: bytes) -> Pixels:
    from PIL import Image, UnidentifiedImageError  # noqa: PLC0415 - as above

    try:
        with Image.open(BytesIO(data), formats=("JPEG", "PNG", "WEBP")) as image:
            if image.width * image.height > _MOST_PIXELS:
                raise StationError(
                    f"an image must have at most {_MOST_PIXELS} pixels, got {image.width}x{image.height}"
                )
            return np.asarray(image.convert("RGB"))
    except (OSError, SyntaxError, UnidentifiedImageError, Image.DecompressionBombError) as error:
        raise StationError(f"the image is damaged: {error}") from error


def _name(kind: MessageType) -> str:
    return short_kind(kind.kind)
