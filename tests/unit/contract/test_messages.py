"""Commands and fleet messages are decoded as they were encoded; invalid ones are not encoded."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from dataclasses import replace
from decimal import Decimal
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iort_contract.catalog.analysis import KINDS, PARAMETERS
from iort_contract.checks import json_object
from iort_contract.findings_table import FindingsTable
from iort_contract.limits import MAX_NESTED, ContractError
from iort_contract.messages import analysis, commands, live, questions
from iort_contract.messages.batch import decode_batch, encode_batch
from tests.examples import examples
from tests.unit.contract.contract_values import DEEP, GOOD, GOOD_LIVE, decode_or_refuse

T0 = 1_700_000_000_000_000
MESSAGES = st.dictionaries(
    st.text(max_size=3),
    st.integers()
    | st.booleans()
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.lists(st.none(), max_size=2),
    max_size=4,
)
TIMES = st.integers(0, 2**53 - 1)


@given(
    st.text("0123456789abcdef", min_size=8, max_size=32), st.tuples(TIMES, TIMES), st.integers(0, 2**53),
    st.tuples(st.integers(1, 60_000), st.none() | st.integers(1, 10_000)), MESSAGES,
)  # fmt: skip
def test_a_command_is_decoded_as_it_was_encoded(
    session: str, times: tuple[int, int], seq: int, holds: tuple[int, int | None], message: Any
) -> None:
    command = commands.Command(session, min(times), seq, max(times), holds[0], message, holds[1])
    assert commands.decode_command(commands.encode_command(command)) == command


@given(st.integers(0, 2**53), TIMES, MESSAGES)
def test_a_fleet_message_is_decoded_as_it_was_encoded(seq: int, sent: int, message: Any) -> None:
    heard = commands.FleetMessage("0badcafe", seq, sent, message)
    assert commands.decode_fleet(commands.encode_fleet(heard)) == heard


@pytest.mark.parametrize(
    "change",
    [
        {"session": "x"}, {"session": None}, {"seq": -1}, {"seq": True}, {"started_us": T0 + 1},
        {"sent_us": 1.5}, {"sent_us": 2**60}, {"valid_ms": 0}, {"valid_ms": 60_001}, {"lease_ms": 0},
        {"lease_ms": 10_001}, {"message": []}, {"message": None}, {"message": {"a": float("nan")}},
        {"takeover": 1}, {"ends": None}, {"by": ""}, {"by": "a" * 65}, {"by": "a\nb"},
        {"message": {"a": "x" * 200_000}}, {"message": {"a": {1, 2}}},
    ],
)  # fmt: skip
def test_an_invalid_command_is_refused(change: dict[str, Any]) -> None:
    good = commands.Command("feedbeef", T0, 0, T0, 500, {"data": 1}, 300)
    with pytest.raises(ContractError):
        commands.encode_command(replace(good, **change))
    if not isinstance(change.get("message"), dict):
        with pytest.raises(ContractError):
            commands.decode_command(json.dumps({**json.loads(commands.encode_command(good)), **change}))


@pytest.mark.parametrize(
    "change",
    [{"boot": "x"}, {"seq": -1}, {"sent_us": 2**60}, {"offset_us": 2**60}, {"message": []}, {"v": 2}],
)
def test_an_invalid_fleet_message_is_refused(change: dict[str, Any]) -> None:
    good = commands.FleetMessage("0badcafe", 0, T0, {})
    with pytest.raises(ContractError):
        commands.decode_fleet(json.dumps({**json.loads(commands.encode_fleet(good)), **change}))
    if "v" not in change:
        with pytest.raises(ContractError):
            commands.encode_fleet(replace(good, **change))


# Query messages are decoded as they were encoded; invalid ones are refused.

REQUEST = questions.QueryRequest("car", "vesc", 5, 9, ("speed",), "speed > 1", True, {"topic": {"S": "t"}})
TIMES_US, COLUMNS = [1_700_000_000_000_000, 1_700_000_000_020_000], {"speed": [1.5, None]}
SAMPLES = questions.packed_samples(TIMES_US, COLUMNS)
ANSWER = questions.QueryAnswer(
    2, ("speed",), 3, 1, 1, "codec", {"temp_fet": 2}, {"topic": {"S": "t"}}, SAMPLES
)


@pytest.mark.parametrize("request_", [REQUEST, questions.QueryRequest("car", "vesc")])
def test_a_request_is_decoded_as_it_was_encoded(request_: questions.QueryRequest) -> None:
    assert questions.decode_query_request(json.loads(questions.encode_query_request(request_))) == request_


def test_a_request_needs_only_robot_and_stream_and_its_times_are_clamped() -> None:
    assert questions.decode_query_request({"robot": "car", "stream": "vesc"}) == questions.QueryRequest(
        "car", "vesc"
    )
    far = questions.decode_query_request(
        {"robot": "car", "stream": "vesc", "start_us": -(2**60), "end_us": 2**60}
    )
    assert (far.start_us, far.end_us) == (questions.FIRST_US, questions.LAST_US)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"robot": "a/b"}, "robot name must be"),
        ({"robot": None}, "robot must be a text"),
        ({"stream": "+"}, "stream name must be"),
        ({"start_us": 1.5}, "start_us must be an integer"),
        ({"end_us": True}, "end_us must be an integer"),
        ({"fields": "speed"}, "fields must be a list"),
        ({"fields": [1]}, "fields must be a list"),
        ({"where": 1}, "where must be a text"),
        ({"token": "t"}, "token must be an object"),
    ],
)
def test_an_invalid_request_is_refused(change: dict[str, object], reason: str) -> None:
    with pytest.raises(ContractError, match=reason):
        questions.decode_query_request({"robot": "car", "stream": "vesc", **change})


@pytest.mark.parametrize(
    "answer",
    [
        ANSWER,
        questions.QueryAnswer(url="https://there"),
        questions.QueryAnswer(samples=b""),
        questions.QueryAnswer(error="no condition"),
    ],
)
def test_an_answer_is_decoded_as_it_was_encoded(answer: questions.QueryAnswer) -> None:
    assert questions.decode_query_answer(json.dumps(questions.encode_query_answer(answer))) == answer


@pytest.mark.parametrize(
    "change",
    [
        {"codec": "steps"},
        {"samples": None},
        {"url": "https://there"},
        {"samples": "%"},
        {"n": "many"},
        {"fields": [1]},
        {"absent": [1]},
        {"reason": 1},
    ],
)
def test_an_invalid_answer_is_refused(change: dict[str, object]) -> None:
    with pytest.raises(ContractError):
        questions.decode_query_answer(json.dumps({**questions.encode_query_answer(ANSWER), **change}))


def test_samples_are_unpacked_as_they_were_packed() -> None:
    assert questions.unpacked_samples(SAMPLES) == (TIMES_US, COLUMNS)
    assert questions.unpacked_samples(questions.packed_samples([], {})) == ([], {})
    with pytest.raises(ContractError, match="packs"):
        questions.unpacked_samples(SAMPLES[:-3])


# What every decoder of messages refuses; tests/unit/analysis/test_decoders.py damages valid ones.

DECODERS = [decode_batch, live.decode_live, live.decode_pong]
# Values of boto3 and Python that JSON does not have.
awkward = st.sampled_from(
    [
        *map(Decimal, ("NaN", "sNaN", "Infinity", "1E+999999999999", "1.0", "-0")),
        *(10**5000, b"1", bytearray(b"1"), (), object(), math.nan, "\ud800"),
    ]
)


@examples(200)
@given(st.sampled_from([encode_batch(GOOD), live.encode_live(GOOD_LIVE)]), st.data(), awkward)
def test_a_message_with_an_awkward_value_is_decoded_or_refused(message, data, value):
    envelope = json.loads(message)
    envelope[data.draw(st.sampled_from(sorted(envelope)))] = value
    for decoder in DECODERS[:2]:
        decode_or_refuse(decoder, envelope)


@pytest.mark.parametrize("good", [encode_batch(GOOD), live.encode_live(GOOD_LIVE)], ids=["batch", "live"])
def test_a_message_with_one_key_removed_is_decoded_or_refused(good):
    decoder = decode_batch if b"codec" in good else live.decode_live
    for key in json.loads(good):
        envelope = json.loads(good)
        del envelope[key]
        with pytest.raises(ContractError, match=key):
            decoder(json.dumps(envelope))


@pytest.mark.parametrize("decoder", DECODERS)
@pytest.mark.parametrize(
    "message",
    [
        b"",
        b"null",
        b"\xef\xbb\xbf{}",
        b"\xed\xa0\x80",
        b'{"v":' + b"[" * DEEP,
        b'{"v":' + b"[" * 900 + b"]" * 900 + b"}",
        b'{"v":1e999}',
        b'{"v":NaN}',
        b'{"v":1,"seq":' + b"9" * 5000 + b"}",
        "\ud800",
        '{"v":"\ud800"}',
        None,
        7,
        [],
    ],
)
def test_an_invalid_message_is_refused(decoder, message):
    with pytest.raises(ContractError):
        decoder(message)


TEXTS = st.text('a"\\\\[]{},: \n', max_size=9)
VALUES = st.recursive(TEXTS | st.integers(), lambda some: st.lists(some) | st.dictionaries(TEXTS, some))


def depth(value: Any) -> int:
    some = value.values() if isinstance(value, dict) else value if isinstance(value, list) else None
    return 0 if some is None else 1 + max(map(depth, some), default=0)


@given(st.lists(VALUES, max_size=3), st.integers(MAX_NESTED - 9, MAX_NESTED + 3), st.booleans())
def test_json_is_refused_just_if_it_is_nested_too_deeply(
    values: list[Any], levels: int, objects: bool
) -> None:
    value: Any = values
    for level in range(levels):
        value = {f"[{level}": value} if objects else [[], value]
    message = {"a": value}
    text = json.dumps(message)
    if depth(message) <= MAX_NESTED:
        assert json_object(text, "it") == json_object(text.encode("utf-16"), "it") == message
    else:
        with pytest.raises(ContractError, match="it is nested too deeply"):
            json_object(text, "it")


@pytest.mark.parametrize("end", ["", "\\", '"'])
def test_texts_without_an_end_cost_no_more_than_their_length(end: str) -> None:
    text = "[" * (MAX_NESTED + 1) + "]" * (MAX_NESTED + 1) + '"' + '\\"' * 400_000 + end
    with pytest.raises(ContractError, match="nested too deeply"):
        json_object(text, "it")


DEEP_WHILE_GARBAGE_IS_COLLECTED = """
import gc, sys
from contextlib import suppress
from iort_contract.checks import json_object
from iort_contract.limits import ContractError
class Garbage:
    def __init__(self):
        self.me = self
    def __del__(self):
        self.ended()
    def ended(self):
        pass
