"""Batch ids are unique within a topic, and as text they sort by time."""

from __future__ import annotations

from decimal import Decimal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iort_contract.limits import ContractError
from iort_contract.messages.batch import Batch, BatchId, batch_id, batches_between, decode_batch, encode_batch
from tests.unit.contract.contract_values import BOOT, LIMIT_US, boots, seqs

times = st.integers(0, LIMIT_US)
ids = st.builds(BatchId, times, boots, seqs)


@given(ids)
def test_an_id_is_parsed_as_it_was_written(one):
    assert batch_id(str(one)) == one


@given(ids, ids)
def test_an_earlier_batch_has_a_smaller_key(one, other):
    if one.t_us != other.t_us:
        assert (str(one) < str(other)) == (one.t_us < other.t_us)
    assert (str(one) == str(other)) == (one == other)


@given(ids, st.none() | times | st.integers(), st.none() | times | st.integers())
def test_a_range_of_times_is_a_range_of_keys(one, first_us, last_us):
    first, last = batches_between(first_us, last_us)
    inside = (first_us is None or first_us <= one.t_us) and (last_us is None or one.t_us <= last_us)
    assert (first <= str(one) <= last) == inside


@pytest.mark.parametrize("at", [0, 1, LIMIT_US])
def test_both_ends_of_a_range_belong_to_it(at):
    first, last = batches_between(at, at)
    greatest = BatchId(at, "f" * 32, 2**53)
    assert first <= str(BatchId(at, "0" * 8, 0)) < str(greatest) <= last
    assert not first <= str(BatchId(at + 1, "0" * 8, 0)) <= last
    if at:
        assert not first <= str(BatchId(at - 1, "f" * 32, 2**53)) <= last


@pytest.mark.parametrize(
    "text",
    [
        None,
        5,
        Decimal(5),
        b"0000000000000005-0123abcd-7",
        "",
        "5",
        f"5-{BOOT}-7",
        f"000000000000005-{BOOT}-7",
        f"00000000000000005-{BOOT}-7",
        f"-000000000000005-{BOOT}-7",
        f"+000000000000005-{BOOT}-7",
        f"000000000000000٣-{BOOT}-7",
        f"0000000000000005-{BOOT.upper()}-7",
        "0000000000000005-0123abc-7",
        f"0000000000000005-{'0' * 33}-7",
        f"0000000000000005-{BOOT}-07",
        f"0000000000000005-{BOOT}--7",
        f"0000000000000005-{BOOT}-",
        f"0000000000000005-{BOOT}",
        f"0000000000000005-{BOOT}-{10**16}",
        f"0000000000000005-{BOOT}-7\n",
        f" 0000000000000005-{BOOT}-7",
        f"0000000000000005-{BOOT}-7-1",
        "x" * 100_000,
    ],
)
def test_an_invalid_id_is_refused(text):
    with pytest.raises(ContractError, match="must be <16 digits of microseconds>-<run>-<number>"):
        batch_id(text)


def test_batches_with_equal_times_have_different_keys():
    """Two publishers, or a recording played twice, give batches of one time that differ in run or number."""
    same_time = [Batch(boot, seq, [7], {}) for boot in ("0badcafe", "deadbeef") for seq in (0, 9, 10)]
    assert len({str(batch.id) for batch in same_time}) == len(same_time)
    assert {decode_batch(encode_batch(batch)).id for batch in same_time} == {b.id for b in same_time}
