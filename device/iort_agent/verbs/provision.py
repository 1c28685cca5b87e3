"""`iort-agent provision` and `renew`: a certificate for a key that is made on the robot and never leaves it.

The robot exchanges a provisioning claim for its own certificate: CreateCertificateFromCsr, then RegisterThing
with the fleet's template. The operator makes claims with `iort robots claim`.
"""

from __future__ import annotations

import logging
import os
import re
import time
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any, Callable, Mapping

import yaml

from iort_agent.common.private_files import write_below
from iort_agent.config import Config, load_config
from iort_agent.errors import ConfigError, IdentityError, NotRunningError, RefusedError
from iort_agent.identity.certificate import parse_certificate
from iort_agent.identity.claim import Claim, load_claim
from iort_agent.identity.machine_key import machine_serial, make_key
from iort_agent.identity.pending import Pending, forget, keep, kept
from iort_agent.mqtt.exchange import Exchange
from iort_agent.status.server import ask
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.limits import ContractError
from iort_contract.tables import ROBOT_PARAMETER, SERIAL_PARAMETER
from iort_contract.topics import check_robot

_log = logging.getLogger(__name__)

_SWITCH_S = 60.0
_LOOK_S = 0.5
# Waits before each further try to register.
_AGAIN_S = (1.0, 4.0)
# How AWS IoT's error codes begin for a token or a certificate that is no longer valid.
_NO_LONGER = ("Invalid", "ResourceNotFound")
# The characters that RegisterThing allows in a parameter and a thing in an attribute.
_SERIAL = re.compile(r"[A-Za-z0-9_.,@/:#-]{1,800}")
_DEFAULT_SOURCES = [{"type": "sim", "stream": VESC_STREAM, "rate_hz": 50}]


@dataclass(frozen=True)
class Seams:
    """Replaced by tests: the claim's connection, and waiting."""

    exchange: Callable[[Claim], Exchange] = Exchange
    wait: Callable[[float], None] = time.sleep


_SEAMS = Seams()


def provision(file: Path, *, robot: str | None, seams: Seams = _SEAMS) -> Path:
    """Exchange a claim for the robot's own certificate. Returns the configuration file, which now names it.

    It may be stopped at any time and called again: it continues with the certificate that was issued.
    Raises `ConfigError` for a wrong claim file, `IdentityError` if the cloud refuses.
    """
    claim = load_claim(file)
    name = robot or claim.robot
    if name is None:
        raise ConfigError(f"{file}: robot: required, and missing: give it here or with --robot")
    try:
        check_robot(name)
    except ContractError as error:
        raise ConfigError(str(error)) from error
    config_file = claim.config or file.parent / "car.yaml"
    folder = config_file.parent
    issued = _register(claim, name, folder, seams)
    files = {"certificate": folder / "certificate.pem", "private_key": folder / "private.key"}
    _replace(files["private_key"], issued.private_key)
    _replace(files["certificate"], issued.certificate)
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
    forget(folder)
    load_config(config_file)
    return config_file


def renew(file: Path, claim_file: Path, *, status_socket: Path, seams: Seams = _SEAMS) -> None:
    """Replace the robot's key and certificate. The old ones are kept until the new ones have connected.

    A running agent notices the new ones. Raises `IdentityError` if the cloud refuses, or if the new
    certificate does not connect; in that case the old one is restored.
    """
    config = load_config(file)
    folder = config.private_key.parent
    issued = _register(load_claim(claim_file), config.robot, folder, seams)
    files = (config.private_key, config.certificate)
    _replace(config.private_key, issued.private_key)
    _replace(config.certificate, issued.certificate)
    try:
        _wait_connected(config, parse_certificate(issued.certificate).id, status_socket)
    except BaseException:
        forget(folder)
        for path in files:
            _previous(path).replace(path)
        raise
    forget(folder)
    for path in files:
        _previous(path).unlink()


def _register(claim: Claim, robot: str, folder: Path, seams: Seams) -> Pending:
    """A key and its certificate, registered for the robot's thing: those of an earlier run that was stopped,
    or new ones. `pending` keeps them in the folder until `forget`."""
    serial = claim.serial or machine_serial()
    if not _SERIAL.fullmatch(serial):
        raise IdentityError(f"serial must be of A-Z a-z 0-9 _ . , @ / : # -, got {serial!r}")
    earlier = kept(folder)
    if earlier is not None and earlier.is_for(robot, serial, claim.endpoint, claim.namespace):
        if _finish(claim, earlier, seams):
            return earlier
        _log.warning("the certificate of an earlier run is no longer valid: requesting another")
    key, request = make_key(robot)
    with seams.exchange(claim) as connection:
        certificate, token = connection.certify(request)
        asked_s = time.time()
        issued = Pending(robot, serial, claim.endpoint, claim.namespace, key, certificate, token, asked_s)
        keep(folder, issued)
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


def _wait_connected(config: Config, certificate_id: str, status_socket: Path) -> None:
    """Wait until the running agent is connected with the certificate; if none runs, connect once."""
    deadline = time.monotonic() + _SWITCH_S
    last_error = None
    while time.monotonic() < deadline:
        try:
            connection = ask(status_socket).connection
        except NotRunningError:
            _try_alone(config)
            return
        if connection.connected and connection.certificate_id == certificate_id:
            return
        last_error = connection.last_error
        # The agent checks its files now and then, and tells nobody.
        time.sleep(_LOOK_S)
    raise IdentityError(f"the running agent did not connect with the new certificate: {last_error}")


def _try_alone(config: Config) -> None:
    from iort_agent.sources import FAIL  # noqa: PLC0415 - only this verb needs it
    from iort_agent.verbs.check import broker_findings  # noqa: PLC0415 - it loads TLS and more

    for finding in broker_findings(config):
        if finding.level == FAIL:
            raise IdentityError(f"the new certificate does not connect: {finding.what}: {finding.text}")


def _previous(path: Path) -> Path:
    return path.with_name(path.name + ".previous")


def _replace(path: Path, content: str) -> None:
    """Write a file and keep its previous content, unless an earlier run did so."""
    if path.exists():
        before = path.read_text(encoding="utf-8")
        if before == content:
            return
        _write_private(_previous(path), before)
    _write_private(path, content)


def _write_private(path: Path, content: str, mode: int = 0o600) -> None:
    """Replace the whole file; from the start, only its owner may read it."""
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    write_below(path.parent, PurePath(path.name), content.encode(), mode=mode, sync=True)


def _update_config(file: Path, settings: Mapping[str, Any]) -> None:
    """Set keys of a configuration and leave everything else, comments included, or write a new one."""
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
    updated = "\n".join(lines) + "\n"
    try:
        good = settings.items() <= yaml.safe_load(updated).items()
    except yaml.YAMLError:
        good = False
    if not good:
        raise ConfigError(f"{file}: cannot be updated, set by hand: {dict(settings)}")
    _write_private(file, updated, file.stat().st_mode & 0o777)
