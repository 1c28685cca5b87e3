"""The examples and tables of keys in docs/reference/messages.md agree with the code."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from typing import Any

import pytest
from awsiot import iotidentity

from functions.echo import pong
from iort_agent.control.shadow import overlay
from iort_agent.lanes import RuntimeSettings
from iort_contract.catalog.streams import (
    CATALOG,
    DRIVE_STREAM,
    INCIDENT_STREAM,
    LOG_STREAM,
    POSE_STREAM,
)
from iort_contract.limits import ContractError
from iort_contract.messages import account as accounts
from iort_contract.messages.batch import Batch, decode_batch, encode_batch
from iort_contract.messages.commands import (
    Command,
    FleetMessage,
    decode_command,
    decode_fleet,
    encode_command,
    encode_fleet,
)
from iort_contract.messages.envelope import rule_event
from iort_contract.messages.files import (
    Address,
    File,
    FileAnswer,
    FileRequest,
    decode_file_answer,
    decode_file_request,
    encode_file_answer,
    encode_file_request,
    file_key,
)
from iort_contract.messages.live import (
    Lease,
    LiveSample,
    Pong,
    decode_lease,
    decode_live,
    decode_pong,
    encode_lease,
    encode_live,
    encode_ping,
    live_update,
)
from iort_contract.messages.questions import (
    OVER_QUOTA,
    Answer,
    Ask,
    Content,
    Refusal,
    decode_answer,
    decode_ask,
    encode_answer,
    encode_ask,
)
from iort_contract.messages.recorder import (
    EVENTS,
    Trigger,
    decode_take,
    decode_trigger,
    encode_take,
    encode_trigger,
    incident,
)
from iort_contract.messages.shadow import CHANGEABLE, decode_desired, decode_reported, encode_reported
from iort_contract.messages.video import (
    OFFER,
    TERMS,
    IceServer,
    Look,
    Show,
    VideoTerms,
    decode_look,
    decode_show,
    encode_look,
    encode_show,
)
from iort_contract.ros.message import MessageType, message_type
from iort_contract.tables import (
    OVER_SHARE,
    PUT_OFF,
    PUT_OFF_LAST_MS,
    PUT_OFF_SINCE_MS,
    ROBOT_PARAMETER,
    SERIAL_PARAMETER,
)
from iort_contract.topics import ACCEPTED, build_topic
from iort_contract.triggers import check_trigger
from iort_station.fleet.control import State, outcome
from tests.messages_page import EXAMPLES, PAGE, keys_after, named, rows, section

RUN, T_US = "3f2a9c01d4e5b678", 1_767_261_600_000_000
SAMPLE = {"speed": 25.2, "voltage_input": 11.9, "fault_code": 0}
LIVE = LiveSample(RUN, 12, T_US, T_US + 4_000, SAMPLE, offset_us=-1_500, next_ms=100)
LEASE = Lease("7c0d5e9a21b4f638", 10, 15_000, broker=True)
RELAY = IceServer(("turn:turn.example.org:3478",), "1767261900:iort", "c2VjcmV0")
SDP = "v=0\r\no=- 4611731400430051336 2 IN IP4 127.0.0.1\r\n"
LOOK = Look("7c0d5e9a21b4f638", "5f0c2b7a9e1d4c38", OFFER, 10_000, SDP, (RELAY,))
SHOW = Show("5f0c2b7a9e1d4c38", TERMS, terms=VideoTerms(640, 480, 15.0, 400))
HASH = "a591a6d40bf420404a011733cfb7b190d62c65bf0bcda32b57b277d9ad9f146e"
FILE = File("notes.txt", "log", "text/plain", 12, HASH, T_US)
ASKED, KEY = "5f0c2b7a9e1d4c38", file_key("car7", FILE)
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
    by="anna",
    takeover=True,
    frame=4711,
)
SAID = FleetMessage(RUN, 7, T_US, {"pose": {"position": {"x": 1.5, "y": 0.0, "z": 0.0}}}, -1_500)
PING = encode_ping(17, T_US)
PONG = pong(rule_event(PING, build_topic("ping", "car7", "lambda"), T_US // 1000 + 30))[1]
REFUSED = FileAnswer(
    ASKED, refused="no more than 50000000000 bytes a day, and only of registered robots", again_s=3600
)
ASK_KEY = file_key("car7", File("ask/track.json", "other", "application/json", 250_000, HASH, T_US))
ANSWER_URL = f"https://iort-files.s3.eu-west-1.amazonaws.com/results/ask/car7/{ASKED}.json?X-Amz-Signature=0"
RESISTANCE = {"value": 0.05, "low": 0.04, "high": 0.06, "unit": "ohm"}
ASKS = {
    "ask": Ask(ASKED, T_US, 10_000, {}, -1_500),
    "ask_file": Ask(ASKED, T_US, 10_000, Content(ASK_KEY, HASH, 250_000)),
}
ANSWERS = {
    "answered": Answer(ASKED, {"parameters": {"battery_resistance_ohm": RESISTANCE}}),
    "answered_file": Answer(ASKED, Content(ANSWER_URL, HASH, 250_000)),
    "unanswered": Answer(ASKED, Refusal(OVER_QUOTA, "60 an hour, and only of registered robots")),
}
UPDATE = json.dumps(live_update("car7", "vesc", LIVE, T_US // 1000 + 30, T_US + 41_000)).encode()


def as_object(decode: Callable[[str], Any]) -> Callable[[dict[str, Any]], Any]:
    return lambda message: decode(json.dumps(message))


# The example's name: the code's encoded message, its decoder, and the decoded value.
WRITTEN: dict[str, tuple[bytes, Callable[[dict[str, Any]], Any], Any]] = {
    "batch": (encode_batch(BATCH), as_object(decode_batch), BATCH),
    "live": (encode_live(LIVE), as_object(decode_live), LIVE),
    "lease": (encode_lease(LEASE), as_object(decode_lease), LEASE),
    "look": (encode_look(LOOK), lambda message: decode_look(json.dumps(message).encode()), LOOK),
    "show": (encode_show(SHOW), as_object(decode_show), SHOW),
    "ping": (PING, as_object(decode_pong), Pong(17, T_US, None)),
    "pong": (PONG, as_object(decode_pong), Pong(17, T_US, T_US // 1000 + 30)),
    "command": (encode_command(COMMAND), as_object(decode_command), COMMAND),
    "fleet": (encode_fleet(SAID), as_object(decode_fleet), SAID),
    "file": (
        encode_file_request(FileRequest(ASKED, FILE, {1: HASH})),
        as_object(decode_file_request),
        FileRequest(ASKED, FILE, {1: HASH}),
    ),
    "answer": (
        encode_file_answer(FileAnswer(ASKED, KEY, stored=False, addresses=[ADDRESS])),
        as_object(decode_file_answer),
        FileAnswer(ASKED, KEY, stored=False, addresses=(ADDRESS,)),
    ),
    "refused": (
        encode_file_answer(REFUSED),
        as_object(decode_file_answer),
        REFUSED,
    ),
    **{name: (encode_ask(ask), as_object(decode_ask), ask) for name, ask in ASKS.items()},
    **{name: (encode_answer(answer), as_object(decode_answer), answer) for name, answer in ANSWERS.items()},
}
SAMPLES: dict[str, accounts.Account | MessageType] = {
    "account": accounts.StreamAccount("vesc", 1500, 1450, 0, 0, 0, 29, ended=False, durable=True),
    "lost": accounts.SourceAccount("ros1", {"/tf.malformed": 3}),
    "type": MessageType(
        "imu", "/imu", "sensor_msgs/Imu", "6a62c6daae103f4ff57a132d6f95cec2", "Header header\n"
    ),
}
STREAMS = (LOG_STREAM, DRIVE_STREAM, POSE_STREAM, INCIDENT_STREAM)
SHADOW = ("desired", "triggers", "reported")
PROVISIONING = ("csr", "certificate", "register", "registered", "denied")


def test_each_example_is_compared_with_the_code() -> None:
    assert EXAMPLES.keys() == {*WRITTEN, *SAMPLES, *STREAMS, *SHADOW, *PROVISIONING, "update"}
    assert PAGE.count("```json\n") == len(EXAMPLES)


@pytest.mark.parametrize("name", WRITTEN)
def test_the_code_writes_and_reads_each_example(name: str) -> None:
    written, read, meant = WRITTEN[name]
    example, of_code = EXAMPLES[name], json.loads(written)
    if name == "batch":  # another version of zlib gives other bytes
        example, of_code = ({**one, "samples": None} for one in (example, of_code))
    assert example == of_code
    assert read(EXAMPLES[name]) == meant


def test_the_function_sends_the_live_update_of_the_page() -> None:
    assert EXAMPLES["update"] == json.loads(UPDATE)


@pytest.mark.parametrize("name", sorted(WRITTEN.keys() - {"ping"}))
def test_the_table_has_each_key_and_marks_the_required_ones(name: str) -> None:
    _, read, _ = WRITTEN[name]
    needed = keys_after(name)
    assert paths(EXAMPLES[name]) <= needed.keys()
    for path in needed:
        message = without(EXAMPLES[name], path)
        if needed[path].needed:
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
    inner, key = place(less, path)
    inner.pop(key, None)
    return less


def with_value(message: dict[str, Any], path: str, value: Any) -> dict[str, Any]:
    other = copy.deepcopy(message)
    inner, key = place(other, path)
    inner[key] = value
    return other


def place(message: dict[str, Any], path: str) -> tuple[dict[str, Any], str]:
    """The object that contains a path's last key, and that key."""
    *above, key = path.split(".")
    return (message[above[0]] if above else message), key


