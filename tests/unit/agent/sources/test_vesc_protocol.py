"""The VESC's protocol: no frame lost, none made up, no answer misread."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iort_agent.sources import vesc_protocol
from iort_agent.sources.vesc_protocol import FrameParser, ProtocolError, decode_values, frame
from iort_contract.catalog.vesc import VESC_FIELDS
from tests.vesc_standin import framed, values

payloads = st.one_of(
    st.binary(min_size=1, max_size=80),
    st.binary(min_size=250, max_size=260),
    st.integers(0, 1000).map(values),
)
# Anything, and what looks most like the beginning or the middle of a frame.
garbage = st.one_of(
    st.binary(max_size=40),
    st.lists(st.sampled_from([2, 3, 0, 1, 5, 255]), max_size=20).map(bytes),
    st.tuples(payloads, st.integers(0, 90)).map(lambda half: framed(half[0])[: half[1]][:-1]),
    st.tuples(payloads, st.integers(1, 255)).map(
        lambda bad: framed(bad[0])[:-2] + bytes([framed(bad[0])[-2] ^ bad[1], 3])
    ),
)


def cut(data: bytes, places: list[int]) -> list[bytes]:
    ends = sorted(place % (len(data) + 1) for place in places)
    return [data[a:b] for a, b in zip([0, *ends], [*ends, len(data)])]


def is_subsequence(few: list[bytes], many: list[bytes]) -> bool:
    rest = iter(many)
    return all(one in rest for one in few)


@given(
    st.lists(st.tuples(garbage, payloads), max_size=8), garbage, st.lists(st.integers(0, 10_000), max_size=30)
)
def test_every_intact_frame_comes_out_whatever_stands_between_and_however_it_is_cut(
    parts: list[tuple[bytes, bytes]], rest: bytes, places: list[int]
) -> None:
    stream = b"".join(noise + framed(payload) for noise, payload in parts) + rest
    parser = FrameParser()
    found = [payload for chunk in cut(stream, places) for payload in parser.feed(chunk)]
    sent = [payload for _, payload in parts]
    assert is_subsequence(sent, found)
    # What else came out stands in the stream with a right CRC, as if it had been sent.
    assert all(framed(payload) in stream for payload in found)
    if found == sent:
        assert parser.skipped + parser.pending + sum(len(framed(p)) for p in found) == len(stream)
    assert FrameParser().feed(stream) == found, "how the bytes are cut makes no difference"


def test_half_a_frame_and_a_long_one_may_share_a_byte() -> None:
    """The 03 that begins a long frame ends the one cut off before it."""
    long = bytes(300)
    assert FrameParser().feed(framed(b"\x00")[:-1] + framed(long)) == [b"\x00", long]


@given(st.lists(st.binary(max_size=3000), max_size=20))
def test_memory_is_bounded(chunks: list[bytes]) -> None:
    parser = FrameParser()
    for chunk in chunks:
        parser.feed(chunk)
        assert parser.pending <= len(parser._buffer) <= vesc_protocol._MAX_BUFFER
        assert sum(map(len, parser._ends.values())) <= 2 * vesc_protocol._MAX_FRAME


def test_a_frame_after_a_megabyte_of_start_bytes() -> None:
    parser = FrameParser()
    for _ in range(100):
        assert parser.feed(b"\x02\xff\x03\x03\xff" * 2000) == []
    assert parser.feed(framed(values())) == [values()]
    assert parser.skipped == 1_000_000


def test_wrong_crcs_are_counted() -> None:
    parser = FrameParser()
    broken, endless = bytearray(framed(values())), bytearray(framed(values()))
    broken[10] ^= 1
    endless[-1] = 4
    assert parser.feed(bytes(broken + endless)) == []
    assert parser.feed(framed(values())) == [values()]
    assert (parser.bad_crc, parser.skipped) == (1, len(broken) + len(endless))


def test_what_looks_like_a_broken_frame_within_a_frame_is_none() -> None:
    parser = FrameParser()
    payload = b"\x04\x02\x01\x04\x00\x00\x03" * 9
    for _ in range(200):
        assert parser.feed(framed(payload)) == [payload]
    assert (parser.bad_crc, parser.skipped, parser.pending) == (0, 0, 0)


@given(st.binary(min_size=1, max_size=1024))
def test_a_frame_is_what_the_description_says(payload: bytes) -> None:
    assert frame(payload) == framed(payload)
    assert FrameParser().feed(frame(payload)) == [payload]


def test_known_frames() -> None:
    """As every description of the protocol has them."""
    assert vesc_protocol.request(vesc_protocol.COMM_GET_VALUES) == bytes.fromhex("02 01 04 40 84 03")
    forwarded = vesc_protocol.request(vesc_protocol.COMM_GET_VALUES, 17)
    assert FrameParser().feed(forwarded) == [bytes((34, 17, 4))]


@pytest.mark.parametrize("size", [0, 1025])
def test_a_payload_of_no_length_or_too_much(size: int) -> None:
    with pytest.raises(ProtocolError, match=f"{size} bytes"):
        frame(bytes(size))


def test_the_values_of_current_firmware_are_the_contracts() -> None:
    assert decode_values(values(100)) == {
        "temp_fet": 25.1,
        "temp_motor": 33.3,
        "current_motor": 12.34,
        "current_input": 5.67,
        "avg_id": -0.12,
        "avg_iq": 12.3,
        "duty_cycle": 0.305,
        "speed": 8123,
        "voltage_input": 11.8,
        "charge_drawn": 281,
        "charge_regen": 1,
        "energy_drawn": 12908,
        "energy_regen": 48,
        "displacement": 100,
        "distance_traveled": 101,
        "fault_code": 0,
        "pid_pos_now": 307.511,
        "controller_id": 1,
        "ntc_temp_mos1": 24.1,
        "ntc_temp_mos2": 24.2,
        "ntc_temp_mos3": 24.3,
        "avg_vd": -0.233,
        "avg_vq": 24.842,
        "status": 1,
    }
    ros2 = {name for name, field in VESC_FIELDS.items() if 2 in field.ros}
    assert set(decode_values(values())) == ros2 | {"status"}


@pytest.mark.parametrize(
    ("length", "last"),
    [(54, "fault_code"), (58, "pid_pos_now"), (59, "controller_id"), (65, "ntc_temp_mos3"), (73, "avg_vq")],
)
def test_older_firmware_has_the_same_with_less(length: int, last: str) -> None:
    decoded = decode_values(values(length=length))
    assert list(decoded)[-1] == last
    assert decoded == {name: value for name, value in decode_values(values()).items() if name in decoded}


def test_firmware_2_has_a_layout_of_its_own() -> None:
    payload = struct.pack(
        ">B7hiihihiiiiiiB", 4, 210, 220, 230, 240, 250, 260, 305, -1234, 567, -305, 8123, 118, 281, 1, 12908,
        48, -5, 6, 2,
    )  # fmt: skip
    assert len(payload) == 56
    decoded = decode_values(payload)
    expected = {name for name, field in VESC_FIELDS.items() if 1 in field.ros}
    assert expected <= set(decoded)
    assert (decoded["temperature_pcb"], decoded["ntc_temp_mos1"], decoded["ntc_temp_mos6"]) == (30.5, 21, 26)
    assert (decoded["current_motor"], decoded["duty_cycle"], decoded["speed"]) == (-12.34, -0.305, 8123)
    assert (decoded["voltage_input"], decoded["energy_drawn"], decoded["fault_code"]) == (11.8, 12908, 2)
    assert (decoded["displacement"], decoded["distance_traveled"]) == (-5, 6)


@given(st.binary(min_size=1, max_size=300).filter(lambda payload: len(payload) not in vesc_protocol.LAYOUTS))
def test_an_unknown_length_is_refused(payload: bytes) -> None:
    with pytest.raises(ProtocolError, match=f"got {len(payload)} bytes"):
        decode_values(b"\x04" + payload[1:])


def test_another_commands_answer_is_refused() -> None:
    with pytest.raises(ProtocolError):
        decode_values(b"\x05" + values()[1:])
