"""The robot's certificate: its id, validity and key; and its registration, resumed after any end."""

from __future__ import annotations

import base64
import datetime as dt
import os
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Mapping
from unittest.mock import Mock

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from hypothesis import given
from hypothesis import strategies as st

from iort_agent.common.threads import SystemClock
from iort_agent.config import load_config
from iort_agent.errors import BusyError, IdentityError, RefusedError, UplinkError
from iort_agent.identity import check_pair, parse_certificate, read_certificate, stamp
from iort_agent.mqtt.aws import IotCore
from iort_agent.mqtt.client import Broker
from iort_agent.mqtt.dispatch import Dispatcher
from iort_agent.verbs import provision as provision_module
from iort_agent.verbs.provision import provision
from iort_agent.verbs.registration import (
    TOKEN_S,
    Claim,
    Exchange,
    Pending,
    Seams,
    make_key,
    read_pending,
    register_again,
)
from iort_contract.limits import DEFAULT_NAMESPACE
from iort_contract.messages.commands import DRIVE_LEASE_MS


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
    check_pair(tmp_path / "c.pem", tmp_path / "k.key")
    with pytest.raises(IdentityError, match="cannot be read"):
        read_certificate(tmp_path / "none")
    with pytest.raises(IdentityError, match="no PEM certificate"):
        read_certificate(tmp_path / "empty")
    for named, why in (
        (("k.key", "c.pem"), r"certificate: \S+/k.key holds no PEM certificate, and c.pem .* swapped\?"),
        (("c.pem", "empty"), r"private_key: \S+/empty holds no PEM private key$"),
        (("c.pem", "missing"), r"/missing: cannot be read: No such file"),
        (("c.pem", "other.key"), r"/other.key is not the key of \S+/c.pem"),
    ):
        paths = tuple(tmp_path / name for name in named)
        with pytest.raises(IdentityError, match=why):
            check_pair(*paths)
        broker = Broker("127.0.0.1", 9, "car1", *paths)
        uplink = IotCore(broker, clock=SystemClock(), dispatcher=Dispatcher())
        with pytest.raises(UplinkError, match=why):
            uplink.start()
        with pytest.raises(IdentityError, match=rf"^the claim: .*{why}"):
            Exchange(Claim(endpoint="127.0.0.1", certificate=paths[0], private_key=paths[1]))


@pytest.mark.parametrize(
    "refusals",
    [(), ("too late",), ("too late", "no answer"), ("not expected", "token is used up", "token is used up")],
)
def test_a_failed_registration_is_repeated_with_the_same_token(refusals: tuple[str, ...]) -> None:
    waited: list[float] = []
    register = Mock(side_effect=[*map(IdentityError, refusals), "car"])
    if len(refusals) < 3:
        assert register_again(register, wait=waited.append) == "car"
    else:
        with pytest.raises(IdentityError, match=r"^not expected$"):
            register_again(register, wait=waited.append)
    assert register.call_count == min(len(refusals) + 1, 3)
    assert waited == [1.0, 4.0][: len(refusals)]


class FakeCloud:
    """A fake of AWS IoT. ``tokens`` are valid; certificates in ``registered`` connect."""

    def __init__(self) -> None:
        self.issued: list[str] = []
        self.tokens: set[str] = set()
        self.registered: set[str] = set()
        self.refusal: IdentityError | None = None
        self.claim_is_good = True
        self.asked: list[str] = []
        self.waited: list[float] = []

    @property
    def seams(self) -> Seams:
        return Seams(lambda _claim: self, self.waited.append)

    def __enter__(self) -> FakeCloud:  # noqa: PYI034 - Self came with Python 3.11
        if not self.claim_is_good:
            raise IdentityError("the claim does not connect")
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def certify(self, _request: str) -> tuple[str, str]:
        number = len(self.issued)
        self.issued.append(f"certificate {number}")
        self.tokens.add(f"token {number}")
        return f"certificate {number}", f"token {number}"

    def register(self, token: str, parameters: Mapping[str, str]) -> str:
        self.asked.append(token)
        if self.refusal is not None:
            raise self.refusal
        if token not in self.tokens:
            raise RefusedError("refused", "InvalidCertificateOwnershipToken")
        self.registered.add(token.replace("token", "certificate"))
        return parameters["Robot"]

    def connects(self, _robot: str, certificate: str, _private_key: str) -> bool:
        return certificate in self.registered


@pytest.fixture
def aws() -> FakeCloud:
    return FakeCloud()


@pytest.fixture
def claim(tmp_path: Path) -> Path:
    for name in ("c.pem", "k.pem"):
        (tmp_path / name).touch()
    file = tmp_path / "claim.yaml"
    file.write_text("endpoint: here\ncertificate: c.pem\nprivate_key: k.pem\nserial: s1\n")
    return file


def earlier(folder: Path, *, age_s: float = 0.0, **other: str) -> Pending:
    """The state of a run that was issued the first certificate."""
    values = {
        "robot": "car",
        "serial": "s1",
        "endpoint": "here",
        "namespace": DEFAULT_NAMESPACE,
        "private_key": "key 0",
        "certificate": "certificate 0",
        "token": "token 0",
    }
    pending = Pending(**{**values, **other}, asked_s=time.time() - age_s)
    pending.write(folder)
    return pending


def test_a_new_configuration_simulates_a_car_that_can_be_driven_and_stopped(
    claim: Path, aws: FakeCloud
) -> None:
    config = load_config(provision(claim, robot="car", seams=aws.seams))
    limits = config.downlink.drive_limits()
    assert limits is not None
    assert (limits.max_speed_mps, limits.lease_ms) == (2.0, DRIVE_LEASE_MS)
    assert config.downlink.moves()