@pytest.mark.parametrize("name", WRITTEN)
def test_an_unknown_key_is_ignored(name: str) -> None:
    _, read, meant = WRITTEN[name]
    assert read({**EXAMPLES[name], "unknown": [1]}) == meant


# The message, the key, the last allowed value, the first refused one, and the page's words.
# Those of live messages, leases, commands and batches are the contract's own tests'.
BOUNDS = [
    ("file", "file.name", "a/b/c/d", "a/b/c/d/e", "up to 4 levels"),
    ("file", "file.name", "a" * 100, "a" * 101, "each up to 100"),
    ("file", "file.name", "0.txt", ".txt", "beginning with a letter or digit"),
    ("file", "file.kind", "other", "film", "`recording`, `image`, `log`, `message` or `other`"),
    ("file", "file.content_type", "image/jpeg", "image/JPEG", "type/subtype in lower case"),
    ("file", "file.size", 64 * 2**30, 64 * 2**30 + 1, "0 to 64 GiB"),
    ("file", "file.t", 0, -1, "from 1970 on"),
    ("file", "parts", {}, {"2": HASH}, "from 1"),
    ("refused", "again_s", 86_400, 86_401, "0 to 86,400"),
    ("look", "viewer", "f" * 32, "f" * 33, "`boot`"),
    ("look", "lease_ms", 15_000, 15_001, "0 to 15,000"),
    ("look", "ice_servers", [{"urls": ["stun:a"]}] * 8, [{"urls": ["stun:a"]}] * 9, "up to 8"),
    ("look", "sdp", "v" * 32 * 1024, "v" * (32 * 1024 + 1), "up to 32 KiB"),
    ("ask", "id", "f" * 32, "F" * 32, "`boot`"),
    ("ask_file", "file.size", 0, -1, "from 0"),
]


