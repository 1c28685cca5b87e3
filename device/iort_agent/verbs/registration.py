"""Registers a robot with AWS IoT over the connection of a claim: a key, its certificate and the thing.

It is resumed after any interruption.
"""

from __future__ import annotations

import contextlib
import json
import logging
import re
import time
import uuid
from dataclasses import asdict, dataclass
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any, Callable, Mapping

from iort_agent.common.private_files import open_below, write_below
from iort_agent.common.schema import FILE, Place, load, number, path, read_yaml, setting, text
from iort_agent.errors import IdentityError, RefusedError
from iort_agent.identity import check_pair, load_x509
from iort_contract.cloud import claim_name, fleet_name
from iort_contract.limits import DEFAULT_NAMESPACE
from iort_contract.tables import ROBOT_PARAMETER, SERIAL_PARAMETER
from iort_contract.topics import check_namespace, check_robot

if TYPE_CHECKING:
    from iort_agent.mqtt.session import Session

_log = logging.getLogger(__name__)

_WAIT_S = 30.0
# Where Linux tells the machine's serial number; the first file that exists counts.
_SERIALS = (Path("/proc/device-tree/serial-number"), Path("/etc/machine-id"))
PENDING = PurePath(".provisioning.json")
_MAX_BYTES = 64 * 1024
# "The certificateOwnershipToken expires after one hour", and the certificate is deleted then if it was not
# registered ("Device provisioning MQTT API").
TOKEN_S = 3600.0
# Waits before each further try to register.
_AGAIN_S = (1.0, 4.0)
# How AWS IoT's error codes begin for a token or a certificate that is no longer valid.
_NO_LONGER = ("Invalid", "ResourceNotFound")
# The characters that RegisterThing allows in a parameter and a thing in an attribute.
_SERIAL = re.compile(r"[A-Za-z0-9_.,@/:#-]{1,800}")


def make_key(robot: str) -> tuple[str, str]:
    """Make a new private key and its certificate signing request, both as PEM. Writes no file."""
    x509 = load_x509()
    from cryptography.hazmat.primitives import hashes, serialization  # noqa: PLC0415 - as in `load_x509`
    from cryptography.hazmat.primitives.asymmetric import ec  # noqa: PLC0415 - as above

    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, robot)])
    request = x509.CertificateSigningRequestBuilder(subject).sign(key, hashes.SHA256())
    pem = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    return pem.decode(), request.public_bytes(serialization.Encoding.PEM).decode()


def machine_serial() -> str:
    """The machine's serial number. If the hardware has one, a copy of the disk image does not share it."""
    for file in _SERIALS:
        with contextlib.suppress(OSError, UnicodeDecodeError):
            serial = file.read_text(encoding="ascii").strip("\0 \n")
            if serial:
                return serial
    raise IdentityError("this machine has no serial number: set `serial` in the claim's file")


@dataclass(frozen=True)
class Claim:
    """The content of claim.yaml. ``config`` is the configuration file to write or to update."""

    endpoint: str = setting(text())
    certificate: Path = setting(FILE)
    private_key: Path = setting(FILE)
    root_ca: Path | None = setting(FILE, None)
    namespace: str = setting(text(check_namespace), DEFAULT_NAMESPACE)
    port: int = setting(number(1, 65535, whole=True), 8883)
    robot: str | None = setting(text(check_robot), None)
    serial: str | None = setting(text(), None)
    config: Path | None = setting(path(), None)


def load_claim(file: Path) -> Claim:
    """Read a claim file. Raises `ConfigError`."""
    return load(Claim, read_yaml(file), Place(file))


