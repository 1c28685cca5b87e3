"""Upload: the robot's requests, the function's answers, and the uploads that its addresses allow."""

from __future__ import annotations

import base64
import hashlib
import json
from dataclasses import replace
from urllib.parse import parse_qs, urlsplit

import pytest

from functions import upload
from functions.shared.quotas import DAY, Quota
from functions.upload import Bucket
from iort_contract.limits import MAX_MESSAGE_BYTES, ContractError
from iort_contract.messages.envelope import rule_event
from iort_contract.messages.files import (
    MAX_ADDRESSES,
    MAX_FILE_BYTES,
    PART_BYTES,
    UPLOAD_URL_S,
    Address,
    File,
    FileAnswer,
    FileRequest,
    decode_file_answer,
    decode_file_request,
    encode_file_answer,
    encode_file_request,
    file_key,
    parse_file_key,
)
from iort_contract.tables import FILES_BYTES, FILES_DAY, ROBOT
from iort_contract.topics import FILE, PING, PONG, build_topic
from testkit.dynamodb import FILES, ROBOTS

NOW_S = 1_700_000_000.0
ID = "0123456789abcdef"


def sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def file_of(content: bytes, name: str = "drive.bag") -> File:
    return File(
        name, "recording", "application/octet-stream", len(content), sha256(content), 1_700_000_000_000_000
    )


def parts_of(content: bytes) -> dict[int, bytes]:
    return {
        i // PART_BYTES + 1: content[i : i + PART_BYTES] for i in range(0, max(1, len(content)), PART_BYTES)
    }


def asking(content: bytes, *parts: int, done: bool = False) -> FileRequest:
    hashes = {n: sha256(part) for n, part in parts_of(content).items()}
    whole = sha256(b"".join(bytes.fromhex(one) for one in hashes.values()))
    return FileRequest(ID, file_of(content), {n: hashes[n] for n in parts}, whole if done else None)


def quota(dynamodb, bytes_a_day):
    return Quota(dynamodb, table=ROBOTS, named=(FILES_DAY, FILES_BYTES), period=DAY, most=bytes_a_day)


SMALL = asking(b"small", 1)


# --- the contract -----------------------------------------------------------------------------------


NAMES = ("../etc/passwd", "/absolute", "a/../b", "a//b", ".hidden", "a/b/c/d/e", "with space", "x" * 101, "")
WRONG = [
    *({"name": name} for name in (*NAMES, None)),
    {"kind": "virus"},
    *({"content_type": kind} for kind in ("text", "text/html\r\nx-evil: 1")),
    *({"size": size} for size in (-1, MAX_FILE_BYTES + 1, 1.5)),
    *({"sha256": digits} for digits in ("ab", "A" * 64)),
    {"t": -1},
]


@pytest.mark.parametrize("wrong", WRONG)
def test_encoder_and_decoder_refuse_an_invalid_file(wrong):
    envelope = json.loads(encode_file_request(SMALL))
    envelope["file"].update(wrong)
    with pytest.raises(ContractError):
        decode_file_request(envelope)
    if "t" not in wrong:
        with pytest.raises(ContractError):
            encode_file_request(replace(SMALL, file=replace(SMALL.file, **wrong)))


PARTS = ({"2": "a" * 64}, {"0": "a" * 64}, {"one": "a" * 64}, {"1": "a"}, [1])
WRONG_REQUESTS = [
    *({"id": "short"}, {"id": 7}, {"v": 2}, {"file": []}, {"parts_sha256": "x"}),
    *({"parts": parts} for parts in PARTS),
]
ADDRESSES = ([{"part": 1}], [{"part": 1, "url": "x", "headers": []}])
WRONG_ANSWERS = [
    *({"key": None}, {"stored": "yes"}, {"have": [[1]]}, {"have": 3}, {"id": None}),
    *({"addresses": addresses} for addresses in ADDRESSES),
    {"refused": "x", "again_s": -1},
]


