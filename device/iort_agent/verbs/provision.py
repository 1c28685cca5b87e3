"""`iort-agent provision` and `renew`: a certificate for a key that is made on the robot and never leaves it.

The robot exchanges a provisioning claim for its own certificate: CreateCertificateFromCsr, then RegisterThing
with the fleet's template. The operator makes claims with `iort robots claim`.
"""

from __future__ import annotations

import os
import re
import time
from pathlib import Path, PurePath
from typing import Any, Mapping

import yaml

from iort_agent.common.private_files import write_below
from iort_agent.config import Config, load_config
from iort_agent.errors import BusyError, ConfigError, IdentityError, NotRunningError
from iort_agent.identity import parse_certificate
from iort_agent.status import ask
from iort_agent.verbs.registration import PENDING, SEAMS, Seams, load_claim, register
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.limits import ContractError
from iort_contract.messages.commands import DOWNLINK_NOTE, VIDEO_NOTE, stick_downlink
from iort_contract.topics import check_robot

_SWITCH_S = 60.0
_LOOK_S = 0.5
_DEFAULT_SOURCES = [{"type": "sim", "stream": VESC_STREAM, "rate_hz": 50}]


def provision(file: Path, *, robot: str | None, seams: Seams = SEAMS) -> Path:
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
    issued = register(claim, name, folder, seams)
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
    (folder / PENDING).unlink(missing_ok=True)
    load_config(config_file)
    return config_file


def renew(file: Path, claim_file: Path, *, status_socket: Path, seams: Seams = SEAMS) -> None:
    """Replace the robot's key and certificate. The old ones are kept until the new ones have connected.

    A running agent notices the new ones. Raises `IdentityError` if the cloud refuses, or if the new
    certificate does not connect; in that case the old one is restored.
    """
    config = load_config(file)
    folder = config.private_key.parent
    issued = register(load_claim(claim_file), config.robot, folder, seams)
    files = (config.private_key, config.certificate)
    _replace(config.private_key, issued.private_key)
    _replace(config.certificate, issued.certificate)
    try:
        _wait_connected(config, parse_certificate(issued.certificate).id, status_socket)
    except BaseException:
        (folder / PENDING).unlink(missing_ok=True)
        for path in files:
            _previous(path).replace(path)
        raise
    (folder / PENDING).unlink(missing_ok=True)
    for path in files:
        _previous(path).unlink()


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
        except BusyError as error:
            # Alone, this would take the connection from it.
            last_error = str(error)
        else:
            if connection.connected and connection.certificate_id == certificate_id:
                return
            last_error = connection.last_error
        # The agent checks its files now and then, and tells nobody.
        time.sleep(_LOOK_S)
    raise IdentityError(f"the running agent did not connect with the new certificate: {last_error}")


def _try_alone(config: Config) -> None:
    from iort_agent.sources import FAIL  # noqa: PLC0415 - only this verb needs it
    from iort_agent.verbs.connectivity import check_connection  # noqa: PLC0415 - it loads TLS and more

    for finding in check_connection(config):
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
        downlink = DOWNLINK_NOTE + yaml.safe_dump({"downlink": stick_downlink()}, sort_keys=False)
        _write_private(file, yaml.safe_dump(content, sort_keys=False) + downlink + VIDEO_NOTE)
        return
    lines = file.read_text(encoding="utf-8").splitlines()
    for name, value in settings.items():
        line = f"{name}: {yaml.safe_dump(value).splitlines()[0]}"
        places = [i for i, old in enumerate(lines) if re.match(rf"{name}\s*:", old)]
        if places:
            lines[places[0]] = line
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
