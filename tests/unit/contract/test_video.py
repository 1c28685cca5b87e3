"""Messages of video: whatever comes is decoded as it was encoded, or refused with a reason."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iort_contract.limits import ContractError
from iort_contract.messages.live import VIEW_LEASE_MS
from iort_contract.messages.video import (
    ANSWER,
    ASK,
    LOOKS,
    MARKS_REPEATED,
    MAX_ICE_SERVERS,
    MAX_JPEG_BYTES,
    MAX_LOOK_BYTES,
    MAX_SDP_BYTES,
    OFFER,
    REFUSED,
    SHOWS,
    TERMS,
    IceServer,
    Look,
    Mark,
    Picture,
    Show,
    VideoTerms,
    answer_clock,
    answer_topic,
    decode_clock,
    decode_look,
    decode_marks,
    decode_picture,
    decode_show,
    decode_terms,
    encode_ask_clock,
    encode_look,
    encode_marks,
    encode_picture,
    encode_show,
    encode_terms,
    look_topic,
    picture_topic,
)

# Shared with the page's tests: what TypeScript reads and writes.
VECTORS: dict[str, Any] = json.loads(Path(__file__).with_name("video.json").read_text())

ids = st.text("0123456789abcdef", min_size=8, max_size=32)
texts = st.text(st.characters(exclude_categories=["Cs"]), max_size=200)
servers = st.lists(
    st.builds(
        IceServer,
        st.lists(st.sampled_from(["stun:a.b", "turn:a.b:1?transport=tcp"]), min_size=1, max_size=3).map(
            tuple
        ),
        texts,
        texts,
    ),
    max_size=MAX_ICE_SERVERS,
).map(tuple)
terms = st.builds(
    VideoTerms,
    st.integers(16, 4096),
    st.integers(16, 4096),
    st.floats(0.1, 120),
    st.integers(1, 60_000),
)
times = st.integers(0, 2**53 - 1)
LOOK = Look("00000001", "00000002", ASK)


@st.composite
def looks(draw: st.DrawFn) -> Look:
    kind = draw(st.sampled_from(LOOKS))
    sdp = draw(texts.filter(bool)) if kind == OFFER else ""
    return Look(draw(ids), draw(ids), kind, draw(st.integers(0, VIEW_LEASE_MS)), sdp, draw(servers))


@st.composite
def shows(draw: st.DrawFn) -> Show:
    kind = draw(st.sampled_from(SHOWS))
    sdp = draw(texts.filter(bool)) if kind == ANSWER else ""
    return Show(draw(ids), kind, draw(texts), sdp, draw(terms) if kind == TERMS else None, draw(servers))


@given(looks())
def test_a_look_comes_back_as_it_was(look: Look) -> None:
    assert decode_look(encode_look(look)) == look


@given(shows())
def test_a_show_comes_back_as_it_was(show: Show) -> None:
    assert decode_show(encode_show(show)) == show


@given(terms)
def test_terms_come_back_from_the_shadow(one: VideoTerms) -> None:
    assert decode_terms(json.loads(json.dumps(encode_terms(one)))) == one


@pytest.mark.parametrize(
    "document",
    [None, {}, [], "x", {"width": 640}, {**encode_terms(VideoTerms(640, 480, 15)), "rate_hz": float("nan")}],
)
def test_a_robot_without_valid_terms_has_none(document: Any) -> None:
    assert decode_terms(document) is None


@pytest.mark.parametrize(
    "changes",
    [
        {"viewer": "x"},
        {"request": "../../etc"},
        {"kind": "steal"},
        {"lease_ms": VIEW_LEASE_MS + 1},
        {"lease_ms": -1},
        {"kind": OFFER},
        {"sdp": "v=0"},
        {"kind": OFFER, "sdp": "x" * (MAX_SDP_BYTES + 1)},
        {"kind": OFFER, "sdp": "\u20ac" * (MAX_SDP_BYTES // 3 + 1)},
        {"ice_servers": (IceServer(("https://example.com",)),)},
        {"ice_servers": (IceServer(()),)},
        {"ice_servers": (IceServer(("stun:a",) * 9),)},
        {"ice_servers": (IceServer(("stun:a",)),) * (MAX_ICE_SERVERS + 1)},
        {"ice_servers": (IceServer(("stun:a",), "u" * 1025),)},
        {"ice_servers": (IceServer(("stun:" + "a" * 512,)),)},
    ],
)
def test_no_look_is_written_that_a_robot_would_refuse(changes: dict[str, Any]) -> None:
    with pytest.raises(ContractError):
        encode_look(replace(LOOK, **changes))


def test_a_megabyte_is_refused_before_it_is_parsed() -> None:
    payload = b"[" * 1_000_000
    with pytest.raises(ContractError, match=f"at most {MAX_LOOK_BYTES} bytes, got 1000000"):
        decode_look(payload)


@pytest.mark.parametrize(
    "show",
    [
        Show("00000001", TERMS),
        Show("00000001", ANSWER),
        Show("00000001", REFUSED, sdp="v=0"),
        Show("x", REFUSED),
        Show("00000001", "perhaps"),
    ],
)
def test_no_show_is_written_that_a_viewer_would_refuse(show: Show) -> None:
    with pytest.raises(ContractError):
        encode_show(show)


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=12), inner, max_size=4),
    max_leaves=12,
)


@given(st.binary(max_size=200) | json_values.map(lambda value: json.dumps(value).encode()))
def test_garbage_raises_nothing_but_a_contract_error(payload: bytes) -> None:
    for decode in (decode_look, decode_show, decode_marks, decode_clock, decode_picture):
        with suppress(ContractError):
            decode(payload)
    with suppress(ContractError):
        answer_clock(payload, 1)


@given(
    st.sampled_from([*Look.__dataclass_fields__, "v", "more"]),
    json_values,
)
def test_a_look_with_one_entry_of_another_kind_raises_nothing_but_a_contract_error(
    name: str, value: Any
) -> None:
    document = {**json.loads(encode_look(LOOK)), name: value}
    with suppress(ContractError):
        decode_look(json.dumps(document).encode())


@given(st.lists(st.builds(Mark, st.integers(0, 2**32 - 1), times, st.integers(0, 2**32 - 1)), max_size=9))
def test_the_newest_marks_come_back(marks: list[Mark]) -> None:
    assert decode_marks(encode_marks(marks)) == marks[-MARKS_REPEATED:]


@given(st.integers(0, 2**32 - 1), times)
def test_the_clocks_answer_has_the_questions_number(number: int, now_us: int) -> None:
    assert decode_clock(answer_clock(encode_ask_clock(number), now_us)) == (number, now_us)


@given(
    st.builds(
        Picture,
        st.integers(0, 2**32 - 1),
        times,
        times,
        st.none() | st.integers(-(2**40), 2**40),
        st.binary(min_size=1, max_size=200),
    )
)
def test_a_picture_comes_back_as_it_was(picture: Picture) -> None:
    assert decode_picture(encode_picture(picture)) == picture


@pytest.mark.parametrize("size", [0, MAX_JPEG_BYTES + 1])
def test_a_picture_beyond_a_message_is_not_written(size: int) -> None:
    with pytest.raises(ContractError, match=f"1 to {MAX_JPEG_BYTES} bytes, got {size}"):
        encode_picture(Picture(1, 1, 1, None, bytes(size)))


def test_all_topics_are_on_the_lane_that_no_rule_reads() -> None:
    assert look_topic("car1", "iort") == "view/iort/car1/video"
    assert picture_topic("car1", "iort") == "view/iort/car1/picture"
    assert answer_topic("car1", "00ff00ff", "iort") == "view/iort/car1/to-00ff00ff"


@pytest.mark.parametrize("vector", VECTORS["marks"])
def test_the_shared_marks(vector: dict[str, Any]) -> None:
    marks = [Mark(*mark) for mark in vector["marks"]]
    assert encode_marks(marks).hex() == vector["hex"]
    assert decode_marks(bytes.fromhex(vector["hex"])) == marks


@pytest.mark.parametrize("vector", VECTORS["clock"])
def test_the_shared_clock(vector: dict[str, Any]) -> None:
    question = encode_ask_clock(vector["number"])
    assert question.hex() == vector["question"]
    answer = answer_clock(question, vector["now_us"])
    assert answer.hex() == vector["answer"]
    assert decode_clock(answer) == (vector["number"], vector["now_us"])


@pytest.mark.parametrize("vector", VECTORS["picture"])
def test_the_shared_pictures(vector: dict[str, Any]) -> None:
    fields = (vector[name] for name in ("number", "captured_us", "sent_us", "offset_us"))
    picture = Picture(*fields, bytes.fromhex(vector["jpeg"]))
    assert encode_picture(picture).hex() == vector["hex"]
    assert decode_picture(bytes.fromhex(vector["hex"])) == picture


@pytest.mark.parametrize("message", VECTORS["garbage"])
def test_the_shared_garbage(message: str) -> None:
    for decode in (decode_marks, decode_clock, decode_picture):
        with pytest.raises(ContractError):
            decode(bytes.fromhex(message))
