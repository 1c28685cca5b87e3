"""The raw client's packets follow the MQTT standard."""

from __future__ import annotations

import pytest

from bench.floors.raw_mqtt import _packet, _text


@pytest.mark.parametrize(
    ("length", "head"),
    [(0, b"\x30\x00"), (127, b"\x30\x7f"), (128, b"\x30\x80\x01"), (16_384, b"\x30\x80\x80\x01")],
)
def test_the_remaining_length_is_encoded_as_in_the_standard(length, head):
    assert _packet(0x30, b"x" * length)[: len(head)] == head
    assert len(_packet(0x30, b"x" * length)) == len(head) + length


def test_a_text_is_prefixed_with_its_length():
    assert _text("größe".encode()) == b"\x00\x07" + "größe".encode()
