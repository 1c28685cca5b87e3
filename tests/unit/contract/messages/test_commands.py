"""Commands and fleet messages are decoded as they were encoded; invalid ones are not encoded."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iort_contract.limits import ContractError
from iort_contract.messages.commands import (
    Command,
    FleetMessage,
    decode_command,
    decode_fleet,
    encode_command,
    encode_fleet,
)

T0 = 1_700_000_000_000_000
MESSAGES = st.dictionaries(
    st.text(max_size=3),
    st.integers()
    | st.booleans()
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.lists(st.none(), max_size=2),
    max_size=4,
)
KEYS = ["v", "session", "started_us", "seq", "sent_us", "valid_ms", "lease_ms", "message", "boot"]
TIMES = st.integers(0, 2**53 - 1)


@given(
    st.text("0123456789abcdef", min_size=8, max_size=32), st.tuples(TIMES, TIMES), st.integers(0, 2**53),
    st.tuples(st.integers(1, 60_000), st.none() | st.integers(1, 10_000)), MESSAGES,
)  # fmt: skip
def test_a_command_is_decoded_as_it_was_encoded(
    session: str, times: tuple[int, int], seq: int, holds: tuple[int, int | None], message: Any
) -> None:
    command = Command(session, min(times), seq, max(times), holds[0], message, holds[1])
    assert decode_command(encode_command(command)) == command


@given(st.integers(0, 2**53), TIMES, MESSAGES)
def test_a_fleet_message_is_decoded_as_it_was_encoded(seq: int, sent: int, message: Any) -> None:
    heard = FleetMessage("0badcafe", seq, sent, message)
    assert decode_fleet(encode_fleet(heard)) == heard


@pytest.mark.parametrize(
    "change",
    [
        {"session": "x"}, {"session": None}, {"seq": -1}, {"seq": True}, {"started_us": T0 + 1},
        {"sent_us": 1.5}, {"sent_us": 2**60}, {"valid_ms": 0}, {"valid_ms": 60_001}, {"lease_ms": 0},
        {"lease_ms": 10_001}, {"message": []}, {"message": None}, {"message": {"a": float("nan")}},
        {"takeover": 1}, {"ends": None}, {"by": ""}, {"by": "a" * 65}, {"by": "a\nb"},
        {"message": {"a": "x" * 200_000}}, {"message": {"a": {1, 2}}},
    ],
)  # fmt: skip
def test_an_invalid_command_is_refused(change: dict[str, Any]) -> None:
    good = Command("feedbeef", T0, 0, T0, 500, {"data": 1}, 300)
    with pytest.raises(ContractError):
        encode_command(replace(good, **change))


ANYTHING = st.none() | st.booleans() | st.integers(-1, 2) | st.floats() | st.text(max_size=9) | st.just({})


@given(st.dictionaries(st.sampled_from(KEYS), ANYTHING) | st.binary(max_size=40))
def test_any_other_input_raises_the_contracts_error(content: Any) -> None:
    payload = content if isinstance(content, bytes) else json.dumps(content).encode()
    for read in (decode_command, decode_fleet):
        with pytest.raises(ContractError):
            read(payload)
