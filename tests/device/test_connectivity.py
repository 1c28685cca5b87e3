"""What `iort-agent check` says of the way to the cloud, with servers that fail in one way each."""

from __future__ import annotations

import os
import shutil
import socket
import ssl
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from datetime import datetime, timedelta, timezone
from pathlib import Path

import pytest
import trustme
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from iort_agent.config import load_config
from iort_agent.sources import FAIL, OK, Finding
from iort_agent.verbs import connectivity
from testkit.ports import free_port
from testkit.waiting import GUARD_S

NOW = datetime.now(timezone.utc)
DAY = timedelta(days=1)
ROBOTS = trustme.CA()


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    """Only a server that never answers lets the time pass."""
    case = getattr(request.node, "callspec", None)
    silent = case is not None and case.id == "silent"
    monkeypatch.setattr(connectivity, "TIMEOUT_S", 0.5 if silent else GUARD_S)


@contextmanager
def serving(answer: Callable[[socket.socket], object], host: str = "127.0.0.1") -> Iterator[int]:
    """A server that gives every connection to ``answer``; yields its port."""
    with socket.create_server((host, 0)) as server:

        def accept() -> None:
            with suppress(OSError):
                while True:
                    connection, _ = server.accept()
                    with closing(connection), suppress(OSError):
                        answer(connection)

        thread = threading.Thread(target=accept)
        thread.start()
        try:
            yield server.getsockname()[1]
        finally:
            server.shutdown(socket.SHUT_RDWR)
            thread.join(GUARD_S)


def dated(authority: trustme.CA, host: str, first: datetime, last: datetime) -> trustme.LeafCert:
    """A server's certificate with these dates, which Python 3.8's trustme cannot make."""
    signer = x509.load_pem_x509_certificate(authority.cert_pem.bytes())
    signing = serialization.load_pem_private_key(authority.private_key_pem.bytes(), None)
    key = ec.generate_private_key(ec.SECP256R1())
    identifier = x509.AuthorityKeyIdentifier.from_issuer_public_key(signer.public_key())
    certificate = (
        x509.CertificateBuilder(signer.subject, x509.Name([]), key.public_key(), 1, first, last)
        .add_extension(x509.SubjectAlternativeName([x509.DNSName(host)]), critical=False)
        .add_extension(identifier, critical=False)
        .sign(signing, hashes.SHA256())
    )
    pem, form = serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8
    private = key.private_bytes(pem, form, serialization.NoEncryption())
    return trustme.LeafCert(private, certificate.public_bytes(pem), [])


