"""Compares our decoder with ROS' genpy, by random message definitions."""

# ruff: noqa: T201 - standard output goes to the test that started it

from __future__ import annotations

import math
import random
import sys

from iort_contract.ros1.decode import Decoder, stamp_ns
from iort_contract.ros1.definition import parse
from tests.flatten import flatten
from tests.ros.nodes.made_messages import made, message, plain

FLOATS = [0.0, -1.5, 2.0**70, math.inf]

for case in range(80):
    one = made(case, large=False)
    sent, raw = message(one, random.Random(case), FLOATS)
    decoder = Decoder(parse(one.kind, one.text))
    values = decoder.decode(raw)
    assert decoder.stamped == one.stamped
    if one.stamped:
        assert stamp_ns(raw) == sent.header.stamp.to_nsec(), case
    expected = flatten(plain(sent), lambda value: value if isinstance(value, dict) else None)
    assert values == expected, (case, one.text, values, expected)
print("agreed", sys.version_info[:2])
