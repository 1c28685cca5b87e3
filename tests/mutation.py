"""Damages what is stored or received, from a seed: bytes, JSON, items of DynamoDB and batches within them."""

from __future__ import annotations

import base64
import copy
import json
import math
import zlib
from random import Random
from typing import Any

from iort_contract.codec import DICTIONARY

Item = dict[str, Any]
# What stands where something else should.
ODD: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 2**31, 2**53, 2**63, 2**64, 10**400, -(10**400)),
    *(0.5, -0.0, 1e308, 5e-324, math.nan, math.inf),
    *("", "a", "NaN", "1e9", "\ud800", "\x00", "é" * 3000, "2023-11-14T22", "1700000000000000-0badcafe-0"),
    *([], [[]], [None], {}, {"": {}}, {"a": 1}),
)
# What an attribute of a stored item may be.
ODD_ATTRIBUTES: tuple[Any, ...] = (
    *({"N": text} for text in ("-1", "0", "1E+125", "9" * 38, "-" + "9" * 30, "0.5", "1E-130", "2", "50001")),
    *(
        {"S": text}
        for text in ("", "50", "steps", "ros1", "ros2", "9" * 16 + "-0badcafe-0", "x" * 4000, "\x00é")
    ),
    *({"B": b"50"}, {"BOOL": True}, {"NULL": True}, {"L": [{"N": "2"}]}, {"M": {"a": {"S": "b"}}}),
    *({"SS": ["a"]}, {"NS": ["1"]}),
)
# What DynamoDB gives never, and a damaged file may hold.
NO_ATTRIBUTES: tuple[Any, ...] = (
    *({}, {"X": "1"}, {"S": 5}, {"S": "\ud800"}, {"N": None}, {"N": "NaN"}, {"N": "x"}, {"N": ""}),
    *({"S": "a", "N": "1"}, None, "50", 7),
)
_TEXT = b'0123456789"[]{},:-.eE\\ntrufalsNI \x00\xff'


def mutated_bytes(random: Random, content: bytes) -> bytes:
    """One to three bytes changed, inserted or removed; or a part cut out, repeated or cut off."""
    out = bytearray(content)
    for _ in range(random.choice((1, 1, 1, 2, 3))):
        at, end = sorted(random.randrange(len(out) + 1) for _ in range(2))
        kind = random.randrange(7)
        if kind == 0 and at < len(out):
            out[at] ^= 1 << random.randrange(8)
        elif kind == 1 and at < len(out):
            out[at] = random.choice(_TEXT)
        elif kind == 2:
            out.insert(at, random.choice(_TEXT))
        elif kind == 3:
            del out[at : at + 1]
        elif kind == 4:
            del out[at : min(end, at + 40)]
        elif kind == 5:
            out[at:at] = out[at : min(end, at + 40)]
        else:
            del out[at:]
    return bytes(out)


def mutated_value(random: Random, value: Any) -> Any:
    """A copy of a value of JSON with one node replaced, removed, repeated or renamed."""
    value = copy.deepcopy(value)
    places = list(_places(value))
    if not places:
        return value
    inside, key = random.choice(places)
    kind = random.randrange(5)
    if kind == 0:
        del inside[key]
    elif kind == 1 and isinstance(inside, list):
        inside.insert(key, copy.deepcopy(inside[key]))
    elif kind == 2 and isinstance(inside, dict):
        inside[random.choice(("", "a.b", "\ud800", "A" * 2000, f"{key}0"))] = inside.pop(key)
    elif kind == 3 and type(inside[key]) in (int, float):
        inside[key] = random.choice((-inside[key], inside[key] * 10**6, inside[key] + 1, str(inside[key])))
    else:
        inside[key] = copy.deepcopy(random.choice(ODD))
    return value


def mutated_json(random: Random, text: bytes) -> bytes:
    """A text of JSON, damaged as bytes or as a value."""
    if random.random() < 0.4:
        return mutated_bytes(random, text)
    return json.dumps(mutated_value(random, json.loads(text))).encode()


def mutated_samples(random: Random, samples: str) -> str:
    """The samples of a batch, damaged in their text, in the compressed bytes, or in what was compressed."""
    kind = random.randrange(6)
    if kind == 0:
        return mutated_bytes(random, samples.encode()).decode("latin-1")
    packed = base64.b64decode(samples)
    if kind == 1:
        return base64.b64encode(mutated_bytes(random, packed)).decode()
    text, line, behind = zlib.decompressobj(zdict=DICTIONARY).decompress(packed).partition(b"\n")
    if kind == 2 and behind:
        behind = mutated_json(random, behind) if behind[:1] == b"[" else mutated_bytes(random, behind)
    elif kind < 5:
        text = mutated_bytes(random, text)
    else:
        text = json.dumps(mutated_value(random, json.loads(text)), separators=(",", ":")).encode()
    deflater = zlib.compressobj(1, zdict=DICTIONARY)
    return base64.b64encode(deflater.compress(text + line + behind) + deflater.flush()).decode()


def mutated_item(
    random: Random,
    item: Item,
    keep: frozenset[str] = frozenset(),
    attributes: tuple[Any, ...] = ODD_ATTRIBUTES + NO_ATTRIBUTES,
) -> Item:
    """A stored batch with one or two attributes damaged, except those to ``keep``."""
    item = copy.deepcopy(item)
    for _ in range(random.choice((1, 1, 1, 2))):
        name = random.choice(sorted(item.keys() - keep))
        kind = random.randrange(10)
        if kind == 0:
            del item[name]
        elif kind < 4 or "samples" not in item or not isinstance(item["samples"], dict):
            item[name] = copy.deepcopy(random.choice(attributes))
        elif isinstance(samples := item["samples"].get("S"), str) and isinstance(item.get("codec"), dict):
            try:
                item["samples"] = {"S": mutated_samples(random, samples)}
            except (ValueError, zlib.error):
                del item["samples"]
        if not item.keys() - keep:
            break
    return item


def _places(value: Any) -> Any:
    """Each list or object within a value, with each of its places."""
    keys = range(len(value)) if isinstance(value, list) else list(value) if isinstance(value, dict) else ()
    for key in keys:
        yield value, key
        yield from _places(value[key])