def taken_up(claim: Path, aws: FakeCloud) -> str:
    """The certificate that the robot has afterwards."""
    provision(claim, robot="car", seams=aws.seams)
    assert read_pending(claim.parent) is None
    return (claim.parent / "certificate.pem").read_text()


@pytest.mark.parametrize("at", ["registering", "writing"])
def test_the_next_run_resumes_after_an_end_at_any_step(claim: Path, aws: FakeCloud, at: str) -> None:
    class Ended(BaseException):
        """Ends the process."""

    def register(token: str, parameters: Mapping[str, str]) -> str:
        if at == "writing":
            FakeCloud.register(aws, token, parameters)
        raise Ended

    aws.register = register
    with pytest.raises(Ended):
        provision(claim, robot="car", seams=aws.seams)
    del aws.register
    assert taken_up(claim, aws) == "certificate 0"
    assert aws.issued == ["certificate 0"]


REGISTERED = {"registered": {"certificate 0"}}
USED, DENIED = RefusedError("used", "InvalidCertificateOwnershipToken"), RefusedError("no", "AccessDenied")
NO_NETWORK = IdentityError("the claim does not connect")


@pytest.mark.parametrize(
    ("of_earlier", "cloud", "outcome", "tokens"),
    [
        # Any answer to a used token is accepted, and a registered certificate needs no claim.
        ({}, {**REGISTERED, "refusal": USED}, "certificate 0", ["token 0"]),
        ({}, {**REGISTERED, "refusal": DENIED}, "certificate 0", ["token 0"] * 3),
        ({}, {**REGISTERED, "claim_is_good": False}, "certificate 0", []),
        # An invalid token is dropped, an expired one is not sent, and kept without a network.
        ({}, {}, "certificate 1", ["token 0", "token 1"]),
        ({"age_s": TOKEN_S}, {}, "certificate 1", ["token 1"]),
        ({"age_s": -60.0}, {}, "certificate 1", ["token 1"]),
        ({"age_s": TOKEN_S}, {"claim_is_good": False}, NO_NETWORK, []),
        # A certificate that may be admitted later is kept.
        ({}, {"refusal": DENIED}, DENIED, ["token 0"] * 3),
        ({}, {"refusal": IdentityError("no answer")}, IdentityError("no answer"), ["token 0"] * 3),
        # Another robot's is not used.
        ({"robot": "bike"}, {}, "certificate 1", ["token 1"]),
        ({"serial": "s2"}, {}, "certificate 1", ["token 1"]),
        ({"endpoint": "there"}, {}, "certificate 1", ["token 1"]),
        ({"namespace": "a"}, {}, "certificate 1", ["token 1"]),
    ],
)
def test_what_becomes_of_an_earlier_runs_certificate(
    claim: Path, aws: FakeCloud, of_earlier: Any, cloud: Any, outcome: Any, *, tokens: list[str]
) -> None:
    aws.issued.append("certificate 0")
    vars(aws).update(cloud)
    left = earlier(claim.parent, **of_earlier)
    if isinstance(outcome, str):
        assert taken_up(claim, aws) == outcome
    else:
        with pytest.raises(IdentityError, match=str(outcome)):
            provision(claim, robot="car", seams=aws.seams)
        assert read_pending(claim.parent) == left
    assert aws.asked == tokens
    assert len(aws.issued) == 1 + (outcome == "certificate 1")


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"robot": "car", "asked_s": "x"}', "null", "\\x00"])
def test_an_unreadable_state_is_ignored(claim: Path, aws: FakeCloud, content: str) -> None:
    (claim.parent / ".provisioning.json").write_text(content)
    assert taken_up(claim, aws) == "certificate 0"


def test_a_link_in_place_of_the_state_is_not_followed(claim: Path, aws: FakeCloud, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    earlier(elsewhere, certificate="certificate of another")
    before = (elsewhere / ".provisioning.json").read_bytes()
    (claim.parent / ".provisioning.json").symlink_to(elsewhere / ".provisioning.json")
    assert taken_up(claim, aws) == "certificate 0"
    assert (elsewhere / ".provisioning.json").read_bytes() == before


def test_the_previous_files_are_kept_after_any_number_of_ends(claim: Path, aws: FakeCloud) -> None:
    (claim.parent / "private.key").write_text("old key")
    (claim.parent / "certificate.pem").write_text("old certificate")
    left = earlier(claim.parent)
    aws.tokens.add("token 0")
    # The earlier run ended between its two files.
    (claim.parent / "private.key.previous").write_text("old key")
    (claim.parent / "private.key").write_text(left.private_key)
    assert taken_up(claim, aws) == "certificate 0"
    assert (claim.parent / "private.key.previous").read_text() == "old key"
    assert (claim.parent / "certificate.pem.previous").read_text() == "old certificate"


def test_a_lost_answer_is_not_a_refusal(claim: Path, aws: FakeCloud) -> None:
    def register(token: str, parameters: Mapping[str, str]) -> str:
        FakeCloud.register(aws, token, parameters)
        raise IdentityError("no answer")

    aws.register = register
    assert taken_up(claim, aws) == "certificate 0"
    assert aws.waited == [1.0, 4.0]


def test_a_renewal_waits_for_an_agent_that_is_too_busy_to_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def ask(_path: Path) -> object:
        asked.append(1)
        if len(asked) == 1:
            raise BusyError("busy")
        return SimpleNamespace(connection=SimpleNamespace(connected=True, certificate_id="new"))

    monkeypatch.setattr(provision_module, "ask", ask)
    monkeypatch.setattr(provision_module, "_LOOK_S", 0)
    # Without a configuration it cannot connect alone, which would take the agent's connection.
    provision_module._wait_connected(None, "new", Path("agent.sock"))  # type: ignore[arg-type]  # none
    assert len(asked) == 2
