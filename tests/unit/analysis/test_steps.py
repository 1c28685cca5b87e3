"""Digits become numbers by whole arrays exactly where JSON and the contract's decoder give the same."""

from __future__ import annotations

import base64
import json
import zlib
from itertools import chain

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from iort_analysis.samples.batches import RefusedItems, decode_steps, integers, part, steps_of
from iort_contract.codec import DICTIONARY
from iort_contract.limits import ContractError
from iort_contract.messages.batch import Batch, decode_batch, encode_batch, read_envelope
from testkit.dynamodb import item_of_message
from tests.examples import examples

NUMBER = st.integers(-(10**16) + 1, 10**16 - 1)
LISTS = st.lists(st.lists(NUMBER, min_size=1, max_size=4), min_size=1, max_size=3)
CHARACTER = st.sampled_from([*b'0019-,:[]} .e+"\\ab', 0, 255])
GOOD = Batch("0badcafe", 0, [10, 30, 60], {"a": [1.5, 2, -0.25], "b": [0, 7, 10]})


def damaged(data, text):
    """The text with up to three characters removed, replaced or added."""
    found = bytearray(text)
    for _ in range(data.draw(st.integers(0, 3))):
        place = data.draw(st.integers(0, len(found)))
        found[place : place + data.draw(st.integers(0, 2))] = data.draw(st.lists(CHARACTER, max_size=2))
    return bytes(found)


def message_of(body):
    deflater = zlib.compressobj(zdict=DICTIONARY)
    samples = base64.b64encode(deflater.compress(body) + deflater.flush()).decode()
    return {**json.loads(encode_batch(GOOD)), "samples": samples}


@examples(300)
@given(LISTS, st.data())
def test_integers_are_those_of_json_or_left_to_it(lists, data):
    whole = b"".join(b":" + json.dumps(one, separators=(",", ":")).encode() + b"," for one in lists)
    text = damaged(data, whole)
    found = integers(text, np.array(list(map(len, lists))))
    if text == whole:
        assert found is not None
    if found is not None:
        read = json.loads(b"[" + text[1:-1].replace(b",:[", b",[") + b"]")
        assert found.tolist() == list(chain.from_iterable(read))
        assert list(map(len, read)) == list(map(len, lists))


@examples(300)
@given(st.data())
def test_a_damaged_batch_is_refused_or_read_as_the_contract_does(data):
    body = zlib.decompressobj(zdict=DICTIONARY)
    text = body.decompress(base64.b64decode(json.loads(encode_batch(GOOD))["samples"]))
    message = message_of(damaged(data, text))
    refused = RefusedItems()
    block = part([item_of_message(json.dumps(message).encode())], refused).block
    if refused.count:
        with pytest.raises(ContractError) as raised:
            decode_batch(message)
        assert refused.reason.endswith(f": {raised.value}")
        return
    batch = decode_batch(message)
    assert block.times_us.tolist() == batch.times_us
    assert {name: column.tolist() for name, column in block.columns.items()} == batch.columns


def test_whole_drives_take_the_fast_way():
    batches = [
        Batch("0badcafe", seq, [10**15 + seq, 10**15 + seq + 5], {"a": [seq, 2.5]}) for seq in range(3)
    ]
    run = [steps_of(read_envelope(json.loads(encode_batch(batch)))) for batch in batches]
    assert None not in run
    block = decode_steps(run, lambda name: name == "a")
    assert block.columns["a"].tolist() == [0, 2.5, 1, 2.5, 2, 2.5]
