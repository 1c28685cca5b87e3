"""Files from a robot into the bucket, on the embedded cloud with enforcement on."""

from __future__ import annotations

import base64
import hashlib
import http.client
import io
import json
import os
import ssl
import subprocess
import sys
import threading
import uuid
from dataclasses import replace
from pathlib import Path, PurePath
from typing import Any
from urllib.parse import urlsplit

import boto3
import pytest
from botocore.config import Config
from ministack.services import iot
from PIL import Image
from rosbags.rosbag1 import Reader

from iort_agent.common.threads import SystemClock
from iort_agent.files.file import read
from iort_agent.files.upload import ByteRate, Outcome, Sender, trusting
from iort_contract.messages.files import (
    FILES_PREFIX,
    PART_BYTES,
    Address,
    File,
    FileAnswer,
    FileRequest,
    decode_file_answer,
    encode_file_request,
    file_key,
)
from iort_contract.topics import FILE, PING, PONG, build_topic
from iort_station.fleet import files, robots
from iort_station.operations import audit
from local.deployment import ROOT
from testkit.mqtt import Robot
from testkit.waiting import GUARD_S, until
from tests.images import TOPIC, jpeg, write_bag
from tests.local.data.drives import Agent

CONTENT = b"a small file"
T_US = 1_700_000_000_000_000


class Bucket:
    """The files' bucket as the operator sees it."""

    def __init__(self, embedded: Any) -> None:
        self.client = embedded.cloud.client("s3")
        self.name = embedded.cloud.output("storage", "FilesBucket")

    def keys(self, robot: str) -> list[str]:
        found = self.client.list_objects_v2(Bucket=self.name, Prefix=f"{FILES_PREFIX}{robot}/")
        return [one["Key"] for one in found.get("Contents", ())]

    def content(self, key: str) -> bytes:
        body: bytes = self.client.get_object(Bucket=self.name, Key=key)["Body"].read()
        return body

    def parts(self, robot: str) -> list[int]:
        """Return the parts of the robot's only unfinished upload."""
        listed = self.client.list_multipart_uploads(Bucket=self.name, Prefix=f"{FILES_PREFIX}{robot}/")
        for begun in listed.get("Uploads", ()):
            there = self.client.list_parts(Bucket=self.name, Key=begun["Key"], UploadId=begun["UploadId"])
            return [part["PartNumber"] for part in there.get("Parts", ())]
        return []


@pytest.fixture
def bucket(embedded):
    return Bucket(embedded)


def upload(car, *files, env=None):
    """Run the robot's own command."""
    command = [Path(sys.executable).parent / "iort-agent", "upload", "--config", car.config, "--json", *files]
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=GUARD_S, env=env
    )
    return done.returncode, json.loads(done.stdout or "[]"), done.stderr


