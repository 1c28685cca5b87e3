"""Stored attributes are read as boto3's deserializer reads them, and long numbers that it refuses too."""

from __future__ import annotations

from decimal import Decimal

from boto3.dynamodb.types import TypeDeserializer, TypeSerializer
from hypothesis import given
from hypothesis import strategies as st

from iort_contract.dynamodb import deserialize, plain

numbers = st.integers(-(10**37), 10**37).map(Decimal)
leaves = st.none() | st.booleans() | st.text() | st.binary() | numbers
sets = (
    st.sets(st.text(min_size=1), min_size=1)
    | st.sets(numbers, min_size=1)
    | st.sets(st.binary(min_size=1), min_size=1)
)
values = st.recursive(
    leaves | sets, lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner), max_leaves=20
)


@given(values)
def test_a_value_is_read_as_boto3_reads_it(value):
    stored = TypeSerializer().serialize(value)
    assert deserialize(stored) == TypeDeserializer().deserialize(stored) == value


def test_a_number_that_boto3_refuses_is_read():
    digits = "1" * 40
    assert plain({"n": {"N": digits}, "e": {"N": "1e126"}}) == {"n": Decimal(digits), "e": Decimal("1e126")}
