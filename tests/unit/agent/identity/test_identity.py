"""Provisioning: repeated tries, within a run and by the next run."""

from __future__ import annotations

import time
from pathlib import Path
from types import SimpleNamespace
from typing import Mapping

import pytest

from iort_agent.config import load_config
from iort_agent.errors import BusyError, IdentityError, RefusedError
from iort_agent.verbs import provision as provision_module
from iort_agent.verbs.provision import provision
from iort_agent.verbs.registration import TOKEN_S, Pending, Seams, read_pending, register_again
from iort_contract.limits import DEFAULT_NAMESPACE
from iort_contract.messages.control.driving import DRIVE_LEASE_MS


class Cloud:
    """Refuses a few times, then registers."""

    def __init__(self, *refusals: str) -> None:
        self._refusals = list(refusals)
        self.asked = 0
        self.waited: list[float] = []

    def register(self) -> str:
        self.asked += 1
        if self._refusals:
            raise IdentityError(self._refusals.pop(0))
        return "car"


@pytest.mark.parametrize("refusals", [(), ("too late",), ("too late", "no answer")])
def test_a_failed_registration_is_repeated_with_the_same_token(refusals: tuple[str, ...]) -> None:
    cloud = Cloud(*refusals)
    assert register_again(cloud.register, wait=cloud.waited.append) == "car"
    assert cloud.asked == len(refusals) + 1
    assert cloud.waited == [1.0, 4.0][: len(refusals)]


def test_a_final_refusal_raises_the_first_error() -> None:
    cloud = Cloud("not expected", "token is used up", "token is used up", "never asked")
    with pytest.raises(IdentityError, match=r"^not expected$"):
        register_again(cloud.register, wait=cloud.waited.append)
    assert (cloud.asked, cloud.waited) == (3, [1.0, 4.0])


class Exchange:
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

    def __enter__(self) -> Exchange:  # noqa: PYI034 - Self came with Python 3.11
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
def aws() -> Exchange:
    return Exchange()


@pytest.fixture
def claim(tmp_path: Path) -> Path:
    for name in ("c.pem", "k.pem"):
        (tmp_path / name).touch()
    file = tmp_path / "claim.yaml"
    file.write_text("endpoint: here\ncertificate: c.pem\nprivate_key: k.pem\nserial: s1\n")
    return file


def earlier(folder: Path, *, asked_s: float | None = None, **other: str) -> Pending:
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
    pending = Pending(**{**values, **other}, asked_s=time.time() if asked_s is None else asked_s)
    pending.write(folder)
    return pending


def test_a_new_configuration_simulates_a_car_that_can_be_driven_and_stopped(
    claim: Path, aws: Exchange
) -> None:
    config = load_config(provision(claim, robot="car", seams=aws.seams))
    limits = config.downlink.drive_limits()
    assert limits is not None
    assert (limits.max_speed_mps, limits.lease_ms) == (2.0, DRIVE_LEASE_MS)
    assert config.downlink.moves()


def taken_up(claim: Path, aws: Exchange) -> str:
    """The certificate that the robot has afterwards."""
    provision(claim, robot="car", seams=aws.seams)
    assert read_pending(claim.parent) is None
    return (claim.parent / "certificate.pem").read_text()


@pytest.mark.parametrize("at", ["registering", "writing"])
def test_the_next_run_resumes_after_an_end_at_any_step(claim: Path, aws: Exchange, at: str) -> None:
    class Ended(BaseException):
        """Ends the process."""

    def register(token: str, parameters: Mapping[str, str]) -> str:
        if at == "writing":
            Exchange.register(aws, token, parameters)
        raise Ended

    aws.register = register
    with pytest.raises(Ended):
        provision(claim, robot="car", seams=aws.seams)
    del aws.register
    assert taken_up(claim, aws) == "certificate 0"
    assert aws.issued == ["certificate 0"]


def test_any_answer_to_a_used_token_is_accepted(claim: Path, aws: Exchange) -> None:
    for refusal in (
        RefusedError("used", "InvalidCertificateOwnershipToken"),
        RefusedError("no", "AccessDenied"),
    ):
        earlier(claim.parent)
        aws.registered, aws.refusal = {"certificate 0"}, refusal
        assert taken_up(claim, aws) == "certificate 0"
    assert not aws.issued


def test_a_registered_certificate_needs_no_claim(claim: Path, aws: Exchange) -> None:
    earlier(claim.parent)
    aws.registered, aws.claim_is_good = {"certificate 0"}, False
    assert taken_up(claim, aws) == "certificate 0"


def test_an_invalid_token_is_dropped(claim: Path, aws: Exchange) -> None:
    aws.issued.append("certificate 0")
    earlier(claim.parent)
    assert taken_up(claim, aws) == "certificate 1"
    assert aws.asked == ["token 0", "token 1"]


@pytest.mark.parametrize("off_s", [-TOKEN_S, 60.0])
def test_an_expired_token_is_not_sent(claim: Path, aws: Exchange, off_s: float) -> None:
    aws.issued.append("certificate 0")
    earlier(claim.parent, asked_s=time.time() + off_s)
    assert taken_up(claim, aws) == "certificate 1"
    assert aws.asked == ["token 1"]


def test_an_expired_token_is_kept_without_a_network(claim: Path, aws: Exchange) -> None:
    left = earlier(claim.parent, asked_s=time.time() - TOKEN_S)
    aws.claim_is_good = False
    with pytest.raises(IdentityError, match="does not connect"):
        provision(claim, robot="car", seams=aws.seams)
    assert read_pending(claim.parent) == left


@pytest.mark.parametrize(
    "refusal", [RefusedError("not expected", "AccessDenied"), IdentityError("no answer")]
)
def test_a_certificate_that_may_be_admitted_later_is_kept(
    claim: Path, aws: Exchange, refusal: IdentityError
) -> None:
    left = earlier(claim.parent)
    aws.refusal = refusal
    with pytest.raises(IdentityError, match=str(refusal)):
        provision(claim, robot="car", seams=aws.seams)
    assert read_pending(claim.parent) == left
    assert not aws.issued


@pytest.mark.parametrize(
    "other", [{"robot": "bike"}, {"serial": "s2"}, {"endpoint": "there"}, {"namespace": "a"}]
)
def test_another_robots_certificate_is_not_used(claim: Path, aws: Exchange, other: dict[str, str]) -> None:
    earlier(claim.parent, certificate="certificate of another", **other)
    assert taken_up(claim, aws) == "certificate 0"


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"robot": "car", "asked_s": "x"}', "null", "\\x00"])
def test_an_unreadable_state_is_ignored(claim: Path, aws: Exchange, content: str) -> None:
    (claim.parent / ".provisioning.json").write_text(content)
    assert taken_up(claim, aws) == "certificate 0"


def test_a_link_in_place_of_the_state_is_not_followed(claim: Path, aws: Exchange, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    earlier(elsewhere, certificate="certificate of another")
    before = (elsewhere / ".provisioning.json").read_bytes()
    (claim.parent / ".provisioning.json").symlink_to(elsewhere / ".provisioning.json")
    assert taken_up(claim, aws) == "certificate 0"
    assert (elsewhere / ".provisioning.json").read_bytes() == before


def test_the_previous_files_are_kept_after_any_number_of_ends(claim: Path, aws: Exchange) -> None:
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


def test_a_lost_answer_is_not_a_refusal(claim: Path, aws: Exchange) -> None:
    def register(token: str, parameters: Mapping[str, str]) -> str:
        Exchange.register(aws, token, parameters)
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