def test_the_upload_command_uploads_small_and_large_files(embedded, bundle, bucket, tmp_path):
    car = bundle()
    small, large = tmp_path / "notes.txt", tmp_path / "drive.bag"
    small.write_bytes(CONTENT)
    large.write_bytes(os.urandom(2 * PART_BYTES + 12_345))
    status, results, err = upload(car, small, large, tmp_path / "missing.bag")
    assert status == 1
    assert "missing.bag: No such file" in err
    assert [one["error"] is None for one in results] == [True, True, False]
    for path, result in zip((small, large), results, strict=False):
        assert bucket.content(result["key"]) == path.read_bytes()
        head = bucket.client.head_object(Bucket=bucket.name, Key=result["key"])
        assert head["Metadata"]["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
    # A second upload finds the stored file.
    assert upload(car, small)[1][0]["key"] == results[0]["key"]
    # The operator's side.
    stored = {one.name: one for one in files.listed(embedded.cloud, car.robot)}
    assert {name: one.size for name, one in stored.items()} == {
        path.name: path.stat().st_size for path in (small, large)
    }
    got = files.download(embedded.cloud, stored["drive.bag"], tmp_path / "got")
    assert got.read_bytes() == large.read_bytes()


def test_a_large_upload_resumes_after_the_agent_is_killed(bundle, bucket, tmp_path):
    folder = tmp_path / "bags"
    folder.mkdir()
    large = folder / "drive.bag"
    content = os.urandom(20 * 1024 * 1024)
    large.write_bytes(content)
    watched = {"folder": str(folder), "settle_s": 1, "remove_after_s": 0}
    source = {"type": "sim", "stream": "vesc", "rate_hz": 10}
    car = bundle(sources=[source], files={**watched, "rate_kb_s": 1500})
    agent = Agent(car)
    until(lambda: bucket.parts(car.robot))
    agent.kill()
    there = bucket.parts(car.robot)
    assert not bucket.keys(car.robot)
    assert large.exists()

    robots.configure(car, {"files": {**watched, "rate_kb_s": 0}})
    agent = Agent(car)
    (key,) = until(lambda: bucket.keys(car.robot))
    assert bucket.content(key) == content
    until(lambda: not large.exists())
    status = agent.told()["files"]
    agent.process.terminate()
    agent.report()
    # Parts that were stored before the kill were not sent again.
    sizes = {1: PART_BYTES, 2: PART_BYTES, 3: len(content) - 2 * PART_BYTES}
    assert there
    assert status["sent_bytes"] == sum(size for part, size in sizes.items() if part not in there)
    assert (status["waiting"], status["uploaded"], status["last_error"]) == (0, 1, None)


def test_pictures_of_a_recording_are_uploaded_as_attachments(embedded, bundle, bucket, iort, tmp_path):
    pictures = [jpeg(seed) for seed in range(4)]
    assert min(map(len, pictures)) > iot._MAX_PAYLOAD_BYTES
    path = write_bag(tmp_path / "camera.bag", pictures, hz=2)
    source = {"type": "bag", "path": str(path), "topics": {TOPIC: "camera"}, "large": "upload"}
    car = bundle(sources=[source], files={"large_folder": "large", "rate_kb_s": 0})
    agent = Agent(car)
    report = agent.report()
    columns: dict[str, list[Any]] = {}
    for batch in audit.batches(embedded.cloud, car.robot, "camera"):
        for name, values in batch.columns.items():
            columns.setdefault(name, []).extend(values)
    assert columns["format"] == ["jpeg"] * 4
    # One content a second, of two samples a second.
    keys = columns["data.key"]
    assert [key is not None for key in keys] == [True, False, True, False]
    for i in (0, 2):
        assert bucket.content(keys[i]) == pictures[i]
        assert columns["data.sha256"][i] == hashlib.sha256(pictures[i]).hexdigest()
        with Image.open(io.BytesIO(base64.b64decode(columns["data.thumbnail"][i]))) as small:
            assert small.size == (96, 72)
    assert sorted(bucket.keys(car.robot)) == sorted(filter(None, keys))
    assert report["files"]["large"] == {"kept": 2, "not_due": 2, "left_out": 0}
    assert report["streams"]["camera"]["refused"] == 0
    assert not list((car.folder / "large").glob("*/*"))
    # An export puts the contents back; a picture without an uploaded content is empty.
    exported = tmp_path / "exported.bag"
    done = iort("export", car.robot, "camera", "--out", str(exported))
    assert done.exit_code == 0, done.output
    went, came = raws(path), raws(exported)
    assert [raw in came for raw in went] == [True, False, True, False]
    assert sorted(map(len, came))[:2] == [len(went[i]) - len(pictures[i]) for i in (1, 3)]


def raws(path: Path) -> list[bytes]:
    with Reader(path) as reader:
        return [bytes(raw) for _, _, raw in reader.messages()]


# --- forbidden requests, sent by hand with the robot's own certificate ----------------------------------


class FileRequester(Robot):
    """A robot that sends file requests by hand."""

    def ask(self, request: FileRequest) -> FileAnswer:
        assert self.publish(build_topic(PING, self.name, FILE), encode_file_request(request)) == "SUCCESS"
        while True:
            answer = decode_file_answer(self.next_message()[1])
            if answer.id == request.id:
                return answer


@pytest.fixture
def robot(bundle):
    with FileRequester(bundle().folder) as asking:
        asking.online()
        assert asking.subscribe(build_topic(PONG, asking.name, FILE)) == "GRANTED_QOS_1"
        yield asking


def request_for(content: bytes, name: str = "notes.txt") -> FileRequest:
    sha256 = hashlib.sha256(content).hexdigest()
    file = File(name, "log", "text/plain", len(content), sha256, T_US)
    return FileRequest(uuid.uuid4().hex, file, {1: sha256})


@pytest.fixture
def put(embedded):
    """Send a body to an address unchanged; return the status and the code of S3's error."""
    context = ssl.create_default_context(cafile=embedded.cloud.ca_bundle)

    def send(address: Address, body: bytes) -> tuple[int, str]:
        url = urlsplit(address.url)
        connection = http.client.HTTPSConnection(
            url.hostname or "", url.port, context=context, timeout=GUARD_S
        )
        connection.request("PUT", f"{url.path}?{url.query}", body, dict(address.headers))
        answer = connection.getresponse()
        text = answer.read().decode()
        connection.close()
        return answer.status, text.partition("<Code>")[2].partition("</Code>")[0]

    return send


def test_an_address_accepts_one_content_under_one_key_once(robot, put, bucket):
    (address,) = robot.ask(request_for(CONTENT)).addresses
    key = file_key(robot.name, request_for(CONTENT).file)
    more = {**address.headers, "content-length": str(len(CONTENT) + 1)}
    unconditional = {n: v for n, v in address.headers.items() if n != "if-none-match"}
    other = address.url.replace(f"/{robot.name}/", "/another/")
    assert other != address.url
    assert put(address, CONTENT[::-1]) == (400, "BadDigest")
    for changed, body in (
        (replace(address, headers=more), CONTENT + b"x"),
        (replace(address, headers=unconditional), CONTENT),
        (replace(address, url=other), CONTENT),
        (replace(address, url=address.url.replace("notes.txt", "other.txt")), CONTENT),
    ):
        assert put(changed, body) == (403, "SignatureDoesNotMatch")
    assert bucket.keys(robot.name) == bucket.keys("another") == []
    assert put(address, CONTENT) == (200, "")
    assert put(address, CONTENT) == (412, "PreconditionFailed")
    assert bucket.keys(robot.name) == [key]
    assert robot.ask(request_for(CONTENT)).stored


def test_a_part_address_accepts_only_its_content(robot, put):
    content = bytes(PART_BYTES) + b"rest"
    sha256 = hashlib.sha256(content).hexdigest()
    file = File("drive.bag", "recording", "application/x-rosbag", len(content), sha256, T_US)
    rest = hashlib.sha256(b"rest").hexdigest()
    (address,) = robot.ask(FileRequest(uuid.uuid4().hex, file, {2: rest})).addresses
    assert put(address, b"evil") == (400, "BadDigest")
    elsewhere = replace(address, url=address.url.replace("partNumber=2", "partNumber=1"))
    assert put(elsewhere, b"rest") == (403, "SignatureDoesNotMatch")
    assert put(address, b"rest") == (200, "")
    assert robot.ask(FileRequest(uuid.uuid4().hex, file, {2: rest})).have == ((2, 2),)


def test_a_robot_can_neither_request_nor_receive_for_another(robot):
    request = encode_file_request(request_for(CONTENT))
    assert robot.publish(build_topic(PING, "another", FILE), request) == "NOT_AUTHORIZED"
    assert robot.subscribe(build_topic(PONG, "another", FILE)) == "NOT_AUTHORIZED"
    assert robot.subscribe(f"{PONG}/iort/+/{FILE}") == "NOT_AUTHORIZED"
    assert robot.publish(build_topic(PONG, robot.name, FILE), b"{}") == "NOT_AUTHORIZED"


def test_the_daily_upload_quota_is_enforced(robot, embedded):
    table = embedded.cloud.output("storage", "RobotsTable")
    assert robot.ask(request_for(CONTENT)).addresses
    embedded.cloud.client("dynamodb").update_item(
        TableName=table,
        Key={"robot": {"S": robot.name}},
        UpdateExpression="SET files_bytes = :most",
        ExpressionAttributeValues={":most": {"N": str(50 * 10**9)}},
    )
    answer = robot.ask(request_for(b"another"))
    assert answer.refused is not None
    assert "bytes a day" in answer.refused


def test_an_expired_address_is_stale(embedded, bucket, robot, tmp_path):
    """Addresses live for 15 minutes; this one is signed for a second, with the operator's own key."""
    cloud = embedded.cloud
    signer = boto3.client(
        "s3",
        region_name=cloud.region,
        endpoint_url=cloud.endpoint_url,
        aws_access_key_id=cloud.access_key_id,
        aws_secret_access_key=cloud.secret_access_key,
        config=Config(signature_version="s3v4"),
    )
    url = signer.generate_presigned_url(
        "put_object", Params={"Bucket": bucket.name, "Key": "results/expired"}, ExpiresIn=1
    )
    path = tmp_path / "notes.txt"
    path.write_bytes(CONTENT)
    local = read(tmp_path, PurePath(path.name), stop=threading.Event())
    clock = SystemClock()
    sender = Sender(trust=trusting(Path(cloud.ca_bundle)), rate=ByteRate(clock, 0))
    address = Address(1, url, {"content-length": str(len(CONTENT))})

    def sent():
        return sender.put(address, local, 0, len(CONTENT), threading.Event())

    put = until(lambda: (one := sent()).outcome is not Outcome.STORED and one)
    assert put.outcome is Outcome.STALE
    assert "403" in put.text
