"""Batches of version 1 are converted without loss to batches of this version."""

from __future__ import annotations

import json
from decimal import Decimal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iort_contract.dynamodb import plain
from iort_contract.limits import ContractError
from iort_contract.messages.batch import Batch, decode_batch, encode_batch
from iort_station.recordings.old_batches import is_old, upgraded, upgraded_item
from tests.fakes import item_of_message
from tests.unit.station.recordings.old_messages import old_envelope, old_message

T0 = 1_700_000_000_000_000
BATCH = Batch("0badcafe", 7, [T0, T0 + 20_000], {"speed": [1.5, None], "mode": ["a", "b"]}, nonfinite=1)
# Written by the agent of a1b2690: columns of every type, one value not finite.
WRITTEN = {
    "v": 1,
    "boot": "0badcafe",
    "seq": 12,
    "t": T0,
    "n": 3,
    "nonfinite": 1,
    "codec": "steps",
    "samples": "eLtoWwuwQ9OIqQUWakY6hqYGOkCka2pkit1lII25EIG80pwcYAQr6UAYMaUGBmnJSkD59Pw8uLwhRBZExNbWAgBoLyjg",
}


def test_a_batch_of_the_older_agent_is_read():
    batch = decode_batch(upgraded(WRITTEN))
    assert batch.id == (T0, "0badcafe", 12)
    assert list(batch.times_us) == [T0, T0 + 20_000, T0 + 40_001]
    assert batch.columns == {
        "speed": [1.5, 2, -3.25],
        "fault_code": [0, 0, 1],
        "mode": ["a", None, "ü"],
        "gone": [1, None, None],
    }
    assert batch.nonfinite == 1


@given(
    seq=st.integers(0, 2**53),
    t_us=st.integers(0, 2**53 - 2),
    speeds=st.lists(st.none() | st.floats() | st.integers(-(2**63), 2**64 - 1), min_size=1, max_size=5),
)
def test_any_batch_is_unchanged_by_the_conversion(seq, t_us, speeds):
    times = [t_us] * len(speeds)
    sent = encode_batch(Batch("0123456789abcdef", seq, times, {"speed": speeds}))
    new = upgraded(old_envelope(decode_batch(sent)))
    assert new == json.loads(sent)


def test_an_item_keeps_its_other_attributes_exactly():
    """The rule's attributes and a robot's unknown attributes."""
    item = item_of_message(old_message(BATCH), expires_s=1_800_000_001)
    item |= {"more": {"N": "1E+125"}, "list": {"L": [{"S": "x"}]}}
    new = upgraded_item(item)
    gone = {"boot", "seq", "t"}
    assert new == {
        **{name: value for name, value in item.items() if name not in gone},
        "v": {"N": "2"},
        "batch": {"S": f"{T0:016}-0badcafe-7"},
    }
    assert decode_batch(plain(new)) == decode_batch(encode_batch(BATCH))


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"v": 3}, "schema version must be 1, got 3"),
        ({"t": -5}, "time must be from 1970 on, got -5 us"),
        ({"t": 1.5}, "t must be an integer, got 1.5"),
        ({"t": None}, "t must be an integer, got None"),
        ({"seq": -1}, "seq must be an integer from 0, got -1"),
        ({"boot": "me"}, "boot must be .*, got 'me'"),
        ({"boot": None}, "boot must be .*, got None"),
        ({"nonfinite": -1}, "nonfinite must be .*, got -1"),
    ],
)
def test_a_batch_without_a_valid_id_is_refused_with_the_reason(changes, reason):
    with pytest.raises(ContractError, match=reason):
        upgraded(old_envelope(BATCH, **changes))


@pytest.mark.parametrize("v", [True, 2, "1", None])
def test_another_version_is_not_old(v):
    assert not is_old({"v": v})
    assert not is_old({})


def test_the_version_of_a_stored_item_may_be_a_decimal():
    assert is_old({"v": Decimal(1)})