limit = sys.getrecursionlimit()
for allocations in range(limit - 60, limit + 60):
    gc.set_threshold(allocations, 1, 1)
    Garbage()
    with suppress(ContractError):
        json_object("[" * 100_000, "it")
print("lives")
"""


def test_no_stack_is_full_when_garbage_is_collected() -> None:
    """Python 3.8 ended the process: "Cannot recover from stack overflow"."""
    command = [sys.executable, "-c", DEEP_WHILE_GARBAGE_IS_COLLECTED]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "lives\n"), done.stderr[:2000]


def test_the_error_for_a_long_value_is_short():
    with pytest.raises(ContractError) as caught:
        decode_batch(dict(json.loads(encode_batch(GOOD)), codec="x" * 10_000))
    assert len(str(caught.value)) < 200


# Findings survive JSON, and anything else is refused.

FINDING = analysis.Finding(
    drive=analysis.DriveKey("car7", 1_700_000_000_000_000, "00c0ffee"),
    kind="battery_worn",
    severity="warning",
    subject="battery_resistance_ohm",
    from_us=1_700_000_000_000_000,
    to_us=1_700_000_060_000_000,
    stream="vesc",
    fields=("voltage_input", "current_input"),
    text="the internal resistance has grown",
    effect=analysis.Estimate(0.03, 0.02, 0.04, "ohm"),
    p=0.001,
)


def test_a_finding_survives_json() -> None:
    assert analysis.decode_finding(json.loads(json.dumps(analysis.encode_finding(FINDING)))) == FINDING


@pytest.mark.parametrize(
    "change",
    [
        {"fields": "voltage_input"},
        {"p": "small"},
        {"p": 10**400},
        {"effect": {"value": 1}},
        {"kind": 7},
        {"run": None},
    ],
)
def test_what_is_no_finding_is_refused(change: dict[str, object]) -> None:
    with pytest.raises(ContractError):
        analysis.decode_finding({**analysis.encode_finding(FINDING), **change})


def test_every_parameter_names_a_kind_that_exists() -> None:
    assert {parameter.kind for parameter in PARAMETERS.values()} - {""} <= KINDS.keys()


# Notes survive their row of the table, by time, and anything else is refused.

FIRST_NOTE_US = 1_700_000_000_000_000


def note(seconds: int = 0, **given: Any) -> analysis.Note:
    told = {"robot": "car7", "text": "changed tyre", "by": "ada@lab", "salt": f"{seconds:08x}"}
    return analysis.Note(t_us=FIRST_NOTE_US + seconds * 1_000_000, **{**told, **given})


class OneTable:
    """The calls of DynamoDB's client that the table of findings makes."""

    def __init__(self) -> None:
        self.items: dict[tuple[str, str], Any] = {}

    def put_item(self, *, TableName: str, Item: Any) -> None:
        self.items[Item["robot"]["S"], Item["finding"]["S"]] = Item

    def delete_item(self, *, TableName: str, Key: Any, ReturnValues: str) -> dict[str, Any]:
        found = self.items.pop((Key["robot"]["S"], Key["finding"]["S"]), None)
        return {} if found is None else {"Attributes": found}

    def query(self, **query: Any) -> dict[str, Any]:
        robot, first, last = (
            query["ExpressionAttributeValues"][f":{n}"]["S"] for n in ("topic", "first", "last")
        )
        keys = sorted(key for key in self.items if key[0] == robot and first <= key[1] <= last)
        return {"Items": [self.items[key] for key in reversed(keys)]}


