"""A viewer's lease is decoded as it was encoded; anything else is refused."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iort_contract.limits import LIVE_MAX_RATE_HZ, LIVE_MIN_RATE_HZ, ContractError
from iort_contract.messages.live import VIEW_LEASE_MS, Lease, decode_lease, encode_lease, lease_topic
from tests.unit.contract.contract_values import BOOT, boots, json_values

GOOD = Lease(BOOT, 10, VIEW_LEASE_MS)
rates = st.floats(LIVE_MIN_RATE_HZ, LIVE_MAX_RATE_HZ)


@given(st.builds(Lease, boots, rates, st.integers(0, VIEW_LEASE_MS), st.booleans()))
def test_a_lease_is_decoded_as_it_was_encoded(lease: Lease) -> None:
    assert decode_lease(encode_lease(lease)) == lease


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"viewer": "0" * 33}, "viewer"),
        ({"rate_hz": math.nan}, "rate_hz must be 0.01 to 10, got nan"),
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


@given(st.dictionaries(st.sampled_from(["v", "viewer", "rate_hz", "lease_ms", "broker"]), json_values))
def test_what_is_no_lease_is_refused(changed: dict[str, object]) -> None:
    message = {**json.loads(encode_lease(GOOD)), **changed}
    try:
        lease = decode_lease(json.dumps(message))
    except ContractError:
        return
    assert decode_lease(encode_lease(lease)) == lease


def test_the_topic_is_the_robots_own() -> None:
    assert lease_topic("car7", "lab2") == "view/lab2/car7/lease"
