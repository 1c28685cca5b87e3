"""docs/messages.md as a reference: each example, table of keys, topic and limit is the code's own."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from typing import Any

import pytest
from awsiot import iotidentity

import contract
from contract import (
    AGENT_FIELDS,
    AGENT_VERSION,
    COMMANDS,
    ROBOT_PARAMETER,
    SERIAL_PARAMETER,
    Address,
    Batch,
    Command,
    ContractError,
    File,
    FileAnswer,
    FileRequest,
    FleetMessage,
    LiveSample,
    MessageType,
    build_topic,
    limits,
)
from contract import account as accounts
from contract.ros1.message import MAX_LAYOUT
from device.tuning import FIELDS, RULES, Tuning, overlay
from functions import cut_off, stored
from functions.echo import pong
from stacks.settings import Settings
from station.shadow import State, outcome
from tests.messages_page import EXAMPLES, PAGE, keys_after, named, rows, section

RUN, T_US = "3f2a9c01d4e5b678", 1_767_261_600_000_000
SAMPLE = {"speed": 25.2, "voltage_input": 11.9, "fault_code": 0}
LIVE = LiveSample(RUN, 12, T_US, T_US + 4_000, SAMPLE, offset_us=-1_500)
HASH = "a591a6d40bf420404a011733cfb7b190d62c65bf0bcda32b57b277d9ad9f146e"
FILE = File("notes.txt", "log", "text/plain", 12, HASH, T_US)
ASKED, KEY = "5f0c2b7a9e1d4c38", contract.file_key("car7", FILE)
URL = f"https://iort-files.s3.eu-west-1.amazonaws.com/{KEY}?X-Amz-Signature=0"
ADDRESS = Address(1, URL, {"content-type": "text/plain", "content-length": "12"})
BATCH = Batch(
    RUN, 41, [T_US, T_US + 20_000, T_US + 40_001], {"speed": [25.2, 25.1, 25.4], "on": [None, True, "x"]}
)
COMMAND = Command(
    session="9b1deb4d3b7d4bad",
    started_us=T_US - 10_000_000,
    seq=3,
    sent_us=T_US,
    valid_ms=2_000,
    message={"speed": 1.0, "steering_angle": 0.1},
    lease_ms=500,
    answer=True,
)
SAID = FleetMessage(RUN, 7, T_US, {"pose": {"position": {"x": 1.5, "y": 0.0, "z": 0.0}}}, -1_500)
PING = contract.encode_ping(17, T_US)
PONG = pong(contract.rule_event(PING, build_topic("ping", "car7", "lambda"), T_US // 1000 + 30))[1]
REFUSED = FileAnswer(
    ASKED, refused="no more than 50000000000 bytes a day, and only of registered robots", again_s=3600
)
UPDATE = json.dumps(contract.live_update("car7", "vesc", LIVE, T_US // 1000 + 30, T_US + 41_000)).encode()


def as_object(decode: Callable[[str], Any]) -> Callable[[dict[str, Any]], Any]:
    return lambda message: decode(json.dumps(message))


# The example's name: what the code writes, what reads it, and what it then reads.
WRITTEN: dict[str, tuple[bytes, Callable[[dict[str, Any]], Any], Any]] = {
    "batch": (contract.encode(BATCH), as_object(contract.decode), BATCH),
    "live": (contract.encode_live(LIVE), as_object(contract.decode_live), LIVE),
    "ping": (PING, as_object(contract.decode_pong), contract.Pong(17, T_US, None)),
    "pong": (PONG, as_object(contract.decode_pong), contract.Pong(17, T_US, T_US // 1000 + 30)),
    "command": (contract.encode_command(COMMAND), as_object(contract.decode_command), COMMAND),
    "fleet": (contract.encode_fleet(SAID), as_object(contract.decode_fleet), SAID),
    "file": (
        contract.encode_file_request(FileRequest(ASKED, FILE, {1: HASH})),
        as_object(contract.decode_file_request),
        FileRequest(ASKED, FILE, {1: HASH}),
    ),
    "answer": (
        contract.encode_file_answer(FileAnswer(ASKED, KEY, addresses=[ADDRESS])),
        as_object(contract.decode_file_answer),
        FileAnswer(ASKED, KEY, addresses=(ADDRESS,)),
    ),
    "refused": (contract.encode_file_answer(REFUSED), as_object(contract.decode_file_answer), REFUSED),
}
SAMPLES: dict[str, accounts.Account | MessageType] = {
    "account": accounts.StreamAccount("vesc", 1500, 1450, 0, 0, 0, 29, ended=False),
    "lost": accounts.SourceAccount("ros1", {"/tf.malformed": 3}),
    "type": MessageType(
        "imu", "/imu", "sensor_msgs/Imu", "6a62c6daae103f4ff57a132d6f95cec2", "Header header\n"
    ),
}
SHADOW = ("desired", "reported")
PROVISIONING = ("csr", "certificate", "register", "registered", "denied")


def test_each_example_is_held_to_the_code() -> None:
    assert EXAMPLES.keys() == {*WRITTEN, *SAMPLES, *SHADOW, *PROVISIONING, "update"}
    assert PAGE.count("```json\n") == len(EXAMPLES)


@pytest.mark.parametrize("name", WRITTEN)
def test_an_example_is_what_the_code_writes_and_reads(name: str) -> None:
    written, read, meant = WRITTEN[name]
    example, of_code = EXAMPLES[name], json.loads(written)
    if name == "batch":  # another zlib packs as well in other bytes
        example, of_code = ({**one, "samples": None} for one in (example, of_code))
    assert example == of_code
    assert read(EXAMPLES[name]) == meant


def test_the_live_update_is_what_the_function_sends() -> None:
    assert EXAMPLES["update"] == json.loads(UPDATE)


@pytest.mark.parametrize("name", sorted(WRITTEN.keys() - {"ping"}))
def test_the_table_has_each_key_and_says_which_are_needed(name: str) -> None:
    _, read, _ = WRITTEN[name]
    needed = keys_after(name)
    assert paths(EXAMPLES[name]) <= needed.keys()
    for path in needed:
        message = without(EXAMPLES[name], path)
        if needed[path]:
            with pytest.raises(ContractError):
                read(message)
        else:
            read(message)


def paths(message: dict[str, Any]) -> set[str]:
    """The keys of a message, and of the file in it."""
    file = {f"file.{key}" for key in message.get("file", {})}
    return message.keys() - {"file"} | file


def without(message: dict[str, Any], path: str) -> dict[str, Any]:
    less = copy.deepcopy(message)
    *above, last = path.split(".")
    inner = less[above[0]] if above else less
    inner.pop(last, None)
    return less


@pytest.mark.parametrize(("name", "sample"), SAMPLES.items())
def test_the_samples_of_a_robots_own_streams(name: str, sample: accounts.Account | MessageType) -> None:
    assert EXAMPLES[name] == sample.sample()
    read = contract.message_type if name == "type" else accounts.account
    assert read(EXAMPLES[name]) == sample
    if name == "account":
        text = section("## A robot's own streams")
        assert {key for row in rows(text) for key in named(row[0])} == EXAMPLES[name].keys()


def test_the_agents_own_figures_are_all_told() -> None:
    text = section("## A robot's own streams").split("**`agent`**")[1]
    assert {named(row[0])[0]: row[1] for row in rows(text)} == AGENT_FIELDS


def test_the_shadows_documents_are_what_the_agent_takes_and_says() -> None:
    base = Tuning(True, True, 10.0, 0, "info")
    tuning, rejected = overlay(base, EXAMPLES["desired"]["state"]["desired"], {})
    assert rejected == {}
    reported = EXAMPLES["reported"]["state"]["reported"]
    assert {key: reported[key] for key in tuning.as_document()} == tuning.as_document()
    assert reported.keys() == {*tuning.as_document(), "rejected", COMMANDS, AGENT_VERSION}
    state = State(1, {}, reported)
    assert outcome(state, "drive", COMMAND.session, COMMAND.seq) == contract.ACCEPTED
    assert [refusal.name for refusal in state.refusals()] == ["live.rate_hz"]
    wishes, said = section("## The shadow").split("<!-- example: reported -->")
    assert {name for row in rows(wishes) for name in named(row[0])} == {*RULES, f"{FIELDS}.<stream>"}
    assert {name for row in rows(said) for name in named(row[0])} == reported.keys()


def test_the_messages_of_provisioning_are_those_of_aws_client() -> None:
    found = {name: EXAMPLES[name] for name in PROVISIONING}
    csr = iotidentity.CreateCertificateFromCsrRequest(
        certificate_signing_request=found["csr"]["certificateSigningRequest"]
    )
    assert csr.to_payload() == found["csr"]
    register = iotidentity.RegisterThingRequest(
        certificate_ownership_token=found["register"]["certificateOwnershipToken"],
        parameters=found["register"]["parameters"],
    )
    assert register.to_payload() == found["register"]
    assert found["register"]["parameters"].keys() == {ROBOT_PARAMETER, SERIAL_PARAMETER}
    for name, kind in (
        ("certificate", iotidentity.CreateCertificateFromCsrResponse),
        ("registered", iotidentity.RegisterThingResponse),
        ("denied", iotidentity.V2ErrorResponse),
    ):
        read = kind.from_payload(found[name])
        assert {camel(key): getattr(read, key) for key in read.__slots__} == found[name]


def camel(name: str) -> str:
    first, *rest = name.split("_")
    return first + "".join(map(str.capitalize, rest))


# Limits that are written with their unit; all others are written as they are.
UNITS = {
    "MAX_MESSAGE_BYTES": (1024, "KiB"),
    "MAX_PUBNUB_BYTES": (1024, "KiB"),
    "MAX_COLUMNS_BYTES": (2**20, "MiB"),
    "MAX_SERIALIZED_BYTES": (2**20, "MiB"),
    "PART_BYTES": (2**20, "MiB"),
    "MAX_FILE_BYTES": (2**30, "GiB"),
    "MAX_BATCH_SPAN_US": (1_000_000, "s"),
    "MAX_AHEAD_US": (86_400_000_000, "days"),
    "LIVE_BROKER_EVERY_S": (1, "s"),
    "UPLOAD_URL_S": (1, "s"),
    **dict.fromkeys(("LIVE_MAX_AGE_MS", "CLOCK_MAX_UNCERTAINTY_MS", "FLEET_MAX_AGE_MS"), (1, "ms")),
    **dict.fromkeys(("MAX_VALID_MS", "MAX_LEASE_MS"), (1, "ms")),
    "upload_gb_a_day": (1, "GB"),
}


def test_each_limit_is_told_as_it_is() -> None:
    table = {name: row for row in rows(section("### Of this project")) for name in named(row[2])}
    told = {
        "MAX_LAYOUT": MAX_LAYOUT,
        "SECOND_BATCHES": stored.SECOND_BATCHES,
        "BURST": cut_off.BURST,
        "A_SECOND": cut_off.A_SECOND,
        "upload_gb_a_day": Settings.__dataclass_fields__["upload_gb_a_day"].default,
        **{name: getattr(of, name) for of in (limits, contract) for name in table if hasattr(of, name)},
    }
    assert table.keys() == told.keys()
    for name, value in told.items():
        scale, unit = UNITS.get(name, (1, ""))
        number = value / scale
        plain, grouped = f"{number:g}" if number < 10_000 else f"{number:.0f}", f"{number:,.0f}"
        cell = table[name][1].split(", ") if "_SECOND" in name or name == "BURST" else [table[name][1]]
        assert any(f"{text} {unit}".strip() in cell for text in (plain, grouped)), (name, value, cell)


def test_no_limit_of_the_contract_is_left_out() -> None:
    text = section("## Limits")
    every = {name for name in vars(limits) if name.isupper() and not name.startswith("_")}
    every |= {name for name in contract.__all__ if name.startswith("MAX_")}
    assert {name for name in every if f"`{name}`" not in text} == set()


def test_every_text_and_link_of_the_table_of_contents_is_there() -> None:
    titles = {
        line[3:].lower().replace(" ", "-").replace("'", "") for line in PAGE.splitlines() if line[:3] == "## "
    }
    linked = {link.split(")")[0] for link in PAGE.split("](#")[1:]}
    assert linked <= titles
    assert titles <= linked | {"limits"}
