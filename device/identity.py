"""`iort-agent provision` and `renew`: a certificate for a key that was made on the robot and never leaves it.

A claim, a certificate good for this alone, is exchanged for the robot's own: CreateCertificateFromCsr,
then RegisterThing with the fleet's template. The operator makes claims with `iort robots claim`.
"""

from __future__ import annotations

import contextlib
import logging
import os
import re
import subprocess
import threading
import time
import uuid
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any, Callable, Iterable, Mapping

import yaml

import contract
from device.certificate import parse_certificate
from device.config import Config, load_config
from device.errors import AgentError, ConfigError, IdentityError
from device.private_files import write_below
from device.schema import Where, any_path, existing_path, load, number, read_yaml, setting, text
from device.status import fetch

_log = logging.getLogger(__name__)

_WAIT_S = 30.0
_SWITCH_S = 60.0
_LOOK_S = 0.5
# Before each further try to register.
_AGAIN_S = (1.0, 4.0)
# Where Linux says which machine this is; the first that there is.
_SERIALS = (Path("/proc/device-tree/serial-number"), Path("/etc/machine-id"))
# What RegisterThing takes as a parameter and a thing as an attribute.
_SERIAL = re.compile(r"[A-Za-z0-9_.,@/:#-]{1,800}")
_DEFAULT_SOURCES = [{"type": "sim", "stream": contract.VESC_STREAM, "rate_hz": 50}]


@dataclass(frozen=True)
class Claim:
    """What claim.yaml says. ``config`` is the file to write, or to update where it exists."""

    endpoint: str = setting(text())
    certificate: Path = setting(existing_path())
    private_key: Path = setting(existing_path())
    root_ca: Path | None = setting(existing_path(), None)
    namespace: str = setting(text(contract.check_namespace), contract.DEFAULT_NAMESPACE)
    port: int = setting(number(1, 65535, whole=True), 8883)
    robot: str | None = setting(text(contract.check_robot), None)
    serial: str | None = setting(text(), None)
    config: Path | None = setting(any_path(), None)


def load_claim(file: Path) -> Claim:
    """The claim in a file. Raises `ConfigError`."""
    return load(Claim, read_yaml(file), Where(file))


def provision(file: Path, *, robot: str | None) -> Path:
    """Get the robot's own certificate for a claim; the configuration that now names it.

    Raises `ConfigError` for a claim file that is wrong, `IdentityError` where the cloud refuses.
    """
    claim = load_claim(file)
    name = robot or claim.robot
    if name is None:
        raise ConfigError(f"{file}: robot: required, and missing: give it here or with --robot")
    try:
        contract.check_robot(name)
    except contract.ContractError as error:
        raise ConfigError(str(error)) from error
    config_file = claim.config or file.parent / "car.yaml"
    key, certificate = _register(claim, name)
    folder = config_file.parent
    files = {"certificate": folder / "certificate.pem", "private_key": folder / "private.key"}
    _keep_previous(files.values())
    _write_private(files["private_key"], key)
    _write_private(files["certificate"], certificate)
    settings: dict[str, Any] = {
        "robot": name,
        "namespace": claim.namespace,
        "endpoint": claim.endpoint,
        "port": claim.port,
        **{setting_name: path.name for setting_name, path in files.items()},
    }
    if claim.root_ca is not None:
        settings["root_ca"] = os.path.relpath(claim.root_ca, folder)
    _update_config(config_file, settings)
    load_config(config_file)
    return config_file


def renew(file: Path, claim_file: Path, *, status_socket: Path) -> None:
    """Replace the robot's key and certificate, and keep the old ones until the new ones connected.

    A running agent takes the new ones by itself. Raises `IdentityError` where the cloud refuses or
    the new certificate does not connect; the old one is in its place again then.
    """
    config = load_config(file)
    key, certificate = _register(load_claim(claim_file), config.robot)
    files = (config.private_key, config.certificate)
    _keep_previous(files)
    _write_private(config.private_key, key)
    _write_private(config.certificate, certificate)
    try:
        _wait_connected(config, parse_certificate(certificate).id, status_socket)
    except BaseException:
        for path in files:
            _previous(path).replace(path)
        raise
    for path in files:
        _previous(path).unlink()


