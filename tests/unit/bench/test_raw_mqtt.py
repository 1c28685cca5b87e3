"""The raw client's packets, as the standard writes them."""

from __future__ import annotations

import pytest

from bench.floors.raw_mqtt import _packet, _text


@pytest.mark.parametrize(
    ("length", "head"),
    [(0, b"\x30\x00"), (127, b"\x30\x7f"), (128, b"\x30\x80\x01"), (16_384, b"\x30\x80\x80\x01")],
)
def test_remaining_length(length, head):
    assert _packet(0x30, b"x" * length)[: len(head)] == head
    assert len(_packet(0x30, b"x" * length)) == len(head) + length


def test_text_has_its_length_before_it():
    assert _text("größe".encode()) == b"\x00\x07" + "größe".encode()
