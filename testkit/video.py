"""What programs see in video: the pictures of encoded ones, and the number in a picture."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from iort_contract.counter import BLACK, COLUMNS, HEIGHTS, PLACES, ROWS, WHITE, read_counter

if TYPE_CHECKING:
    from av import VideoFrame

DECODERS = {"vp8": "vp8", "h264": "h264", "gstreamer": "h264"}


def counter_of(picture: VideoFrame) -> int | None:
    """The number in a picture of yuv420p; None if there is none that can be read."""
    plane = picture.planes[0]
    content, size = memoryview(plane), plane.line_size
    return read_counter(lambda x, y: content[y * size + x], picture.width, picture.height)


def decoded(codec: str, encoded: Iterable[bytes]) -> list[VideoFrame]:
    """The pictures of encoded ones, decoded one after the other."""
    import av  # noqa: PLC0415 - only some instruments look at video

    decoder: Any = av.CodecContext.create(DECODERS[codec], "r")
    return [picture for data in encoded for picture in decoder.decode(av.Packet(data))]


# The same as `read_counter`, for a page: of an ImageData, as a canvas gives it.
COUNTER_JS = f"""
function readCounter(image) {{
  const {{ data, width, height }} = image;
  const luma = (x, y) => {{
    const at = 4 * (Math.trunc(y) * width + Math.trunc(x));
    return 0.299 * data[at] + 0.587 * data[at + 1] + 0.114 * data[at + 2];
  }};
  const bits = [];
  for (let row = 0; row < {ROWS}; row += 1) {{
    for (let column = 0; column < {COLUMNS}; column += 1) {{
      let sum = 0;
      for (const x of {list(PLACES)}) {{
        for (const y of {list(PLACES)}) {{
          sum += luma(((column + x) * width) / {COLUMNS}, height - (({ROWS} - row - y) * height) / {HEIGHTS});
        }}
      }}
      const mean = sum / {len(PLACES) ** 2};
      if (mean > {BLACK} && mean < {WHITE}) return null;
      bits.push(mean >= {WHITE} ? 1 : 0);
    }}
  }}
  const whole = (from, to) => bits.slice(from, to).reduce((value, bit) => value * 2 + bit, 0);
  const number = whole(0, 32);
  let check = 0xffff;
  for (const shift of [24, 16, 8, 0]) {{
    check ^= ((number >>> shift) & 0xff) << 8;
    for (let i = 0; i < 8; i += 1) check = ((check << 1) ^ (check & 0x8000 ? 0x1021 : 0)) & 0xffff;
  }}
  return check === whole(32, 48) ? number : null;
}}
"""
