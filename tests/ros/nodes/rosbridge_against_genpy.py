"""Compares random genpy messages, sent as rosbridge sends them, with genpy's own bytes."""

# ruff: noqa: T201 - standard output goes to the test that started it

from __future__ import annotations

import json
import math
import random
import sys

from iort_agent.ros1.json_message import Writer
from iort_contract.ros1.definition import md5sum, parse
from tests.ros.nodes.made_messages import made, message, plain
from tests.rosbridge_json import as_rosbridge

for case in range(150):
    one, chance = made(case, large=True), random.Random(case)
    definition = parse(one.kind, one.text)
    assert md5sum(definition, one.text) == one.classes[one.kind]._md5sum, (case, one.text)
    for _ in range(5):
        floats = [0.0, -1.5, math.nan, chance.uniform(-1e30, 1e30)]
        _, raw = message(one, chance, floats)
        # A subscriber gets these bytes, and rosbridge is a subscriber.
        received = one.classes[one.kind]().deserialize(raw)
        sent = json.dumps(as_rosbridge(definition, plain(received)))
        written = Writer(definition).write(json.loads(sent))
        assert written == raw, (case, one.text, sent)
print("agreed", sys.version_info[:2])