def _register(claim: Claim, robot: str) -> tuple[str, str]:
    """A new key, and the certificate for it, attached to the robot's thing; both as PEM."""
    serial = claim.serial or machine_serial()
    if not _SERIAL.fullmatch(serial):
        raise IdentityError(f"serial {serial!r}: allowed is A-Z a-z 0-9 _ . , @ / : # -")
    key, request = make_key(robot)
    with Exchange(claim) as exchange:
        certificate, token = exchange.certify(request)
        parameters = {contract.ROBOT_PARAMETER: robot, contract.SERIAL_PARAMETER: serial}
        thing = register_again(lambda: exchange.register(token, parameters), wait=time.sleep)
    if thing != robot:
        raise IdentityError(f"the cloud registered {thing}, not {robot}: its template is not ours")
    return key, certificate


def register_again(register: Callable[[], str], *, wait: Callable[[float], None]) -> str:
    """Register; where that fails, once more with the same certificate and token, and again.

    AWS IoT gives the fleet's hook 5 s, and a hook that was too late has spent the admission on this
    certificate: no other one would be admitted. Raises the first `IdentityError` in the end.
    """
    first: IdentityError | None = None
    for wait_s in (*_AGAIN_S, None):
        try:
            return register()
        except IdentityError as error:  # noqa: PERF203 - it waits for seconds
            first = first or error
            if wait_s is not None:
                _log.warning("%s; trying again in %g s", error, wait_s)
                wait(wait_s)
    assert first is not None
    raise first


def make_key(robot: str) -> tuple[str, str]:
    """A new key and a request to certify it, both as PEM. The key is in no file yet."""
    key = _openssl(["genpkey", "-algorithm", "EC", "-pkeyopt", "ec_paramgen_curve:P-256"])
    request = _openssl(["req", "-new", "-sha256", "-key", "/dev/stdin", "-subj", f"/CN={robot}"], key)
    return key, request


def machine_serial() -> str:
    """What tells this machine from others, and stays when its disk image is copied, if it has such."""
    for path in _SERIALS:
        with contextlib.suppress(OSError, UnicodeDecodeError):
            serial = path.read_text(encoding="ascii").strip("\0 \n")
            if serial:
                return serial
    raise IdentityError("this machine has no serial number to be found: set `serial` in the claim's file")


def _openssl(arguments: list[str], given: str | None = None) -> str:
    try:
        done = subprocess.run(  # noqa: S603 - the arguments are ours, and no shell reads them
            ["openssl", *arguments],  # noqa: S607 - wherever the distribution has it
            input=given, capture_output=True, text=True, check=False,
        )  # fmt: skip
    except OSError as error:
        raise IdentityError(
            f"the openssl command is needed: {error} (Debian: apt install openssl)"
        ) from error
    if done.returncode:
        raise IdentityError(f"openssl {arguments[0]} failed: {done.stderr.strip()[-300:]}")
    return done.stdout


class Exchange:
    """A connection with the claim, and the two requests."""

    def __init__(self, claim: Claim) -> None:
        # Reading a configuration must not need the network's library.
        from awscrt import mqtt5  # noqa: PLC0415 - the network's library
        from awsiot import mqtt5_client_builder  # noqa: PLC0415 - as above

        self._template = contract.fleet_name(claim.namespace)
        self._ended = threading.Event()
        self._failure: str | None = None
        self._stopped = threading.Event()
        self._connected = False
        self._client: Any = mqtt5_client_builder.mtls_from_path(
            str(claim.certificate),
            str(claim.private_key),
            endpoint=claim.endpoint,
            port=claim.port,
            ca_filepath=None if claim.root_ca is None else str(claim.root_ca),
            client_id=f"{contract.claim_name(claim.namespace)}-{uuid.uuid4().hex[:8]}",
            session_behavior=mqtt5.ClientSessionBehaviorType.CLEAN,
            min_reconnect_delay_ms=60_000,
            max_reconnect_delay_ms=60_000,
            on_lifecycle_connection_success=self._on_success,
            on_lifecycle_connection_failure=self._on_failure,
            on_lifecycle_stopped=lambda _: self._stopped.set(),
        )
        self._requests: Any = None

    def __enter__(self) -> Exchange:  # noqa: PYI034 - Self came with Python 3.11
        from awscrt import mqtt_request_response  # noqa: PLC0415 - the network's library
        from awsiot import iotidentity  # noqa: PLC0415 - the network's library

        self._client.start()
        if not self._ended.wait(_WAIT_S) or not self._connected:
            self.__exit__()
            raise IdentityError(
                f"the claim does not connect: {self._failure or 'no answer'}. Most claims live for minutes "
                "only: ask the operator for a new one (`iort robots claim`)"
            )
        options = mqtt_request_response.ClientOptions(
            max_request_response_subscriptions=4, max_streaming_subscriptions=0
        )
        options.operation_timeout_in_seconds = int(_WAIT_S)
        self._requests = iotidentity.IotIdentityClientV2(self._client, options)
        return self

    def __exit__(self, *_: object) -> None:
        self._requests = None
        self._client.stop()
        self._stopped.wait(_WAIT_S)

    def certify(self, request: str) -> tuple[str, str]:
        """The certificate for a request, and the token that says it is ours."""
        from awsiot import iotidentity  # noqa: PLC0415 - the network's library

        asked = iotidentity.CreateCertificateFromCsrRequest(certificate_signing_request=request)
        answer = self._result("CreateCertificateFromCsr", self._requests.create_certificate_from_csr(asked))
        return str(answer.certificate_pem), str(answer.certificate_ownership_token)

    def register(self, token: str, parameters: Mapping[str, str]) -> str:
        """Register the robot with its certificate; the thing's name."""
        from awsiot import iotidentity  # noqa: PLC0415 - the network's library

        asked = iotidentity.RegisterThingRequest(
            template_name=self._template,
            certificate_ownership_token=token,
            parameters=dict(parameters),
        )
        return str(self._result("RegisterThing", self._requests.register_thing(asked)).thing_name)

    def _result(self, what: str, future: Any) -> Any:
        try:
            return future.result(_WAIT_S + 5)
        except Exception as error:
            modeled = getattr(error, "modeled_error", None)
            said = f"{modeled.error_code}: {modeled.error_message}" if modeled is not None else str(error)
            raise IdentityError(f"{what} was refused: {said}") from error

    def _on_success(self, _: Any) -> None:
        self._connected = True
        self._ended.set()

    def _on_failure(self, data: Any) -> None:
        from device.failures import explain, said  # noqa: PLC0415 - it loads the network's library

        packet = data.connack_packet
        self._failure = said(packet) if packet is not None else explain(data.exception)
        self._ended.set()


