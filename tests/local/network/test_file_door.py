"""What passes the door to the files, in front of a real gateway."""

from __future__ import annotations

import http.client
import json
import socket
import ssl
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path

import boto3
import pytest
from botocore.config import Config

from iort_contract.messages.files import PART_BYTES
from local.network import servers
from local.network.certificates import Authority, ServerCertificate
from local.network.servers import FileDoor
from testkit.waiting import GUARD_S, until

HOST = "127.0.0.2"
BODY = b"content"
SIGNED_BY_PATH = Config(signature_version="s3v4", s3={"addressing_style": "path"})


@pytest.fixture(scope="module")
def door(embedded, tmp_path_factory) -> Iterator[FileDoor]:
    certificate = ServerCertificate(
        embedded.authority, tmp_path_factory.mktemp("door") / "files.pem", (HOST,)
    )
    certificate.renew()
    with FileDoor(
        HOST,
        0,
        gateway=embedded.cloud.endpoint_url,
        authority=Path(embedded.cloud.ca_bundle),
        bucket=embedded.cloud.output("storage", "FilesBucket"),
        certificate=certificate,
    ) as door:
        yield door


@pytest.fixture
def trusts(embedded) -> ssl.SSLContext:
    return ssl.create_default_context(cadata=embedded.cloud.root_ca_pem)


@pytest.fixture
def begin(trusts, door) -> Callable[..., int]:
    """Begin a request with one header, and send no body; return the status."""

    def status(method: str, path: str, name: str, value: str) -> int:
        connection = http.client.HTTPSConnection(HOST, door.port, context=trusts, timeout=GUARD_S)
        connection.putrequest(method, path)
        connection.putheader(name, value)
        connection.endheaders()
        with closing(connection):
            return connection.getresponse().status

    return status


@contextmanager
def own_door(tmp_path: Path) -> Iterator[tuple[FileDoor, ServerCertificate]]:
    """A door in front of no gateway, and its certificate; `ca.pem` has the authority."""
    authority = Authority()
    certificate = ServerCertificate(authority, tmp_path / "files.pem", (HOST,))
    certificate.renew()
    (tmp_path / "ca.pem").write_text(authority.pem)
    given = {"gateway": "https://127.0.0.1:9", "bucket": "files", "certificate": certificate}
    with FileDoor(HOST, 0, authority=tmp_path / "ca.pem", **given) as door:
        yield door, certificate


@pytest.fixture
def send(trusts, door) -> Callable[..., tuple[int, str]]:
    def request(method: str, path: str, own: str = "127.0.0.1", **headers: str) -> tuple[int, str]:
        connection = http.client.HTTPSConnection(
            HOST, door.port, context=trusts, timeout=GUARD_S, source_address=(own, 0)
        )
        connection.request(method, path, body=BODY if method == "PUT" else None, headers=headers)
        answer = connection.getresponse()
        told = answer.status, answer.read().decode()
        connection.close()
        return told

    return request


@pytest.fixture(scope="module")
def credentials(embedded) -> dict[str, str]:
    """Those of a role that may store robots' files, as the function's that signs."""
    iam, bucket = embedded.cloud.client("iam"), embedded.cloud.output("storage", "FilesBucket")
    anybody = {"Effect": "Allow", "Principal": {"AWS": "*"}, "Action": "sts:AssumeRole"}
    role = iam.create_role(RoleName="door", AssumeRolePolicyDocument=json.dumps({"Statement": [anybody]}))
    may = {"Effect": "Allow", "Action": "s3:PutObject", "Resource": f"arn:aws:s3:::{bucket}/robots/*"}
    iam.put_role_policy(RoleName="door", PolicyName="door", PolicyDocument=json.dumps({"Statement": [may]}))
    got = embedded.cloud.client("sts").assume_role(RoleArn=role["Role"]["Arn"], RoleSessionName="door")
    return got["Credentials"]


@pytest.fixture
def presigned(embedded, door, credentials) -> Callable[..., str]:
    """The path of a signed address for an object."""
    cloud, got = embedded.cloud, credentials

    def sign(bucket: str | None = None, key: str = "robots/x", **keys: str) -> str:
        given = {
            "aws_access_key_id": got["AccessKeyId"],
            "aws_secret_access_key": got["SecretAccessKey"],
            "aws_session_token": got["SessionToken"],
            **keys,
        }
        s3 = boto3.client(
            "s3",
            region_name=cloud.region,
            endpoint_url=f"https://{HOST}:{door.port}",
            config=SIGNED_BY_PATH,
            **given,
        )
        place = {"Bucket": bucket or cloud.output("storage", "FilesBucket"), "Key": key}
        return s3.generate_presigned_url("put_object", Params=place).split(str(door.port), 1)[1]

    return sign


def test_a_signed_request_reaches_the_gateway_which_judges_it(send, presigned):
    path = presigned()
    assert send("PUT", path)[0] == 200
    for refused, why in (
        (f"{path[:-1]}{'1' if path[-1] == '0' else '0'}", "SignatureDoesNotMatch"),
        (path.replace("robots/x", "robots/y"), "SignatureDoesNotMatch"),
        (presigned(key="analysis/x"), "AccessDenied"),
        (presigned(aws_access_key_id="ASIA0123456789ABCDEF"), "InvalidAccessKeyId"),
    ):
        status, text = send("PUT", refused)
        assert (status, why in text) == (403, True), text