def with_tls(leaf: trustme.LeafCert, reply: bytes = b"") -> Callable[..., None]:
    """Answer with TLS, then with the bytes."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    leaf.configure_cert(context)
    context.verify_mode = ssl.CERT_REQUIRED
    ROBOTS.configure_trust(context)

    def answer(connection: socket.socket) -> None:
        with closing(context.wrap_socket(connection, server_side=True)) as secure:
            secure.recv(100)
            secure.sendall(reply)

    return answer


def car(folder: Path, authority: trustme.CA, port: int, endpoint: str, signer: trustme.CA = ROBOTS) -> Path:
    """A bundle of a car of this cloud."""
    leaf = signer.issue_cert("car7")
    leaf.cert_chain_pems[0].write_to_path(folder / "certificate.pem")
    leaf.private_key_pem.write_to_path(folder / "private.key")
    authority.cert_pem.write_to_path(folder / "root-ca.pem")
    file = folder / "car.yaml"
    file.write_text(
        f"robot: car7\nendpoint: {endpoint}\nport: {port}\ncertificate: certificate.pem\n"
        "private_key: private.key\nroot_ca: root-ca.pem\nsources: [{type: sim}]\n"
    )
    return file


def go(file: Path) -> list[Finding]:
    return list(connectivity.check_connection(load_config(file)))


CLOUD, OTHER = trustme.CA(organization_name="lab"), trustme.CA(organization_name="another")
GOOD = CLOUD.issue_cert("localhost")
REFUSES = b"\x20\x03\x00\x87\x00"


@pytest.mark.parametrize(
    ("answer", "what", "text", "todo"),
    [
        (
            lambda one: one.recv(100) and one.sendall(b"HTTP/1.1 400 no\r\n\r\n"),
            "TLS",
            "not with TLS",
            "8883",
        ),
        (lambda one: one.recv(1) and one.recv(9999) and one.recv(1), "TLS", "says nothing for", "hangs"),
        (lambda _: None, "TLS", "ends before TLS", "broker is down"),
        (
            with_tls(OTHER.issue_cert("localhost")),
            "server certificate",
            "O=another, which is not in",
            "another cloud's",
        ),
        (
            with_tls(CLOUD.issue_cert("lab")),
            "server certificate",
            "is for lab, and not for localhost",
            "LISTEN=ADDRESS,localhost",
        ),
        (
            with_tls(dated(CLOUD, "localhost", NOW - 9 * DAY, NOW - DAY)),
            "server certificate",
            f"ended on {NOW - DAY:%Y-%m-%d}",
            "set the clock",
        ),
        (
            with_tls(dated(CLOUD, "localhost", NOW + DAY, NOW + 9 * DAY)),
            "server certificate",
            f"is valid from {NOW + DAY:%Y-%m-%d}",
            "set the clock",
        ),
        (with_tls(GOOD), "broker", "hangs up on car7", "`iort robots list`"),
        (with_tls(GOOD, REFUSES), "broker", "refuses car7: not authorized", "thing car7"),
        # An older broker refuses the version in two bytes.
        (with_tls(GOOD, b"\x20\x02\x00\x01"), "broker", "not in MQTT 5", "is `port` right"),
        (with_tls(GOOD, b"\x20" + b"\xff" * 9), "broker", "not in MQTT 5", "is `port` right"),
    ],
    ids=[
        *("http", "silent", "hung-up", "authority", "name", "ended", "early"),
        *("certificate", "refused", "mqtt-3", "no-mqtt"),
    ],
)
def test_what_the_server_does_wrong_is_named_with_a_remedy(
    tmp_path: Path, answer: Callable[..., object], what: str, text: str, todo: str
) -> None:
    with serving(answer) as port:
        findings = go(car(tmp_path, CLOUD, port, "localhost"))
    (failed,) = [one for one in findings if one.level == FAIL]
    assert failed.what == what
    assert text in failed.text
    assert todo in failed.todo
    # What is before the failure is good, and what is after it was not tried.
    names = [one.what for one in findings]
    steps = ["name", "route", "port", "server certificate", "broker", "clock"]
    assert names == [*steps[: len(names) - 2], what, "clock"]


def test_a_bundle_of_another_cloud_is_named(tmp_path: Path) -> None:
    with serving(with_tls(GOOD)) as port:
        findings = go(car(tmp_path, CLOUD, port, "localhost", signer=OTHER))
    assert "the cloud does not know who signed" in findings[-2].text
    assert "`iort robots add`" in findings[-2].todo


def test_a_name_and_a_port_that_lead_nowhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    *_, port, _ = go(car(tmp_path, CLOUD, free_port(), "127.0.0.1"))
    assert "127.0.0.1 answers, but nothing listens on" in port.text
    assert "`make up LISTEN=ADDRESS`" in port.todo

    def unknown(*_: object, **__: object) -> None:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    name, _ = go(car(tmp_path, CLOUD, 8883, "cloud.lab"))
    assert (name.what, name.level) == ("name", FAIL)
    assert name.text == "cloud.lab does not resolve: Name or service not known"
    assert "/etc/hosts" in name.todo


def in_namespace(*commands: str) -> subprocess.CompletedProcess[str]:
    """Run shell commands as root of a network of their own."""
    unshare = ["unshare", "--net"] if os.geteuid() == 0 else ["unshare", "--user", "--map-root-user", "--net"]
    return subprocess.run(
        [*unshare, "sh", "-ec", "\n".join(commands)],
        capture_output=True,
        text=True,
        timeout=GUARD_S,
        check=False,
    )


def namespaces() -> bool:
    """Whether this process may make networks."""
    return all(map(shutil.which, ("unshare", "ip"))) and in_namespace("ip link set lo up").returncode == 0


@pytest.mark.skipif(not namespaces(), reason="needs iproute2, and root or user namespaces")
@pytest.mark.parametrize(
    ("network", "what", "text", "todo"),
    [
        ("", "route", "none to 10.9.9.1: Network is unreachable", "Wi-Fi or the cable"),
        ("ip route add blackhole 10.9.9.1", "route", "none to 10.9.9.1: Invalid", "Wi-Fi or the cable"),
        # Nobody has the address: the kernel asks for it in vain.
        (
            "ip route add 10.9.9.0/24 dev car",
            "port",
            "no machine answers for 10.9.9.1",
            "in the same network",
        ),
        # Like a firewall that drops what comes.
        (
            "ip route add 10.9.9.1 dev car; ip neigh add 10.9.9.1 lladdr 02:00:00:00:00:01 dev car",
            "port",
            "no answer from 10.9.9.1:8883 in 5 s",
            "open port 8883 on the cloud's machine",
        ),
        ("ip addr add 10.9.9.1/24 dev car", "port", "10.9.9.1 answers, but nothing listens", "`make up`"),
    ],
    ids=["no-network", "blackhole", "nobody", "firewall", "no-broker"],
)
def test_a_network_without_a_way_to_the_cloud(
    tmp_path: Path, network: str, what: str, text: str, todo: str
) -> None:
    file = car(tmp_path, CLOUD, 8883, "10.9.9.1")
    done = in_namespace(
        "ip link set lo up",
        "ip link add car type veth peer name cloud",
        "ip addr add 10.8.8.2/24 dev car",
        "ip link set cloud up",
        "ip link set car up",
        network,
        f"{Path(sys.executable).parent / 'iort-agent'} check --config {file} || true",
    )
    assert f"{FAIL}  {what}: {text}" in done.stdout, done.stdout + done.stderr
    assert todo in done.stdout.partition(f"{what}: ")[2].splitlines()[1]
    assert f"{OK}    name: 10.9.9.1 is an address" in done.stdout