@dataclass(frozen=True)
class Pending:
    """An issued certificate with its key and token, for whom it is, and this machine's time of the request.

    AWS IoT admits a name for one certificate. A run that stops before the certificate is in its place would
    otherwise lose the key, and the next run would request a name that is already used.
    """

    robot: str
    serial: str
    endpoint: str
    namespace: str
    private_key: str
    certificate: str
    token: str
    asked_s: float

    def is_for(self, robot: str, serial: str, endpoint: str, namespace: str) -> bool:
        """Whether it was issued for this robot of this deployment."""
        own = (self.robot, self.serial, self.endpoint, self.namespace)
        return own == (robot, serial, endpoint, namespace)

    def may_register(self, now_s: float) -> bool:
        """Whether the token may still be valid. A request from the future means that the clock was set."""
        return 0 <= now_s - self.asked_s < TOKEN_S

    def write(self, folder: Path) -> None:
        """Write it to the disk, readable by its owner only. Raises `OSError`."""
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        write_below(folder, PENDING, json.dumps(asdict(self)).encode(), sync=True)


def read_pending(folder: Path) -> Pending | None:
    """What an earlier run left; None if it left nothing readable."""
    try:
        with open_below(folder, PENDING) as file:
            content = json.loads(file.read(_MAX_BYTES))
        asked_s = float(content.pop("asked_s"))
        return Pending(asked_s=asked_s, **{name: str(value) for name, value in content.items()})
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        _log.warning("%s is ignored: %s", folder / PENDING, error)
        return None


class Exchange:
    """The connection with a claim, open within a `with`."""

    def __init__(self, claim: Claim) -> None:
        """Raises `IdentityError`, which says which of the claim's files does not fit."""
        try:
            # The library's own error names no file.
            check_pair(claim.certificate, claim.private_key)
        except IdentityError as error:
            raise IdentityError(f"the claim: {error}") from error
        self._claim = claim
        self._template = fleet_name(claim.namespace)
        client_id = f"{claim_name(claim.namespace)}-{uuid.uuid4().hex[:8]}"
        self._connection = self._session(
            client_id, claim.certificate.read_bytes(), claim.private_key.read_bytes()
        )
        self._requests: Any = None

    def __enter__(self) -> Exchange:  # noqa: PYI034 - Self came with Python 3.11
        from awscrt import mqtt_request_response  # noqa: PLC0415 - the network's library
        from awsiot import iotidentity  # noqa: PLC0415 - the network's library

        if not self._connection.open(_WAIT_S):
            self.__exit__()
            raise IdentityError(
                f"the claim does not connect: {self._connection.failure}. Most claims live for minutes "
                "only: ask the operator for a new one (`iort robots claim`)"
            )
        options = mqtt_request_response.ClientOptions(
            max_request_response_subscriptions=4, max_streaming_subscriptions=0
        )
        options.operation_timeout_in_seconds = int(_WAIT_S)
        self._requests = iotidentity.IotIdentityClientV2(self._connection.client, options)
        return self

    def __exit__(self, *_: object) -> None:
        self._requests = None
        self._connection.close()

    def certify(self, request: str) -> tuple[str, str]:
        """Returns the certificate for a signing request, and the token that proves its ownership."""
        from awsiot import iotidentity  # noqa: PLC0415 - the network's library

        csr = iotidentity.CreateCertificateFromCsrRequest(certificate_signing_request=request)
        answer = _result("CreateCertificateFromCsr", self._requests.create_certificate_from_csr(csr))
        return str(answer.certificate_pem), str(answer.certificate_ownership_token)

    def register(self, token: str, parameters: Mapping[str, str]) -> str:
        """Register the robot with its certificate. Returns the thing's name."""
        from awsiot import iotidentity  # noqa: PLC0415 - the network's library

        asked = iotidentity.RegisterThingRequest(
            template_name=self._template,
            certificate_ownership_token=token,
            parameters=dict(parameters),
        )
        return str(_result("RegisterThing", self._requests.register_thing(asked)).thing_name)

    def connects(self, robot: str, certificate: str, private_key: str) -> bool:
        """Whether the broker accepts the robot with this certificate, which it does once it is registered.

        It ends a session that the robot has, as the robot's agent would.
        """
        connection = self._session(robot, certificate.encode(), private_key.encode())
        try:
            return connection.open(_WAIT_S)
        finally:
            connection.close()

    def _session(self, client_id: str, certificate: bytes, private_key: bytes) -> Session:
        # Reading a claim must not need the network's library.
        from iort_agent.mqtt.session import Session  # noqa: PLC0415 - see above

        claim = self._claim
        return Session(
            client_id,
            certificate,
            private_key,
            endpoint=claim.endpoint,
            port=claim.port,
            root_ca=claim.root_ca,
        )