@pytest.mark.parametrize(
    ("decode", "wrong"),
    [
        *((decode_file_request, {**json.loads(encode_file_request(SMALL)), **one}) for one in WRONG_REQUESTS),
        *(
            (decode_file_answer, {"v": 1, "id": ID, "key": "robots/car/x", "stored": False, **one})
            for one in WRONG_ANSWERS
        ),
    ],
)
def test_an_invalid_request_or_answer_is_refused(decode, wrong):
    with pytest.raises(ContractError):
        decode(json.dumps(wrong))


def test_a_request_asks_for_at_most_as_many_addresses_as_fit_a_message():
    content = file_of(b"")
    large = replace(content, size=PART_BYTES * 20)
    with pytest.raises(ContractError, match="at most 16"):
        encode_file_request(FileRequest(ID, large, dict.fromkeys(range(1, 18), "a" * 64)))
    longest = Address(10_000, "https://x/" + "u" * 3000, {"x-amz-checksum-sha256": "c" * 44})
    answer = FileAnswer(ID, "k" * 500, stored=False, addresses=[longest] * MAX_ADDRESSES)
    assert len(encode_file_answer(answer)) < MAX_MESSAGE_BYTES


@pytest.mark.parametrize(
    "answer",
    [
        FileAnswer(ID, "robots/car/x", stored=True),
        FileAnswer(
            ID,
            "robots/car/x",
            stored=False,
            have=((1, 3), (5, 5)),
            addresses=(Address(4, "https://x", {"a": "b"}),),
        ),
        FileAnswer(ID, refused="no", again_s=60),
        FileAnswer(ID, refused="never"),
    ],
)
def test_a_request_and_its_answer_are_decoded_as_they_were_encoded(answer):
    assert decode_file_answer(encode_file_answer(answer)) == answer
    for request in (SMALL, asking(bytes(PART_BYTES + 1), 1, 2, done=True)):
        assert decode_file_request(encode_file_request(request)) == request


def test_a_files_key_has_its_robot_time_and_content_hash():
    key = file_key("car", SMALL.file)
    assert key == f"robots/car/2023/11/14/221320-{sha256(b'small')[:12]}/drive.bag"
    assert file_key("car", file_of(b"other")) != key
    with pytest.raises(ContractError):
        file_key("../car", SMALL.file)
    assert parse_file_key(key) == ("car", 1_700_000_000, sha256(b"small")[:12], "drive.bag")
    deep = replace(SMALL.file, name="rosbag2_1/metadata.yaml")
    assert parse_file_key(file_key("car", deep)).name == deep.name


@pytest.mark.parametrize(
    "key",
    [
        *("", "results/x", "robots/c r/2023/11/14/221320-0123456789ab/drive.bag"),
        *(
            f"robots/car/2023/{rest}"
            for rest in (
                "11/14/221320-0123456789ab/",
                "13/14/221320-0123456789ab/drive.bag",
                "11/14/221320-0123456789ab/../drive.bag",
                "11/14/221320-0123456789AB/drive.bag",
            )
        ),
    ],
)
def test_an_invalid_key_is_refused(key):
    with pytest.raises(ContractError):
        parse_file_key(key)


# --- the function -----------------------------------------------------------------------------------


class ListsChecksums:
    """moto's client; it adds the checksum of each part, which moto's ListParts omits."""

    def __init__(self, client):
        self._client = client
        self.sha256 = {}

    def __getattr__(self, name):
        return getattr(self._client, name)

    def upload_part(self, **arguments):
        self.sha256[arguments["PartNumber"]] = arguments["ChecksumSHA256"]
        return self._client.upload_part(**arguments)

    def get_paginator(self, name):
        return self if name == "list_parts" else self._client.get_paginator(name)

    def paginate(self, **arguments):
        for page in self._client.get_paginator("list_parts").paginate(**arguments):
            for part in page.get("Parts", ()):
                part["ChecksumSHA256"] = self.sha256[part["PartNumber"]]
            yield page


@pytest.fixture
def s3(s3):
    return ListsChecksums(s3)