@pytest.mark.parametrize(
    "case", ["plain", "owner", "bucket", "twice", "method", "header", "parent", "inside"]
)
def test_nothing_else_passes(send, presigned, embedded, case):
    path = presigned()
    method, target, headers = {
        "plain": ("GET", path.partition("?")[0], {}),
        # No robot gets an address that is signed with the owner's key.
        "owner": ("PUT", presigned(aws_access_key_id="test", aws_secret_access_key="x"), {}),
        "bucket": ("PUT", presigned(bucket="another-bucket"), {}),
        "twice": ("PUT", f"{path}&x-amz-credential=test/20260101/eu-west-1/s3/aws4_request", {}),
        "method": ("DELETE", path, {}),
        "header": ("PUT", path, {"Authorization": "AWS4-HMAC-SHA256 Credential=test/x"}),
        "parent": ("PUT", path.replace("robots/x", "../_ministack/reset"), {}),
        "inside": ("GET", f"/_ministack/health?{path.partition('?')[2]}", {}),
    }[case]
    assert send(method, target, **headers) == (403, "only presigned requests for files pass here\n")


def test_a_header_that_no_signature_covers_copies_nothing(send, presigned, embedded):
    s3, bucket = embedded.cloud.client("s3"), embedded.cloud.output("storage", "FilesBucket")
    s3.put_object(Bucket=bucket, Key="analysis/secret", Body=b"secret")
    headers = {"x-amz-copy-source": f"/{bucket}/analysis/secret"}
    assert send("PUT", presigned(key="robots/copy"), **headers)[0] == 200
    assert s3.get_object(Bucket=bucket, Key="robots/copy")["Body"].read() == BODY


@pytest.mark.parametrize("bound", ["UPLOAD_URL_S", "_PART_S"])
def test_a_part_that_never_ends_gives_its_place_back(door, presigned, begin, monkeypatch, bound):
    monkeypatch.setattr(servers, bound, 0.3)
    assert begin("PUT", presigned(), "Content-Length", "9") == 408
    until(lambda: door._passing.total() == 0)


@pytest.mark.parametrize("told", [("Content-Length", "9"), ("Transfer-Encoding", "chunked")])
def test_a_get_with_a_body_takes_no_place(presigned, begin, told):
    assert begin("GET", presigned(), *told) == 400


@pytest.mark.parametrize("length", ["none", str(PART_BYTES + 1)])
def test_no_body_passes_that_is_larger_than_a_part_of_a_file(presigned, begin, length):
    told = ("Transfer-Encoding", "chunked") if length == "none" else ("Content-Length", length)
    assert begin("PUT", presigned(), *told) == 413


def test_addresses_with_many_requests_leave_places_to_others(door, presigned, trusts, send):
    def begin(stack: ExitStack, own: str) -> None:
        """A request of an address whose body does not come."""
        raw = stack.enter_context(
            socket.create_connection((HOST, door.port), timeout=GUARD_S, source_address=(own, 0))
        )
        slow = stack.enter_context(trusts.wrap_socket(raw, server_hostname=HOST))
        head = f"PUT {presigned()} HTTP/1.1\r\nHost: {HOST}:{door.port}\r\nContent-Length: 9\r\n\r\n"
        slow.sendall(head.encode())

    with ExitStack() as stack:
        for _ in range(servers._MOST_OF_ONE):
            begin(stack, "127.0.0.8")
        until(lambda: door._passing.total() == servers._MOST_OF_ONE)
        # All that one may have, though half of the places are free.
        assert send("PUT", presigned(), own="127.0.0.8")[0] == 503
        for _ in range(servers._MOST_OF_ONE - 1):
            begin(stack, "127.0.0.9")
        begin(stack, "127.0.0.10")
        until(lambda: door._passing.total() == servers._MOST - servers._FIRST)
        # All that are for requests after the first; the first request of another address.
        assert send("PUT", presigned(), own="127.0.0.9")[0] == 503
        assert send("PUT", presigned(), own="127.0.0.7")[0] == 200
        for number in range(servers._FIRST):
            begin(stack, f"127.0.1.{number + 1}")
        until(lambda: door._passing.total() == servers._MOST)
        assert send("PUT", presigned(), own="127.0.0.7")[0] == 503
    until(lambda: send("PUT", presigned(), own="127.0.0.8")[0] == 200)


def test_a_connection_that_never_asks_is_closed(tmp_path, monkeypatch):
    monkeypatch.setattr(servers, "_IDLE_S", 0.2)
    with (
        own_door(tmp_path) as (door, _),
        socket.create_connection((HOST, door.port), timeout=GUARD_S) as raw,
        # On a slow machine its end comes before that of the handshake.
        suppress(ConnectionError, ssl.SSLEOFError),
        ssl.create_default_context(cafile=tmp_path / "ca.pem").wrap_socket(
            raw, server_hostname=HOST
        ) as silent,
    ):
        silent.sendall(b"GET /files/")
        assert silent.recv(1) == b""


def test_the_door_takes_over_a_renewed_certificate(tmp_path):
    with own_door(tmp_path) as (door, certificate):
        shown = [ssl.get_server_certificate((HOST, door.port)).strip()]
        certificate.path.unlink()
        assert certificate.renew()
        # The first connection after the change tells the door.
        shown += [ssl.get_server_certificate((HOST, door.port)).strip() for _ in range(2)]
    assert [one in certificate.path.read_text() for one in shown] == [False, False, True]
