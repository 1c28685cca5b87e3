"""Messages flattened many at once are as the contract flattens them one by one."""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from iort_analysis.samples.blocks import Column
from iort_analysis.samples.messages import Flattener
from iort_contract.limits import Value
from iort_contract.ros.columns import view
from iort_contract.ros.message import Messages, RosType
from tests.examples import examples
from tests.unit.contract.ros.ros_values import by_rosbags, definitions, text_of, values

HASH = "RIHS01_" + "ab" * 32


def check(kind: RosType, raws: Sequence[bytes]) -> None:
    flat = Flattener(kind).flat(raws)
    for i, raw in enumerate(raws):
        found, _ = view(Messages(kind.id, kind.layout, [raw]))
        own = {name: plain(flat.columns[name], i) for name in flat.shapes[flat.shape_of[i]]}
        assert own == {name: column[0] for name, column in found.items()}
        assert list(own) == list(found)
        # What a message does not have is null.
        others = flat.columns.keys() - own
        assert all(plain(flat.columns[name], i) is None for name in others)


def plain(column: Column, i: int) -> Value:
    value: Any = column.tolist()[i]
    if isinstance(value, float) and np.isnan(value):
        return None
    return value


@examples(200)
@given(st.data(), st.booleans())
def test_any_messages(data: Any, ros2: bool) -> None:
    definition = data.draw(definitions(ros2=ros2))
    some = data.draw(st.lists(values(definition), min_size=1, max_size=5))
    # Messages of one form, and of others between them.
    chosen = [some[random.Random(i).randrange(len(some))] for i in range(12)]
    little = data.draw(st.lists(st.booleans(), min_size=12, max_size=12)) if ros2 else [True] * 12
    raws = [by_rosbags(definition, one, little_endian=end) for one, end in zip(chosen, little, strict=True)]
    check(RosType("/made", definition.kind, HASH, text_of(definition)), raws)


@pytest.mark.parametrize("raws", [[b""], [b"\0\1\0\0", b"\0\1\0\0\0\0\0\0"], [bytes(200)]])
def test_what_is_no_message_has_no_fields(raws: list[bytes]) -> None:
    kind = RosType("/made", "a_msgs/msg/A", HASH, "float64 x\nstring name")
    assert Flattener(kind).flat(raws).columns == {}
    check(kind, raws)


def test_a_type_that_cannot_be_read_has_no_fields() -> None:
    kind = RosType("/made", "a_msgs/msg/A", HASH, "this is no definition")
    flat = Flattener(kind).flat([b"one", b"two"])
    assert (flat.columns, flat.shapes, flat.shape_of.tolist()) == ({}, [()], [0, 0])


def test_integers_beyond_53_bits_stay_exact() -> None:
    kind = RosType("/made", "a_msgs/msg/A", HASH, "uint64 big\nint64 small")
    raws = [b"\0\1\0\0" + big.to_bytes(8, "little") + (7).to_bytes(8, "little") for big in (2**53 + 1, 5)]
    flat = Flattener(kind).flat(raws)
    assert flat.columns["big"].tolist() == [2**53 + 1, 5]
    assert flat.columns["small"].tolist() == [7.0, 7.0]