@pytest.mark.parametrize(("name", "path", "good", "bad", "told"), BOUNDS)
def test_the_bounds_of_a_key_are_those_of_the_page(
    name: str, path: str, good: Any, bad: Any, told: str
) -> None:
    assert told in keys_after(name)[path].what
    read = WRITTEN[name][1]
    read(with_value(EXAMPLES[name], path, good))
    with pytest.raises(ContractError):
        read(with_value(EXAMPLES[name], path, bad))


def test_the_form_of_boot_is_that_of_the_page() -> None:
    assert "8 to 32 of `0-9a-f`" in section("## What all messages share")
    for good, bad in (("0" * 8, "0" * 7), ("f" * 32, "f" * 33), ("a" * 8, "A" * 8)):
        assert decode_live(json.dumps({**EXAMPLES["live"], "boot": good})).boot == good
        with pytest.raises(ContractError):
            decode_live(json.dumps({**EXAMPLES["live"], "boot": bad}))


@pytest.mark.parametrize(("name", "sample"), SAMPLES.items())
def test_the_samples_of_a_robots_own_streams_equal_the_pages_examples(
    name: str, sample: accounts.Account | MessageType
) -> None:
    assert EXAMPLES[name] == sample.sample()
    read = message_type if name == "type" else accounts.account
    assert read(EXAMPLES[name]) == sample
    if name == "account":
        text = section("## A robot's own streams")
        assert {key for row in rows(text) for key in named(row[0])} == EXAMPLES[name].keys()


