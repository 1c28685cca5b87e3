"""Makes a picture small enough for a sample. Needs Pillow: pip install 'iort-agent[thumbnail]'."""

from __future__ import annotations

import base64
import io
import logging

_log = logging.getLogger(__name__)

_SIZE = (96, 96)
_QUALITIES = (50, 30, 15)
# In base64 it must fit into a text of a sample.
_MAX_BYTES = 3072
_KINDS = ("image/jpeg", "image/png")


def thumbnail(content: bytes, content_type: str) -> str | None:
    """A JPEG of at most 96 x 96 pixels in base64; None without Pillow or if the content is no picture."""
    if content_type not in _KINDS:
        return None
    try:
        from PIL import Image  # noqa: PLC0415 - optional
    except ImportError:
        _log.debug("no thumbnails: pip install 'iort-agent[thumbnail]'")
        return None
    try:
        with Image.open(io.BytesIO(content), formats=("JPEG", "PNG")) as picture:
            # Decoding a JPEG at a fraction of its size saves most of the time.
            picture.draft("RGB", _SIZE)
            small = picture.convert("RGB")
            small.thumbnail(_SIZE)
            for quality in _QUALITIES:
                out = io.BytesIO()
                small.save(out, "JPEG", quality=quality)
                if out.tell() <= _MAX_BYTES:
                    return base64.b64encode(out.getvalue()).decode()
    except Exception as error:  # noqa: BLE001 - a damaged picture raises about anything
        _log.debug("no thumbnail: %s", error)
    return None
