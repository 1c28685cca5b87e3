"""All readers of a message agree: if one refuses it, every reader refuses it."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from iort_analysis.samples.batches import RefusedItems, blocks
from iort_contract.dynamodb import plain
from iort_contract.limits import ContractError
from iort_contract.messages import commands
from iort_contract.messages.batch import Batch, batch_id, decode_batch, decode_item, messages_of
from iort_contract.messages.live import LiveSample, decode_live, encode_live
from iort_station.operations.audit import audit
from testkit.dynamodb import item_of, serialize

T_US = 1_700_000_000_000_000
RUN = "0badcafe"
NO_RUNS = ["run-1", "0BADCAFE", "0badcaf", "0" * 33, "", "0badcafe ", "0badcafg"]
PAGE = Path(__file__).parents[4] / "station" / "web" / "src" / "base" / "contract.ts"


def stored(**changes):
    """A stored batch as DynamoDB returns it, with these changes."""
    item = item_of(Batch(RUN, 3, [T_US], {"speed": [1.5]}))
    return {**item, **{name: serialize(value) for name, value in changes.items()}}


def by_columns(item):
    """Read by the station's numpy back end."""
    refused = RefusedItems()
    found = list(blocks([[item]], refused))
    assert refused.count == (not found)
    return bool(found)


def read(reader, message):
    try:
        reader(message)
    except ContractError:
        return False
    return True


def by_contract(reader):
    return lambda item: read(reader, plain(item))


READERS = {
    "Lambda 2": by_contract(decode_item),
    "decode": by_contract(decode_batch),
    "messages": by_contract(lambda item: messages_of(item, {})),
    "columns": by_columns,
}
# The audit cannot see these faults: it reads only the key and two counts.
BODIES = [{"nonfinite": -1}, {"nonfinite": 10**9}, {"v": 1}, {"n": 2}, {"codec": "later"}]
IDS = [
    f"{T_US}-run-1-3",
    f"{T_US}-run-1",
    "run-1",
    f"{T_US}-{RUN.upper()}-3",
    f"{T_US}-{RUN}-03",
    f"{T_US}-{RUN}-{2**53 + 1}",
    f"{2**53}-{RUN}-3",
    f"{T_US}-{RUN}-\u0663",
]


@pytest.mark.parametrize("changes", [{}, *BODIES, *({"batch": one} for one in IDS)], ids=str)
def test_every_reader_of_a_stored_batch_gives_the_same_verdict(changes):
    item = stored(**changes)
    said = {name: reads(item) for name, reads in READERS.items()}
    assert set(said.values()) == {not changes}, said


@pytest.mark.parametrize("text", IDS)
def test_the_audit_refuses_an_invalid_id(text):
    with pytest.raises(ContractError):
        batch_id(text)
    assert audit("vesc", [{"batch": text, "n": "1", "received_ms": "1"}]).refused == 1


def saying(message, **changes):
    return json.dumps({**json.loads(message), **changes}).encode()


def test_every_lane_and_the_page_accept_the_same_run_names():
    live = encode_live(LiveSample(RUN, 1, T_US, T_US, {}))
    fleet = commands.encode_fleet(commands.FleetMessage(RUN, 1, T_US, {}))
    command = commands.encode_command(commands.Command(RUN, T_US, 1, T_US, 100, {}))
    page = re.search(r"^export const BOOT = /\^(.*)\$/;$", PAGE.read_text(), re.MULTILINE)
    assert page is not None
    for name, allowed in [(RUN, True), ("0" * 32, True)] + [(one, False) for one in NO_RUNS]:
        said = {
            "record": by_contract(decode_batch)(stored(batch=f"{T_US}-{name}-3")),
            "live": read(decode_live, saying(live, boot=name)),
            "fleet": read(commands.decode_fleet, saying(fleet, boot=name)),
            "cmd": read(commands.decode_command, saying(command, session=name)),
            "page": re.fullmatch(page[1], name) is not None,
        }
        assert set(said.values()) == {allowed}, (name, said)