def _result(what: str, future: Any) -> Any:
    try:
        return future.result(_WAIT_S + 5)
    except Exception as error:
        modeled = getattr(error, "modeled_error", None)
        if modeled is None:
            raise IdentityError(f"{what} was refused: {error}") from error
        code = str(modeled.error_code)
        raise RefusedError(f"{what} was refused: {code}: {modeled.error_message}", code) from error


@dataclass(frozen=True)
class Seams:
    """Replaced by tests: the claim's connection, and waiting."""

    exchange: Callable[[Claim], Exchange] = Exchange
    wait: Callable[[float], None] = time.sleep


SEAMS = Seams()


def register(claim: Claim, robot: str, folder: Path, seams: Seams) -> Pending:
    """A key and its certificate, registered for the robot's thing: those of an earlier run that was stopped,
    or new ones. `PENDING` keeps them in the folder until it is deleted."""
    serial = claim.serial or machine_serial()
    if not _SERIAL.fullmatch(serial):
        raise IdentityError(f"serial must be of A-Z a-z 0-9 _ . , @ / : # -, got {serial!r}")
    earlier = read_pending(folder)
    if earlier is not None and earlier.is_for(robot, serial, claim.endpoint, claim.namespace):
        if _finish(claim, earlier, seams):
            return earlier
        _log.warning("the certificate of an earlier run is no longer valid: requesting another")
    key, request = make_key(robot)
    with seams.exchange(claim) as connection:
        certificate, token = connection.certify(request)
        asked_s = time.time()
        issued = Pending(robot, serial, claim.endpoint, claim.namespace, key, certificate, token, asked_s)
        issued.write(folder)
        _ask(connection, issued, seams)
    return issued


def _finish(claim: Claim, earlier: Pending, seams: Seams) -> bool:
    """Register an earlier run's certificate; False if it can never be registered.

    Raises `IdentityError` if it may be registered later: whom the hook refuses now, it refuses with any
    certificate.
    """
    expired = not earlier.may_register(time.time())
    try:
        # Without a network no certificate connects. So request another one only while the claim connects.
        with seams.exchange(claim) as connection:
            if expired:
                return _is_registered(connection, earlier)
            _ask(connection, earlier, seams)
    except IdentityError as error:
        if _is_no_longer_good(error):
            return False
        # The claim may have expired meanwhile.
        if not _is_registered(seams.exchange(claim), earlier):
            raise
    return True


def _ask(connection: Exchange, issued: Pending, seams: Seams) -> None:
    parameters = {ROBOT_PARAMETER: issued.robot, SERIAL_PARAMETER: issued.serial}
    try:
        thing = register_again(lambda: connection.register(issued.token, parameters), wait=seams.wait)
    except IdentityError:
        # The answer may have been lost. AWS does not document the answer to a used token.
        if not _is_registered(connection, issued):
            raise
        return
    if thing != issued.robot:
        raise IdentityError(f"the cloud registered {thing}, not {issued.robot}: its template is not ours")


def _is_registered(connection: Exchange, issued: Pending) -> bool:
    return connection.connects(issued.robot, issued.certificate, issued.private_key)


def _is_no_longer_good(error: IdentityError) -> bool:
    return isinstance(error, RefusedError) and error.code.startswith(_NO_LONGER)


def register_again(register: Callable[[], str], *, wait: Callable[[float], None]) -> str:
    """Register, with a few tries while the token may be valid.

    AWS IoT gives the fleet's hook 5 s. A hook that was too late has given the name to this certificate, and
    for a while admits no other. Raises the first `IdentityError` if all tries fail.
    """
    first: IdentityError | None = None
    for wait_s in (*_AGAIN_S, None):
        try:
            return register()
        except IdentityError as error:  # noqa: PERF203 - it waits for seconds
            first = first or error
            if _is_no_longer_good(error):
                break
            if wait_s is not None:
                _log.warning("%s; trying again in %g s", error, wait_s)
                wait(wait_s)
    assert first is not None
    raise first