def test_notes_are_rows_beside_the_findings() -> None:
    table = FindingsTable(OneTable(), "findings")
    table.put_finding(FINDING)
    for seconds in (0, 60, 120):
        table.put_note(note(seconds))
    table.put_note(note(text="another car", robot="car8"))
    assert [one.id for one in table.notes("car7")] == [note(s).id for s in (120, 60, 0)]
    # From a time, inclusive, to a time, exclusive.
    assert list(table.notes("car7", FIRST_NOTE_US, FIRST_NOTE_US + 120_000_000, most=1)) == [note(60)]
    assert list(table.findings("car7")) == [FINDING]
    assert list(table.drives("car7")) == []
    assert table.remove_note("car7", note(60).id)
    assert not table.remove_note("car7", note(60).id)
    assert list(table.notes("car7")) == [note(120), note(0)]


@pytest.mark.parametrize(
    "change",
    [
        {"text": " "},
        {"text": "x" * (analysis.MAX_NOTE_CHARACTERS + 1)},
        {"by": "x" * 65},
        {"t_us": -1},
        {"t_us": 10**16},
        {"salt": "XYZ"},
        {"robot": "car 7"},
    ],
)
def test_what_is_no_note_is_refused(change: dict[str, Any]) -> None:
    with pytest.raises(ContractError):
        analysis.decode_note({**analysis.encode_note(note()), **change})
    with pytest.raises(ContractError):
        analysis.encode_note(analysis.decode_note({**vars(note()), **change}))
