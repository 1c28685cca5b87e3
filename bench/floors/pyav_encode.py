"""Encodes raw pictures by PyAV in a plain loop: the floor of `bench.sections.video` where ffmpeg is missing.

python -m bench.floors.pyav_encode CODEC RATE_HZ PICTURES FILE
"""

from __future__ import annotations

import sys
from fractions import Fraction
from pathlib import Path
from typing import Any

import av

from bench.sections.video import HEIGHT, KBPS, WIDTH
from iort_agent.video.encoder import LIBRARIES, options


def main() -> None:
    """Encode, and write nothing."""
    codec, rate_hz, count, path = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4])
    context: Any = av.CodecContext.create(LIBRARIES[codec], "w")
    context.width, context.height, context.pix_fmt = WIDTH, HEIGHT, "yuv420p"
    context.time_base, context.framerate = Fraction(1, rate_hz), Fraction(rate_hz)
    context.bit_rate, context.gop_size, context.thread_count = KBPS * 1000, 1_000_000, 1
    context.options = options(codec, KBPS * 1000)
    parts = WIDTH * HEIGHT, WIDTH * HEIGHT // 4, WIDTH * HEIGHT // 4
    with path.open("rb") as raw:
        for i in range(count):
            picture = av.VideoFrame(WIDTH, HEIGHT, "yuv420p")
            for plane, size in zip(picture.planes, parts, strict=True):
                plane.update(raw.read(size))
            picture.pts = i
            context.encode(picture)


if __name__ == "__main__":
    main()
