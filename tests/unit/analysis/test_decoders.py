"""Every decoder of what is stored or received raises the contract's error only, whatever the damage."""

from __future__ import annotations

import base64
import json
import struct
import zlib
from collections.abc import Callable, Mapping
from functools import partial
from random import Random
from typing import Any, NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iort_analysis.drives.stretches import recorded
from iort_analysis.samples.batches import RefusedItems, batches_of, blocks, part
from iort_contract.archive import ArchivedHour, Pending, archived_hour, parse_hour, parse_pending
from iort_contract.codec import DICTIONARY, flat_second, packed, unpacked
from iort_contract.dynamodb import plain
from iort_contract.limits import ContractError
from iort_contract.messages import account, analysis, batch, commands, files, live, questions
from iort_contract.messages.envelope import event_message, rule_event
from iort_contract.messages.shadow import decode_desired, decode_reported
from iort_contract.ros.columns import as_columns, decoder_of, from_columns, view
from iort_contract.ros.definition import parse
from iort_contract.ros.message import Messages, MessageType, RosType, message_type, pack, unpack
from iort_contract.topics import parse_topic
from iort_contract.track import parse_track, track_of
from testkit.dynamodb import item_of
from tests.examples import examples
from tests.mutation import mutated_bytes, mutated_item, mutated_json, mutated_value
from tests.unit.contract.ros.ros1_messages import HEADER, header, text
from tests.unit.contract.ros.ros2_messages import HEADER as ROS2_HEADER
from tests.unit.contract.ros.ros2_messages import Cdr

T_US, RUN = 1_700_000_000_000_000, "0badcafe"
FLAT = RosType("/flat", "a_msgs/S", "2", "Header header\nfloat64 x\nuint8 n" + HEADER)
NAMES = RosType("/names", "a_msgs/N", "3", "string[] names\nuint8[] data\nfloat64[] x")
FLAT_2 = RosType("/flat", "a_msgs/msg/S", "2", "std_msgs/Header header\nfloat64 x\nuint8 n" + ROS2_HEADER)
NAMES_2 = RosType("/names", "a_msgs/msg/N", "3", "string[] names\nwstring w\nuint8[] data\nfloat64[] x")
LAYOUTS = {kind.id: kind.layout for kind in (FLAT, NAMES, FLAT_2, NAMES_2)}
RAWS = [header() + struct.pack("<dB", i / 2, i) for i in range(3)]
TEXTS = [struct.pack("<I", 2) + text("a") + text("b") + struct.pack("<I", 0) * 2 for _ in range(3)]
RAWS_2 = [Cdr().header().put("d", i / 2).put("B", i).data for i in range(3)]
TEXTS_2 = [
    Cdr(order).put("I", 2).text("a", "b").wide("ab").put("I", 1).put("B", 9).put("I", 0).data
    for order in "<>>"
]
TIMES = [T_US, T_US + 1000, T_US + 2000]
BATCHES = [
    batch.Batch(RUN, 3, TIMES, {"speed": [1.5, 2.25, 3], "mode": ["a", None, True], "n": [1, 2, 3]}, 1),
    batch.Batch(RUN, 0, TIMES, {"speed": [1.5, 2.25, 3], "volts": [7, 8, 9]}, 0, None, ()),
    batch.Batch(RUN, 4, TIMES, {}, 0, Messages(FLAT.id, FLAT.layout, RAWS)),
    batch.Batch(RUN, 5, TIMES, {"note": ["a", "b", None]}, 0, Messages(NAMES.id, NAMES.layout, TEXTS)),
    batch.Batch(RUN, 6, TIMES, {}, 0, Messages(FLAT_2.id, FLAT_2.layout, RAWS_2)),
    batch.Batch(RUN, 7, TIMES, {"note": ["a", "b", None]}, 0, Messages(NAMES_2.id, NAMES_2.layout, TEXTS_2)),
]
ITEMS = list(map(item_of, BATCHES))
PACKED, ABOUT = as_columns(BATCHES[2].messages, TIMES)
_, ABOUT_2 = as_columns(BATCHES[4].messages, TIMES)
COLUMNS = {name: unpacked(name, column, len(TIMES)) for name, column in PACKED.items()}
DRIVE, ESTIMATE = analysis.DriveKey("car7", T_US, RUN), analysis.Estimate(0.03, 0.02, 0.04, "ohm")
FINDING = analysis.Finding(
    DRIVE, "battery_worn", "warning", "a", 1, 2, "vesc", ("volts",), "worn", ESTIMATE, ESTIMATE, 0.1
)
FILE = files.File("a/b.bag", "recording", "application/x-rosbag", 5, "0" * 64, T_US)
SHADOW = {
    "live": {"rate_hz": 5},
    "rejected": {"live.rate_hz": {"value": 50, "reason": "must be 0.1 to 10"}},
    "commands": {"go": {"session": RUN, "seq": 1, "outcome": "done"}},
    "stops": {"robot": {"by": "me", "t_ms": 1}},
    "over_share": {"since_ms": 1, "last_ms": 2, "batches": 3},
    "drive": commands.encode_limits(commands.DriveLimits("go", "speed", "angle", 1.0, 0.4, 300)),
}
ROW = ArchivedHour("dt/iort/car/vesc", "2023-11-14T22", "a.parquet", 1, 2, 0, "c", "d", 5, 6, 7).item()
TRACK = "# x_m, y_m, w_right_m, w_left_m\n0, 0, 1, 1\n4, 0, 1, 1\n4, 4, 1, 1\n0, 4, 1, 1\n"


