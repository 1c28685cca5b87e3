"""Query messages are decoded as they were encoded; invalid ones are refused."""

from __future__ import annotations

import json

import pytest

from iort_contract.limits import ContractError
from iort_contract.messages.questions import (
    FIRST_US,
    LAST_US,
    QueryAnswer,
    QueryRequest,
    decode_query_answer,
    decode_query_request,
    encode_query_answer,
    encode_query_request,
    packed_samples,
    unpacked_samples,
)

REQUEST = QueryRequest("car", "vesc", 5, 9, ("speed",), "speed > 1", True, {"topic": {"S": "t"}})
TIMES_US, COLUMNS = [1_700_000_000_000_000, 1_700_000_000_020_000], {"speed": [1.5, None]}
SAMPLES = packed_samples(TIMES_US, COLUMNS)
ANSWER = QueryAnswer(2, ("speed",), 3, 1, 1, "codec", {"temp_fet": 2}, {"topic": {"S": "t"}}, SAMPLES)


@pytest.mark.parametrize("request_", [REQUEST, QueryRequest("car", "vesc")])
def test_a_request_is_decoded_as_it_was_encoded(request_: QueryRequest) -> None:
    assert decode_query_request(json.loads(encode_query_request(request_))) == request_


def test_a_request_needs_only_robot_and_stream_and_its_times_are_clamped() -> None:
    assert decode_query_request({"robot": "car", "stream": "vesc"}) == QueryRequest("car", "vesc")
    far = decode_query_request({"robot": "car", "stream": "vesc", "start_us": -(2**60), "end_us": 2**60})
    assert (far.start_us, far.end_us) == (FIRST_US, LAST_US)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"robot": "a/b"}, "robot name must be"),
        ({"robot": None}, "robot must be a text"),
        ({"stream": "+"}, "stream name must be"),
        ({"start_us": 1.5}, "start_us must be an integer"),
        ({"end_us": True}, "end_us must be an integer"),
        ({"fields": "speed"}, "fields must be a list"),
        ({"fields": [1]}, "fields must be a list"),
        ({"where": 1}, "where must be a text"),
        ({"token": "t"}, "token must be an object"),
    ],
)
def test_an_invalid_request_is_refused(change: dict[str, object], reason: str) -> None:
    with pytest.raises(ContractError, match=reason):
        decode_query_request({"robot": "car", "stream": "vesc", **change})


@pytest.mark.parametrize(
    "answer",
    [ANSWER, QueryAnswer(url="https://there"), QueryAnswer(samples=b""), QueryAnswer(error="no condition")],
)
def test_an_answer_is_decoded_as_it_was_encoded(answer: QueryAnswer) -> None:
    assert decode_query_answer(json.dumps(encode_query_answer(answer))) == answer


@pytest.mark.parametrize(
    "change",
    [
        {"codec": "steps"},
        {"samples": None},
        {"url": "https://there"},
        {"samples": "%"},
        {"n": "many"},
        {"fields": [1]},
        {"absent": [1]},
        {"reason": 1},
    ],
)
def test_an_invalid_answer_is_refused(change: dict[str, object]) -> None:
    with pytest.raises(ContractError):
        decode_query_answer(json.dumps({**encode_query_answer(ANSWER), **change}))


def test_samples_are_unpacked_as_they_were_packed() -> None:
    assert unpacked_samples(SAMPLES) == (TIMES_US, COLUMNS)
    assert unpacked_samples(packed_samples([], {})) == ([], {})
    with pytest.raises(ContractError, match="packs"):
        unpacked_samples(SAMPLES[:-3])
