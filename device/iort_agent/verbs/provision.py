"""`iort-agent provision` and `renew`: a certificate for a key that was made on the robot and never leaves it.

A claim, a certificate good for this alone, is exchanged for the robot's own: CreateCertificateFromCsr,
then RegisterThing with the fleet's template. The operator makes claims with `iort robots claim`.
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

from iort_agent.config.file import Config, load_config
from iort_agent.errors import ConfigError, IdentityError, NotRunningError, RefusedError
from iort_agent.identity.certificate import parse_certificate
from iort_agent.identity.claim import Claim, load_claim
from iort_agent.identity.machine_key import machine_serial, make_key
from iort_agent.identity.pending import Pending, forget, keep, kept
from iort_agent.mqtt.exchange import Exchange
from iort_agent.private_files import write_below
from iort_agent.status.server import ask
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.limits import ContractError
from iort_contract.tables import ROBOT_PARAMETER, SERIAL_PARAMETER
from iort_contract.topics import check_robot

_log = logging.getLogger(__name__)

_SWITCH_S = 60.0
_LOOK_S = 0.5
# Before each further try to register.
_AGAIN_S = (1.0, 4.0)
# AWS IoT's codes, or how they begin, where a token or its certificate is no longer good.
_NO_LONGER = ("Invalid", "ResourceNotFound")
# What RegisterThing takes as a parameter and a thing as an attribute.
_SERIAL = re.compile(r"[A-Za-z0-9_.,@/:#-]{1,800}")
_DEFAULT_SOURCES = [{"type": "sim", "stream": VESC_STREAM, "rate_hz": 50}]


@dataclass(frozen=True)
class Run:
    """What a run reaches the world by: a claim's connection, which lasts a `with`, and time."""

    exchange: Callable[[Claim], Exchange] = Exchange
    wait: Callable[[float], None] = time.sleep


_RUN = Run()


def provision(file: Path, *, robot: str | None, run: Run = _RUN) -> Path:
    """Get the robot's own certificate for a claim; the configuration that now names it.

    May be stopped at any time and called again: it goes on with the certificate that it was issued.
    Raises `ConfigError` for a claim file that is wrong, `IdentityError` where the cloud refuses.
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
    issued = _register(claim, name, folder, run)
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


def renew(file: Path, claim_file: Path, *, status_socket: Path, run: Run = _RUN) -> None:
    """Replace the robot's key and certificate, and keep the old ones until the new ones connected.

    A running agent takes the new ones by itself. Raises `IdentityError` where the cloud refuses or
    the new certificate does not connect; the old one is in its place again then.
    """
    config = load_config(file)
    folder = config.private_key.parent
    issued = _register(load_claim(claim_file), config.robot, folder, run)
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


def _register(claim: Claim, robot: str, folder: Path, run: Run) -> Pending:
    """A new key, and the certificate for it, attached to the robot's thing: those of an earlier run that was
    stopped, or others. They stay in the folder, as `pending` keeps them, until `forget`."""
    serial = claim.serial or machine_serial()
    if not _SERIAL.fullmatch(serial):
        raise IdentityError(f"serial {serial!r}: allowed is A-Z a-z 0-9 _ . , @ / : # -")
    earlier = kept(folder)
    if earlier is not None and earlier.is_for(robot, serial, claim.endpoint, claim.namespace):
        if _finish(claim, earlier, run):
            return earlier
        _log.warning("the certificate that an earlier run was issued is no longer good: asking for another")
    key, request = make_key(robot)
    with run.exchange(claim) as connection:
        certificate, token = connection.certify(request)
        asked_s = time.time()
        issued = Pending(robot, serial, claim.endpoint, claim.namespace, key, certificate, token, asked_s)
        keep(folder, issued)
        _ask(connection, issued, run)
    return issued


def _finish(claim: Claim, earlier: Pending, run: Run) -> bool:
    """Whether an earlier run's certificate is registered now; False where it never can be.

    Raises `IdentityError` where it may be registered later: whom the hook refuses now, it refuses with any
    certificate.
    """
    expired = not earlier.may_register(time.time())
    try:
        # Without a network no certificate connects, which says nothing about this one: ask for another only
        # while the claim connects.
        with run.exchange(claim) as connection:
            if expired:
                return _is_registered(connection, earlier)
            _ask(connection, earlier, run)
    except IdentityError as error:
        if _is_no_longer_good(error):
            return False
        # The claim may have ended meanwhile.
        if not _is_registered(run.exchange(claim), earlier):
            raise
    return True


def _ask(connection: Exchange, issued: Pending, run: Run) -> None:
    parameters = {ROBOT_PARAMETER: issued.robot, SERIAL_PARAMETER: issued.serial}
    try:
        thing = register_again(lambda: connection.register(issued.token, parameters), wait=run.wait)
    except IdentityError:
        # An answer may have been lost, and AWS does not say what a token is answered that was used.
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
    """Register; where that fails and the token may be good, once more with the same one, and again.

    AWS IoT gives the fleet's hook 5 s, and a hook that was too late has given the name to this certificate:
    for a while no other one would be admitted. Raises the first `IdentityError` in the end.
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
    """Until the robot is connected with the certificate: the agent that runs, or else we ourselves."""
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
        # The agent looks at its files now and then, and tells nobody.
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
    """Put it in its place and keep what was there, unless an earlier run did so."""
    if path.exists():
        before = path.read_text(encoding="utf-8")
        if before == content:
            return
        _write_private(_previous(path), before)
    _write_private(path, content)


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