def json_of(value: Any) -> Any:
    return json.loads(json.dumps(value))


def columns(items: Any) -> None:
    """The columns' decoder passes over what is not a batch, and counts it."""
    refused = RefusedItems()
    found = part(items, refused).block
    assert len(found.times_us) or refused.count
    list(blocks([items], RefusedItems(), {"speed"}.__contains__))


class Decoder(NamedTuple):
    """How something valid is damaged, and what reads it."""

    mutate: Callable[[Random, Any], Any]
    decode: Callable[[Any], Any]
    valid: tuple[Any, ...]
    # Whether everything is decoded to something.
    total: bool = False


def of_texts(decode: Callable[[Any], Any], *valid: str) -> Decoder:
    def damaged(random: Random, value: str) -> Any:
        return mutated_bytes(random, value.encode()).decode("latin-1")

    return Decoder(damaged, decode, valid)


of_bytes = partial(Decoder, mutated_bytes)
of_json = partial(Decoder, mutated_json)
of_values = partial(Decoder, mutated_value)
of_items = partial(Decoder, mutated_item)
MESSAGES = tuple(map(batch.encode_batch, BATCHES))
LIVE = live.LiveSample(RUN, 4, T_US, T_US + 5, {"speed": 1.5, "mode": "a"}, 0, 7, 100)
DECODERS: Mapping[str, Decoder] = {
    # The record lane.
    "batch": of_json(batch.decode_batch, MESSAGES),
    "batch of an item": of_items(lambda item: batch.decode_batch(plain(item)), ITEMS),
    "item": of_items(lambda item: batch.decode_item(plain(item)), ITEMS),
    "messages of an item": of_items(lambda item: batch.messages_of(plain(item), LAYOUTS), ITEMS),
    "columns of items": of_items(lambda item: columns([ITEMS[0], item, ITEMS[1]]), ITEMS),
    "columns of an item": of_items(lambda item: columns([item]), ITEMS),
    "batches of items": of_items(lambda item: list(batches_of([ITEMS[0], item])), ITEMS, total=True),
    "drive": of_items(lambda item: recorded(DRIVE, T_US + 9999, "vesc", [ITEMS[0], item]), ITEMS, total=True),
    "batch id": of_texts(batch.batch_id, f"{T_US}-{RUN}-3"),
    "run ends": of_texts(batch.run_ends, f"{RUN}-3 1{RUN}-0", ""),
    "column": of_values(
        lambda value: unpacked("a", value, 3), (packed([1, 2, 4]), packed([0.5, 1, 2]), [None, "a", 1, True])
    ),
    "topic": of_texts(parse_topic, "dt/iort/car/vesc"),
    # ROS messages.
    "ROS messages": of_bytes(
        lambda body: view(unpack(body, 3)), tuple(pack(one.messages) for one in BATCHES[2:])
    ),
    "ROS columns": of_values(
        lambda about: from_columns(COLUMNS, json.dumps(about), TIMES, LAYOUTS),
        (json.loads(ABOUT), json.loads(ABOUT_2)),
    ),
    "ROS message": of_bytes(decoder_of(NAMES.layout).decode, (TEXTS[0],)),
    "ROS message of numbers": of_bytes(decoder_of(FLAT.layout).decode, (RAWS[0],)),
    "ROS definition": of_texts(
        lambda text: parse("a_msgs/S", text), "Header header\nfloat64[3] x\nuint8 N=5\n" + HEADER
    ),
    "ROS layout": of_texts(lambda text: decoder_of(text).decode(RAWS[0]), FLAT.layout),
    "ROS 2 message": of_bytes(decoder_of(NAMES_2.layout).decode, (TEXTS_2[0], TEXTS_2[1])),
    "ROS 2 message of numbers": of_bytes(decoder_of(FLAT_2.layout).decode, (RAWS_2[0],)),
    "ROS 2 definition": of_texts(
        lambda text: parse("a_msgs/msg/S", text), "string<=3[<=5] s\nfloat64 f 1\nint8 N=5\n" + ROS2_HEADER
    ),
    "ROS 2 layout": of_texts(lambda text: decoder_of(text).decode(RAWS_2[0]), FLAT_2.layout),
    "message type": of_values(message_type, (MessageType("s", "/s", "a/A", "1", "float64 x").sample(),)),
    # The live lane and the pings.
    "live": of_json(live.decode_live, (live.encode_live(LIVE),)),
    "live update": of_values(
        live.decode_live_update,
        (live.live_update("car", "vesc", LIVE, 1, 2), live.live_update("car", "vesc", LIVE)),
    ),
    "pong": of_json(live.decode_pong, (live.encode_ping(7, T_US),)),
    "event": of_values(event_message, (rule_event(b"x", "live/iort/car/vesc", 5),)),
    # To and from robots.
    "command": of_json(
        commands.decode_command,
        (commands.encode_command(commands.Command(RUN, 1, 2, 3, 400, {"a": 1}, 100, True, "me")),),
    ),
    "fleet message": of_json(
        commands.decode_fleet, (commands.encode_fleet(commands.FleetMessage(RUN, 1, T_US, {"a": 1}, 5)),)
    ),
    "lease": of_json(live.decode_lease, (live.encode_lease(live.Lease(RUN, 5.0, 1000)),)),
    "limits": of_values(commands.decode_limits, (SHADOW["drive"],), total=True),
    "desired": of_values(decode_desired, (SHADOW,), total=True),
    "reported": of_values(decode_reported, (SHADOW,), total=True),
    "account": of_values(
        account.account,
        (
            account.StreamAccount("vesc", 5, 5, 0, 0, 0, 2, ended=True).sample(),
            account.SourceAccount("ros", {"/a.empty": 2}).sample(),
        ),
    ),
    # Requests and their answers.
    "query request": of_values(
        questions.decode_query_request,
        (
            json.loads(
                questions.encode_query_request(questions.QueryRequest("car", "vesc", 5, 9, ("a",), "a > 1"))
            ),
        ),
    ),
    "query answer": of_json(
        questions.decode_query_answer,
        (
            json.dumps(
                questions.encode_query_answer(
                    questions.QueryAnswer(2, ("a",), 3, 1, 1, "codec", {"a": 2}, None, b"x")
                )
            ).encode(),
        ),
    ),
    "query samples": of_bytes(
        questions.unpacked_samples, (questions.packed_samples(TIMES, {"a": [1, None, "x"]}),)
    ),
    "query samples' text": of_json(
        lambda text: questions.unpacked_samples(zlib.compress(text)),
        (zlib.decompress(questions.packed_samples(TIMES, {"a": [1, None, "x"], "b": [1, 2, 3]})),),
    ),
    "file request": of_json(
        files.decode_file_request, (files.encode_file_request(files.FileRequest(RUN, FILE, {1: "0" * 64})),)
    ),
    "file answer": of_json(
        files.decode_file_answer,
        (
            files.encode_file_answer(
                files.FileAnswer(
                    RUN, "k", stored=False, have=((1, 2),), addresses=(files.Address(3, "u", {"a": "b"}),)
                )
            ),
        ),
    ),
    "file key": of_texts(files.parse_file_key, files.file_key("car", FILE)),
    "question": of_json(
        questions.decode_ask, (questions.encode_ask(questions.Ask(RUN, T_US, 500, {"a": 1}, 5)),)
    ),
    "answer": of_json(questions.decode_answer, (questions.encode_answer(questions.Answer(RUN, {"a": 1})),)),
    "track": of_texts(parse_track, TRACK),
    "track of lists": of_values(track_of, (json_of(vars(parse_track(TRACK))),)),
    # The analysis.
    "finding": of_values(analysis.decode_finding, (json_of(analysis.encode_finding(FINDING)),)),
    "note": of_values(
        analysis.decode_note, (analysis.encode_note(analysis.Note("car7", T_US, "a", "me", "0badcafe")),)
    ),
    "analysis request": of_values(
        lambda content: analysis.decode_request(content, T_US),
        (analysis.encode_request(analysis.AnalysisRequest(("car",), 1, 9)), {"last_s": 60}),
    ),
    "planned drive": of_values(
        analysis.decode_planned,
        (analysis.encode_planned(analysis.PlannedDrive(DRIVE, T_US + 5, ("vesc",), "vesc")),),
    ),
    "analysed drive": of_values(
        analysis.decode_analysed,
        (
            json_of(
                analysis.encode_analysed(
                    analysis.AnalysedDrive(DRIVE, 5, "job", 9, {"a": ESTIMATE}, {"b": "no"}, {"c": 1})
                )
            ),
        ),
    ),
    # The archive and the summary.
    "manifest row": of_items(archived_hour, (ROW,)),
    "hour": of_texts(parse_hour, "2023-11-14T22"),
    "pending": of_items(parse_pending, (Pending("dt/iort/car/vesc", "2023-11-14T22").key,)),
    "second": of_values(flat_second, ({"n": 5, "speed": [1, 2, 3, 4], "volts": [7]},), total=True),
}


