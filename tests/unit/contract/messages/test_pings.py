"""Pings and their pongs."""

from __future__ import annotations

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iort_contract.catalog.rules import RULES
from iort_contract.limits import ContractError
from iort_contract.messages.live import decode_pong, encode_ping
from iort_contract.topics import PONG, RULE, build_topic
from tests.unit.contract.contract_values import seqs, times


@given(seqs, times, st.text(st.characters(), max_size=20), st.none() | st.integers(0, 2**53 // 1000))
def test_pong_round_trip(ping_id, sent_us, padding, received_ms):
    message = encode_ping(ping_id, sent_us, padding)
    if received_ms is not None:  # as the rule does
        message = json.dumps(dict(json.loads(message), received_ms=received_ms)).encode()
    assert decode_pong(message) == (ping_id, sent_us, received_ms)


@pytest.mark.parametrize(
    ("ping_id", "sent_us"),
    [(math.nan, 0), (-1, 0), (2**53 + 1, 0), (True, 0), ("1", 0), (1, math.nan), (1, 2**53)],
)
def test_an_invalid_ping_is_refused(ping_id, sent_us):
    with pytest.raises(ContractError, match=r"ping id|sent_us"):
        encode_ping(ping_id, sent_us)


@pytest.mark.parametrize(
    "pong",
    [
        "{}",
        '{"id":1}',
        '{"id":"1","sent_us":0}',
        '{"id":1,"sent_us":0,"received_ms":null}',
        "[]",
        '{"id":1,"sent_us":0,"received_ms":1000000000000000}',
    ],
)
def test_an_invalid_pong_is_refused(pong):
    with pytest.raises(ContractError):
        decode_pong(pong)


def test_a_pong_goes_to_the_robot_that_sent_the_ping():
    topic = RULES["pong"].action.topic("iort", robot="car")
    assert topic == build_topic(PONG, "car", RULE)
