"""Live samples are decoded as they were encoded, also after the rule and Lambda 1 passed them on."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from iort_contract.catalog.rules import RULES
from iort_contract.catalog.vesc import VESC_FIELDS
from iort_contract.limits import (
    LIVE_MAX_RATE_HZ,
    LIVE_MIN_RATE_HZ,
    MAX_NEXT_MS,
    MAX_PUBNUB_BYTES,
    ContractError,
)
from iort_contract.messages.envelope import event_message, rule_event
from iort_contract.messages.live import (
    VIEW_LEASE_MS,
    Lease,
    LiveSample,
    decode_lease,
    decode_live,
    decode_live_update,
    decode_pong,
    encode_lease,
    encode_live,
    encode_ping,
    lease_topic,
    live_update,
)
from iort_contract.tables import MESSAGE_BASE64
from iort_contract.topics import PONG, RULE, build_topic
from tests.unit.contract.contract_values import (
    BAD_HEADERS,
    BOOT,
    GOOD_LIVE,
    MOST_NONFINITE,
    anything,
    boots,
    names,
    nulled,
    same,
    seqs,
    strict,
    times,
    values,
)

samples = st.dictionaries(names, values, max_size=8)
lives = st.builds(
    LiveSample,
    boots,
    seqs,
    times,
    times,
    samples,
    st.integers(0, 1000),
    st.none() | times,
    st.none() | st.integers(1, MAX_NEXT_MS),
)


@given(lives)
def test_live_round_trip(live):
    message = encode_live(live)
    for decoded in map(decode_live, (message, message.decode(), handed_over(message))):
        assert replace(decoded, sample={}) == replace(live, sample={})
        assert list(decoded.sample) == list(live.sample)
        assert all(same(live.sample[name], decoded.sample[name]) for name in live.sample)


def handed_over(message):
    """The message as the live rule passes it to Lambda 1 and Lambda 1 decodes it."""
    event = rule_event(message, "live/iort/car/vesc", 1_700_000_000_000)
    return event_message(json.loads(json.dumps(event)))


@pytest.mark.parametrize("event", [{}, {MESSAGE_BASE64: 7}, {MESSAGE_BASE64: "a%"}])
def test_an_event_of_another_kind_is_refused(event):
    with pytest.raises(ContractError, match=MESSAGE_BASE64):
        event_message(event)


@given(st.dictionaries(names, anything, max_size=8))
@example({"a": math.nan, "b": math.inf, "c": -math.inf})
def test_live_nonfinite_becomes_null_and_is_counted(sample):
    message = encode_live(LiveSample(BOOT, 0, 0, 0, sample, 5))
    strict(message)
    decoded = decode_live(message)
    assert decoded.sample == {name: nulled(value) for name, value in sample.items()}
    assert decoded.nonfinite == 5 + sum(nulled(v) is None and v is not None for v in sample.values())


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        *BAD_HEADERS,
        ({"t_us": 2**53}, "sample time"),
        ({"t_us": 1.5}, "sample time"),
        ({"sent_us": True}, "sent_us"),
        ({"offset_us": 0.5}, "offset_us"),
        ({"offset_us": 2**53}, "offset_us"),
        ({"next_ms": 0}, "next_ms"),
        ({"next_ms": 10.0}, "next_ms"),
        ({"sample": {f"f{i}": 0 for i in range(513)}}, "fields, got 513"),
        ({"sample": {"a b": 1}}, "field name"),
        ({"sample": {"speed": math.nan}, "nonfinite": MOST_NONFINITE}, "nonfinite"),
    ],
)
def test_an_invalid_live_sample_is_refused(changed, named):
    with pytest.raises(ContractError, match=named):
        encode_live(replace(GOOD_LIVE, **changed))


def test_live_update_carries_every_hop():
    live = LiveSample(BOOT, 9, 1_000, 2_000, {"speed": 1})
    update = live_update("car", "vesc", live, 3, 4_000)
    hops = {"sent_us": 2_000, "received_ms": 3, "lambda_us": 4_000}
    assert update["hops"] == hops
    known = live_update("car", "vesc", replace(live, offset_us=-5), 3, 4_000)
    assert known["hops"] == {**hops, "offset_us": -5}
    assert (update["robot"], update["stream"], update["t"], update["seq"]) == ("car", "vesc", 1_000, 9)
    assert update["sample"] == {"speed": 1}
    full = dict.fromkeys(VESC_FIELDS, -1234.56789)
    largest = live_update("c" * 64, "vesc", replace(live, sample=full), 2**53, 2**53)
    assert len(json.dumps(largest)) * 3 < MAX_PUBNUB_BYTES


def test_a_live_update_is_decoded_as_it_was_encoded():
    live = LiveSample("0123abcd", 3, 5_000, 6_000, {"speed": 1.5, "name": None}, offset_us=-7, next_ms=9_000)
    sent = json.loads(json.dumps(live_update("car", "vesc", live, 8, 9_000)))
    assert decode_live_update(sent) == ("car", "vesc", live, 8, 9_000)
    for bad in (
        7,
        {},
        {**sent, "v": 9},
        {**sent, "robot": "a/b"},
        {**sent, "hops": {}},
        {**sent, "sample": 3},
    ):
        with pytest.raises(ContractError):
            decode_live_update(bad)


# Pings and their pongs.


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


# A viewer's lease is decoded as it was encoded; anything else is refused.

GOOD = Lease(BOOT, 10, VIEW_LEASE_MS)
rates = st.floats(LIVE_MIN_RATE_HZ, LIVE_MAX_RATE_HZ)


@given(st.builds(Lease, boots, rates, st.integers(0, VIEW_LEASE_MS), st.booleans()))
def test_a_lease_is_decoded_as_it_was_encoded(lease: Lease) -> None:
    assert decode_lease(encode_lease(lease)) == lease


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"viewer": "0" * 33}, "viewer"),
        ({"rate_hz": math.nan}, "not JSON"),
        ({"rate_hz": 10.5}, "rate_hz"),
        # No float is so large.
        ({"rate_hz": 10**400}, "rate_hz"),
        ({"lease_ms": VIEW_LEASE_MS + 1}, "lease_ms"),
        ({"lease_ms": -1}, "lease_ms"),
        ({"lease_ms": 1.5}, "lease_ms"),
    ],
)
def test_an_invalid_lease_is_refused(changed: dict[str, object], named: str) -> None:
    with pytest.raises(ContractError, match=named):
        encode_lease(replace(GOOD, **changed))  # type: ignore[arg-type]  # invalid on purpose
    with pytest.raises(ContractError):
        decode_lease(json.dumps({**json.loads(encode_lease(GOOD)), **changed}))


def test_the_topic_is_the_robots_own() -> None:
    assert lease_topic("car7", "lab2") == "view/lab2/car7/lease"
