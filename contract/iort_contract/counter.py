"""A picture's number as black and white blocks at its lower edge, which programs read after any encoder: the
camera of the simulated car draws it, and whoever proves what a driver saw reads it.

There are `ROWS` rows of `COLUMNS` blocks, each `1 / COLUMNS` of the picture's width wide and `1 / HEIGHTS` of
its height high, from left to right and down: 32 bits of the number, and 16 of its checksum. White is 1."""

from __future__ import annotations

import binascii
from typing import Callable, Sequence

COLUMNS, ROWS, HEIGHTS = 24, 2, 24
NUMBER_BITS, CHECK_BITS = 32, 16
# A block is read at its middle: codecs mix its edges with its neighbours.
PLACES = (0.35, 0.5, 0.65)
# What is between them is neither black nor white: no counter, or a damaged one.
BLACK, WHITE = 110, 145


def counter_bits(number: int) -> list[int]:
    """The blocks of a number below 2 ** 32, 0 or 1 each."""
    content = number.to_bytes(NUMBER_BITS // 8, "big")
    whole = number << CHECK_BITS | binascii.crc_hqx(content, 0xFFFF)
    return [whole >> i & 1 for i in reversed(range(NUMBER_BITS + CHECK_BITS))]


def counter_number(bits: Sequence[int]) -> int | None:
    """The number of blocks; None if the checksum is not that of the number."""
    number = int("".join(map(str, bits[:NUMBER_BITS])), 2)
    return number if counter_bits(number) == list(bits) else None


def read_counter(luma: Callable[[int, int], int], width: int, height: int) -> int | None:
    """The number in a picture whose pixel (x, y) is ``luma`` bright, 0 to 255; None if there is none that can
    be read."""
    bits = []
    for row in range(ROWS):
        for column in range(COLUMNS):
            middle = [
                luma(int((column + x) * width / COLUMNS), int(height - (ROWS - row - y) * height / HEIGHTS))
                for x in PLACES
                for y in PLACES
            ]
            mean = sum(middle) / len(middle)
            if BLACK < mean < WHITE:
                return None
            bits.append(int(mean >= WHITE))
    return counter_number(bits)