@pytest.fixture(autouse=True)
def registered(dynamodb):
    dynamodb.put_item(TableName=ROBOTS, Item={ROBOT: {"S": "car"}})


@pytest.fixture
def ask(s3, dynamodb):
    """Send a request as `car`, or as another named robot."""

    def ask(request, robot="car", *, bytes_a_day=10**9, now_s=NOW_S):
        allotment = quota(dynamodb, bytes_a_day)
        return upload.answer(robot, request, Bucket(s3, FILES), allotment, now_s)

    return ask


def test_a_small_files_address_allows_exactly_this_content_once(ask):
    (address,) = ask(SMALL).addresses
    url = urlsplit(address.url)
    query = {name: value for name, (value,) in parse_qs(url.query).items()}
    # The region's own host: an address on the global one would be redirected.
    assert (url.scheme, url.netloc) == ("https", f"{FILES}.s3.eu-west-1.amazonaws.com")
    assert url.path == "/" + file_key("car", SMALL.file)
    assert query["X-Amz-Expires"] == str(UPLOAD_URL_S)
    signed = set(query["X-Amz-SignedHeaders"].split(";"))
    assert signed == {"host", *address.headers}
    checksum = base64.b64encode(hashlib.sha256(b"small").digest()).decode()
    assert address.headers["x-amz-checksum-sha256"] == checksum
    assert (address.headers["content-length"], address.headers["if-none-match"]) == ("5", "*")
    assert address.headers["x-amz-meta-sha256"] == SMALL.file.sha256


def test_a_parts_address_allows_exactly_this_part(ask):
    content = bytes(PART_BYTES) + b"rest"
    first, second = ask(asking(content, 1, 2)).addresses
    for address, size in ((first, PART_BYTES), (second, 4)):
        query = {name: value for name, (value,) in parse_qs(urlsplit(address.url).query).items()}
        assert query["partNumber"] == str(address.part)
        assert set(query["X-Amz-SignedHeaders"].split(";")) == {"host", *address.headers}
        assert address.headers["content-length"] == str(size)


def test_a_stored_file_is_not_requested_again(ask, s3):
    s3.put_object(Bucket=FILES, Key=file_key("car", SMALL.file), Body=b"small")
    answer = ask(SMALL)
    assert (answer.stored, answer.addresses) == (True, ())
    # A key with the same beginning is another file.
    assert not ask(replace(SMALL, file=replace(SMALL.file, name="drive.ba"))).stored
    assert not ask(SMALL, "car-2", bytes_a_day=0).stored


def put(s3, key, upload_id, part, content):
    checksum = base64.b64encode(hashlib.sha256(content).digest()).decode()
    s3.upload_part(
        Bucket=FILES, Key=key, UploadId=upload_id, PartNumber=part, Body=content, ChecksumSHA256=checksum
    )


def test_a_large_file_resumes_and_becomes_one_object(ask, s3):
    content = bytes(2 * PART_BYTES) + b"rest"
    key, parts = file_key("car", file_of(content)), parts_of(content)
    assert [one.part for one in ask(asking(content, 1, 2, 3)).addresses] == [1, 2, 3]
    (begun,) = s3.list_multipart_uploads(Bucket=FILES)["Uploads"]
    for part in (1, 3):
        put(s3, key, begun["UploadId"], part, parts[part])
    answer = ask(asking(content, 1, 2, 3))
    assert answer.have == ((1, 1), (3, 3))
    assert [one.part for one in answer.addresses] == [2]
    # A robot that reports "done" too early gets the stored parts.
    assert not ask(asking(content, done=True)).stored
    put(s3, key, begun["UploadId"], 2, parts[2])
    assert ask(asking(content, done=True)).stored
    stored = s3.get_object(Bucket=FILES, Key=key)
    assert stored["Body"].read() == content
    assert stored["Metadata"] == {"sha256": sha256(content), "kind": "recording", "t": "1700000000000000"}
    assert ask(asking(content, 1)).stored
    assert "Uploads" not in s3.list_multipart_uploads(Bucket=FILES)


