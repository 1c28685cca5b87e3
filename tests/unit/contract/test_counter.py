"""The number in a picture: blocks, checksum, and the page's reader, which is the same."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iort_contract.counter import (
    COLUMNS,
    HEIGHTS,
    NUMBER_BITS,
    ROWS,
    counter_bits,
    counter_number,
    read_counter,
)

NUMBERS = st.integers(0, 2**NUMBER_BITS - 1)


@given(NUMBERS)
def test_blocks_give_their_number(number: int) -> None:
    bits = counter_bits(number)
    assert len(bits) == ROWS * COLUMNS
    assert counter_number(bits) == number


@given(NUMBERS, st.sets(st.integers(0, ROWS * COLUMNS - 1), min_size=1, max_size=3))
def test_blocks_that_were_misread_give_none(number: int, wrong: set[int]) -> None:
    bits = [bit ^ (i in wrong) for i, bit in enumerate(counter_bits(number))]
    assert counter_number(bits) is None


@pytest.mark.parametrize("level", [0, 255])
def test_a_picture_of_one_colour_has_no_number(level: int) -> None:
    assert read_counter(lambda _x, _y: level, 640, 480) is None


def drawn(number: int, width: int, height: int, *, black: int = 16, white: int = 235) -> list[list[int]]:
    """The rows of a picture with the number, drawn pixel by pixel."""
    bits = counter_bits(number)
    rows = [[128] * width for _ in range(height)]
    for y in range(height):
        row = ROWS - 1 - (height - 1 - y) * HEIGHTS // height
        if row >= 0:
            rows[y] = [(black, white)[bits[row * COLUMNS + x * COLUMNS // width]] for x in range(width)]
    return rows


@pytest.mark.parametrize(("width", "height"), [(96, 96), (120, 90), (640, 480)])
def test_it_is_read_from_pixels(width: int, height: int) -> None:
    rows = drawn(123_456_789, width, height)
    assert read_counter(lambda x, y: rows[y][x], width, height) == 123_456_789


def test_grey_blocks_are_no_number() -> None:
    rows = drawn(1, 96, 96, white=128)
    assert read_counter(lambda x, y: rows[y][x], 96, 96) is None