def _wait_connected(config: Config, certificate_id: str, status_socket: Path) -> None:
    """Until the robot is connected with the certificate: the agent that runs, or else we ourselves."""
    deadline = time.monotonic() + _SWITCH_S
    state: Mapping[str, Any] = {}
    while time.monotonic() < deadline:
        try:
            state = fetch(status_socket)["connection"]
        except AgentError:
            _try_alone(config)
            return
        if state["connected"] and state["certificate_id"] == certificate_id:
            return
        # The agent looks at its files now and then, and tells nobody.
        time.sleep(_LOOK_S)
    raise IdentityError(f"the running agent did not connect with the new certificate: {state['last_error']}")


def _try_alone(config: Config) -> None:
    from device.check import FAIL, broker_findings  # noqa: PLC0415 - as above

    for finding in broker_findings(config):
        if finding.level == FAIL:
            raise IdentityError(f"the new certificate does not connect: {finding.what}: {finding.text}")


def _previous(path: Path) -> Path:
    return path.with_name(path.name + ".previous")


def _keep_previous(paths: Iterable[Path]) -> None:
    for path in paths:
        if path.exists():
            _write_private(_previous(path), path.read_text(encoding="utf-8"))


def _write_private(path: Path, content: str, mode: int = 0o600) -> None:
    """Replace the file as a whole, readable by its owner alone from its first moment on."""
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    write_below(path.parent, PurePath(path.name), content.encode(), mode=mode, sync=True)


def _update_config(file: Path, settings: Mapping[str, Any]) -> None:
    """Set keys of a configuration, leaving everything else, comments too, as it is; or write a new one."""
    if not file.exists():
        content = {**settings, "sources": _DEFAULT_SOURCES}
        _write_private(file, yaml.safe_dump(content, sort_keys=False))
        return
    lines = file.read_text(encoding="utf-8").splitlines()
    for name, value in settings.items():
        line = f"{name}: {yaml.safe_dump(value).splitlines()[0]}"
        found = [i for i, old in enumerate(lines) if re.match(rf"{name}\s*:", old)]
        if found:
            lines[found[0]] = line
        else:
            lines.insert(0, line)
    text_ = "\n".join(lines) + "\n"
    try:
        written = yaml.safe_load(text_)
    except yaml.YAMLError as error:
        raise ConfigError(f"{file}: cannot be updated, set by hand: {dict(settings)}") from error
    if any(written.get(name) != value for name, value in settings.items()):
        raise ConfigError(f"{file}: cannot be updated, set by hand: {dict(settings)}")
    mode = file.stat().st_mode & 0o777
    _write_private(file, text_, mode)
