"""A certificate file's id, validity and key."""

from __future__ import annotations

import base64
import datetime as dt
import os
import subprocess
import sys
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from hypothesis import given
from hypothesis import strategies as st

from iort_agent.common.threads import SystemClock
from iort_agent.errors import IdentityError, UplinkError
from iort_agent.identity import check_pair, parse_certificate, read_certificate, stamp
from iort_agent.mqtt.aws import IotCore
from iort_agent.mqtt.dispatch import Dispatcher
from iort_agent.verbs.registration import Claim, Exchange, make_key


def made(before: dt.datetime, after: dt.datetime, subject: str = "car") -> tuple[x509.Certificate, str]:
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, subject)])
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(before)
        .not_valid_after(after)
        .sign(key, hashes.SHA256())
    )
    pem = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    return certificate, pem.decode()


def text(certificate: x509.Certificate) -> str:
    return certificate.public_bytes(serialization.Encoding.PEM).decode()


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ((2020, 1, 2), (2049, 12, 31)),
        ((1999, 12, 31), (2050, 1, 1)),  # the year that times are written differently from
        ((1950, 1, 1), (9999, 12, 31)),
    ],
)
def test_id_and_validity(before: tuple[int, int, int], after: tuple[int, int, int]) -> None:
    first, last = (dt.datetime(*day, tzinfo=dt.timezone.utc) for day in (before, after))
    certificate, _ = made(first, last)
    found = parse_certificate("some text before\n" + text(certificate) + "and behind")
    assert found.validity() == (first.timestamp(), last.timestamp())
    assert found.id == certificate.fingerprint(hashes.SHA256()).hex(), "as AWS numbers certificates"


@given(st.binary(max_size=300))
def test_a_file_without_a_certificate_is_rejected(der: bytes) -> None:
    pem = f"-----BEGIN CERTIFICATE-----\n{base64.b64encode(der).decode()}\n-----END CERTIFICATE-----\n"
    with pytest.raises(IdentityError):
        parse_certificate(pem).validity()


def test_a_new_key_and_its_signing_request() -> None:
    key, request = make_key("car7")
    read = x509.load_pem_x509_csr(request.encode())
    assert read.is_signature_valid
    assert read.subject.rfc4514_string() == "CN=car7"
    private = serialization.load_pem_private_key(key.encode(), password=None)
    assert read.public_key() == private.public_key()
    assert make_key("car7")[0] != key


def test_the_running_agent_does_not_load_the_library() -> None:
    code = (
        "import sys, iort_agent.cli, iort_agent.mqtt.aws, iort_agent.verbs.check\n"
        "from iort_agent.identity import parse_certificate\n"
        "parse_certificate(sys.stdin.read()).id\n"
        "assert 'cryptography' not in sys.modules"
    )
    certificate, _ = made(dt.datetime(2020, 1, 1), dt.datetime(2040, 1, 1))  # noqa: DTZ001 - the library takes UTC for granted
    subprocess.run([sys.executable, "-c", code], input=text(certificate), text=True, check=True)


def test_a_key_belongs_to_its_certificate(tmp_path: Path) -> None:
    year = (dt.datetime(2020, 1, 1), dt.datetime(2040, 1, 1))  # noqa: DTZ001 - the library takes UTC for granted
    (one, one_key), (_, other_key) = made(*year), made(*year)
    for name, content in (("c", text(one)), ("k", one_key), ("o", other_key), ("x", "no key")):
        (tmp_path / name).write_text(content)
    check_pair(tmp_path / "c", tmp_path / "k")
    with pytest.raises(IdentityError, match="is not the key of"):
        check_pair(tmp_path / "c", tmp_path / "o")
    with pytest.raises(IdentityError, match="x holds no PEM private key"):
        check_pair(tmp_path / "c", tmp_path / "x")
    with pytest.raises(IdentityError, match="cannot be read"):
        read_certificate(tmp_path / "none")
    with pytest.raises(IdentityError, match="no PEM certificate"):
        read_certificate(tmp_path / "x")


def test_a_stamp_changes_with_every_replacement(tmp_path: Path) -> None:
    file, other = tmp_path / "a", tmp_path / "b"
    assert stamp(file, None) == (None,)
    file.write_text("1")
    seen = [stamp(file)]
    other.write_text("1")
    other.replace(file)
    seen.append(stamp(file))
    os.utime(file, (1, 1))
    seen.append(stamp(file))
    assert len(set(seen)) == 3


def test_swapped_files_are_named_also_by_the_running_agent_and_of_a_claim(tmp_path: Path) -> None:
    now = dt.datetime.now(dt.timezone.utc)
    certificate, key = made(now, now + dt.timedelta(days=1))
    of_another = made(now, now + dt.timedelta(days=1))[1]
    files = {"c.pem": text(certificate), "k.key": key, "other.key": of_another, "empty": ""}
    for name, content in files.items():
        (tmp_path / name).write_text(content)
    for named, why in (
        (
            ("k.key", "c.pem"),
            r"certificate: \S+/k.key holds no PEM certificate, and c.pem .* swapped\?",
        ),
        (("c.pem", "empty"), r"private_key: \S+/empty holds no PEM private key$"),
        (("c.pem", "missing"), r"/missing: cannot be read: No such file"),
        (("c.pem", "other.key"), r"/other.key is not the key of \S+/c.pem"),
    ):
        paths = tuple(tmp_path / name for name in named)
        with pytest.raises(IdentityError, match=why):
            check_pair(*paths)
        uplink = IotCore(
            endpoint="127.0.0.1",
            port=9,
            client_id="car1",
            certificate=paths[0],
            private_key=paths[1],
            root_ca=None,
            clock=SystemClock(),
            dispatcher=Dispatcher(),
        )
        with pytest.raises(UplinkError, match=why):
            uplink.start()
        with pytest.raises(IdentityError, match=rf"^the claim: .*{why}"):
            Exchange(Claim(endpoint="127.0.0.1", certificate=paths[0], private_key=paths[1]))