def test_parts_of_another_content_never_become_the_file(ask, s3):
    content = bytes(PART_BYTES) + b"rest"
    key = file_key("car", file_of(content))
    ask(asking(content, 1, 2))
    (begun,) = s3.list_multipart_uploads(Bucket=FILES)["Uploads"]
    put(s3, key, begun["UploadId"], 1, bytes(PART_BYTES))
    put(s3, key, begun["UploadId"], 2, b"evil")
    assert [one.part for one in ask(asking(content, 1, 2)).addresses] == [2]
    answer = ask(asking(content, done=True))
    assert (answer.refused, answer.again_s) == ("the parts stored are not this file's", 0)
    assert "Contents" not in s3.list_objects_v2(Bucket=FILES)
    assert "Uploads" not in s3.list_multipart_uploads(Bucket=FILES)


def test_a_robots_bytes_a_day_are_limited_and_a_large_file_counts_once(ask, dynamodb):
    content = bytes(PART_BYTES + 1)
    limit = {"bytes_a_day": PART_BYTES + 7}
    for _ in range(3):
        assert ask(asking(content, 1), **limit).addresses
    assert ask(SMALL, **limit).addresses
    refused = ask(SMALL, **limit)
    assert "bytes a day" in refused.refused
    assert refused.again_s == 3600
    assert ask(SMALL, **limit, now_s=NOW_S + 86_400).addresses
    row = dynamodb.get_item(TableName=ROBOTS, Key={ROBOT: {"S": "car"}})["Item"]
    assert row[FILES_BYTES] == {"N": "5"}
    # Asking whether a file is stored does not count.
    assert ask(replace(SMALL, parts={}), **limit).refused is None


def test_an_unregistered_robot_gets_no_address(ask, dynamodb):
    assert ask(SMALL, "unregistered").refused
    assert "Item" not in dynamodb.get_item(TableName=ROBOTS, Key={ROBOT: {"S": "unregistered"}})


@pytest.fixture
def deployed(s3, dynamodb, rejected, monkeypatch):
    monkeypatch.setenv("UPLOAD_BYTES_A_DAY", str(10**9))


def event(request, robot="car", **changes):
    """The event that the upload rule makes from a changed request."""
    message = json.dumps({**json.loads(encode_file_request(request)), **changes}).encode()
    return rule_event(message, build_topic(PING, robot, FILE), 1_700_000_000_123)


def test_the_robot_of_the_topic_is_answered_and_counted(deployed, invoke, published, capsys, s3):
    invoke(upload.handler, event(SMALL))
    key = file_key("car", SMALL.file)
    s3.put_object(Bucket=FILES, Key=key, Body=b"small")
    invoke(upload.handler, event(asking(b"small", done=True)))
    (topic, asked), (_, stored) = ((topic, decode_file_answer(payload)) for topic, payload in published())
    assert topic == build_topic(PONG, "car", FILE)
    assert (asked.key, asked.stored, stored.stored) == (key, False, True)
    (address,) = asked.addresses
    assert urlsplit(address.url).netloc == f"{FILES}.s3.eu-west-1.amazonaws.com"
    first, second = map(json.loads, capsys.readouterr().out.splitlines())
    assert (first["FilesAsked"], "FilesStored" in first) == (1, False)
    assert (second["FilesStored"], second["StoredBytes"]) == (1, 5)


def test_a_robot_is_told_the_fault_of_its_request(deployed, invoke, published, capsys):
    invoke(upload.handler, event(SMALL, parts={"9": "x"}))
    ((_, payload),) = published()
    answer = decode_file_answer(payload)
    assert (answer.id, answer.refused, answer.again_s) == (ID, "part must be 1 to 1, got 9", None)
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["FilesRefused"] == 1


def test_a_malformed_request_without_an_id_is_refused(deployed, rejected, invoke, published):
    for message in (b"{}", b"\xff", b"[]", b'{"v":1,"id":7}'):
        invoke(upload.handler, rule_event(message, build_topic(PING, "car", FILE), 1))
        (entry,) = rejected()
        assert entry.payload == message
    assert published() == []