def decode_or_refuse(decoder: Decoder, value: Any) -> None:
    try:
        decoder.decode(value)
    except ContractError as error:
        assert not decoder.total
        str(error).encode()  # the error can be logged, whatever the message held


@pytest.mark.parametrize("name", DECODERS)
def test_what_is_valid_is_decoded(name: str) -> None:
    for valid in DECODERS[name].valid:
        DECODERS[name].decode(valid)


@pytest.mark.parametrize("name", DECODERS)
@examples(100)
@given(st.randoms(use_true_random=False))
def test_what_is_damaged_is_decoded_or_refused(name: str, random: Random) -> None:
    decoder = DECODERS[name]
    decode_or_refuse(decoder, decoder.mutate(random, random.choice(decoder.valid)))


def of_raw_bytes() -> list[str]:
    return [name for name, one in DECODERS.items() if one.mutate in (mutated_bytes, mutated_json)]


@pytest.mark.parametrize("name", of_raw_bytes())
@given(st.binary(max_size=300))
def test_any_bytes_are_decoded_or_refused(name: str, content: bytes) -> None:
    decode_or_refuse(DECODERS[name], content)


@pytest.mark.parametrize(
    "body", [b"1]}}", b"]}}", b'"]}}', b'{"dt"]}}', b'{"dt":[0],"fields":{"a]}}', b'{"dt":[0]}}']
)
def test_a_body_of_few_quotes_is_refused(body: bytes) -> None:
    """Such a body once ended every reader of its robot."""
    deflater = zlib.compressobj(6, zdict=DICTIONARY)
    packed_body = base64.b64encode(deflater.compress(body) + deflater.flush()).decode()
    refused = RefusedItems()
    found = part([{**ITEMS[0], "samples": {"S": packed_body}}, ITEMS[1]], refused)
    assert (refused.count, len(found.block.times_us)) == (1, 3)