@pytest.mark.parametrize("stream", STREAMS)
def test_the_samples_of_a_stream_have_the_catalogues_fields(stream: str) -> None:
    assert list(EXAMPLES[stream]) == [field.name for field in CATALOG[stream].fields]


def test_the_agent_reads_and_writes_the_shadows_documents_of_the_page() -> None:
    base = RuntimeSettings(True, True, 10.0, 0, "info")
    wanted = decode_desired(EXAMPLES["desired"]["state"]["desired"])
    settings, rejected = overlay(base, base, wanted.settings, {})
    assert rejected == {}
    example = EXAMPLES["reported"]["state"]["reported"]
    reported = decode_reported(example)
    assert reported.settings == dict(sorted(settings.by_name().items()))
    assert encode_reported(reported) == example
    assert outcome(State(reported=reported), "drive", COMMAND.session, COMMAND.seq) == ACCEPTED
    assert list(reported.rejected) == ["live.rate_hz"]
    desired, reported_keys = section("## The shadow").split("<!-- example: reported -->")
    assert {name for row in rows(desired) for name in named(row[0])} == set(CHANGEABLE)
    assert {name for row in rows(reported_keys) for name in named(row[0])} == example.keys()


def test_the_recorder_reads_and_writes_the_triggers_of_the_page() -> None:
    wanted = decode_desired(EXAMPLES["triggers"]).recorder
    for name, content in wanted.triggers.items():
        trigger = check_trigger(decode_trigger(name, content))
        written = json.loads(json.dumps(encode_trigger(trigger)))["recorder"]["triggers"][name]
        assert {key: value for key, value in written.items() if value is not None} == content
    for name, content in wanted.takes.items():
        written = encode_take(decode_take(name, content), {})["recorder"]["takes"][name]
        assert {key: value for key, value in written.items() if value is not None} == content
    table = section("## The shadow").split("<!-- example: triggers -->")[1]
    assert {name for row in rows(table) for name in named(row[0])} == vars(Trigger("a")).keys() - {"name"}
    assert all(f"`{event}`" in table for event in EVENTS)
    assert incident(EXAMPLES["incidents"]).state == "uploaded"


def test_the_messages_of_provisioning_equal_those_of_awss_client() -> None:
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


@pytest.mark.parametrize(
    "name",
    [
        OVER_SHARE,
        PUT_OFF,
        PUT_OFF_SINCE_MS,
        PUT_OFF_LAST_MS,
    ],
)
def test_the_page_names_each_key_that_the_cloud_writes_into_the_shadow(name: str) -> None:
    section = PAGE.split("\n## The shadow\n")[1].split("\n## ")[0]
    assert f"`{name}`" in section
