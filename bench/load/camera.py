"""A simulated camera: the sample that the agent would send, with a small picture and an attachment."""

from __future__ import annotations

import base64
import io
import math

from iort_contract.limits import Value

_WIDTH, _HEIGHT, _HORIZON = 96, 54, 20


def attachment(robot: str, driven_m: float, yaw_rate_rad_s: float) -> dict[str, Value]:
    """A sample of a camera topic with ``large: upload``; the key has the form of the agent's keys."""
    content = _jpeg(driven_m, yaw_rate_rad_s)
    return {
        "format": "jpeg",
        "data.key": f"robots/{robot}/2026/05/04/100000-0123456789abcdef/camera/{driven_m * 1e3:.0f}-data.jpg",
        "data.sha256": "0" * 64,
        "data.size": 60 * len(content),
        "data.content_type": "image/jpeg",
        "data.thumbnail": base64.b64encode(content).decode(),
    }


def _jpeg(driven_m: float, yaw_rate_rad_s: float) -> bytes:
    from PIL import Image, ImageDraw  # noqa: PLC0415 - only the pictures need it

    image = Image.new("RGB", (_WIDTH, _HEIGHT), (176, 196, 212))
    draw = ImageDraw.Draw(image)
    draw.rectangle((0, _HORIZON, _WIDTH, _HEIGHT), fill=(96, 104, 88))
    for y in range(_HORIZON, _HEIGHT):
        near = (y - _HORIZON) / (_HEIGHT - _HORIZON)
        middle = _WIDTH / 2 + 26 * yaw_rate_rad_s * (1 - near) ** 2
        half = 3 + 40 * near
        draw.line((middle - half, y, middle + half, y), fill=(70, 72, 76))
        # Dashes come nearer as the car drives.
        if math.fmod(driven_m + 2 / (near + 0.08), 2) < 1:
            draw.line((middle - half / 14, y, middle + half / 14, y), fill=(232, 226, 190))
        for side in (-1, 1):
            draw.line((middle + side * half, y, middle + side * half * 1.08, y), fill=(214, 92, 60))
    out = io.BytesIO()
    image.save(out, "JPEG", quality=80)
    return out.getvalue()
