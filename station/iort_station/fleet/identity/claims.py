"""Provisioning claims, which a robot exchanges for a certificate, and the names that they may have.

A name is opened for one certificate and for a limited time; functions/admit.py enforces that.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml
from botocore.exceptions import ClientError

from iort_contract.cloud import claim_name, fleet_name
from iort_contract.tables import SERIAL
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.fleet import registry
from iort_station.fleet.identity import certificates
from iort_station.fleet.identity.bundle import connection, write_private
from iort_station.fleet.identity.certificates import once_detached
from iort_station.fleet.registry import F1TENTH

if TYPE_CHECKING:
    from types_boto3_iot import IoTClient

# The claim's file in its folder.
FILE = "claim.yaml"
# AWS' own claims can connect for five minutes; the margin is for one that connects at the end.
_CLAIM_S = 6 * 60
DAYS = 30
_DAY_S = 86_400


def claim(
    cloud: Cloud,
    robot: str | None,
    *,
    out: Path,
    lasting: bool = False,
) -> Path:
    """Write a claim into ``out``, which `iort-agent provision` or `renew` exchanges for a certificate.

    It is valid for five minutes and for ``robot``. A new robot is registered as an F1TENTH car; a registered
    one is opened for another certificate. A ``lasting`` claim is valid until it is revoked, for many robots
    (``robot`` None) with the names of `register`.

    Raises `StationError` for an invalid name, and for a deployment without the template.
    """
    iot = cloud.client("iot")
    settings: dict[str, Any] = {}
    if robot is not None:
        settings["robot"] = registry.checked(robot)
        if registry.find(cloud, robot) is None:
            registry.enter(cloud, robot, F1TENTH)
        settings.update(_serial_of(iot, robot))
    try:
        if lasting:
            made = certificates.make(iot, claim_name(cloud.namespace))
            iot.attach_policy(policyName=claim_name(cloud.namespace), target=made.arn)
            number, certificate, key = made.id, made.pem, made.private_key_pem
        else:
            created = iot.create_provisioning_claim(templateName=fleet_name(cloud.namespace))
            number, certificate = created["certificateId"], created["certificatePem"]
            key = created["keyPair"]["PrivateKey"]
    except ClientError as error:
        raise StationError(f"the claim failed; are the current stacks deployed? {error}") from error
    if robot is not None:
        for_s = DAYS * _DAY_S if lasting else _CLAIM_S
        known_by = registry.ClaimId(number, certificates.fingerprint(certificate))
        registry.open_name(cloud, robot, for_s=for_s, claim=known_by)
    out.mkdir(parents=True, exist_ok=True, mode=0o700)
    settings.update(connection(cloud, out, certificate, key, prefix="claim-"))
    path = out / FILE
    write_private(path, yaml.safe_dump(settings, sort_keys=False))
    return path


def register(
    cloud: Cloud,
    robot: str,
    *,
    serial: str | None = None,
    days: float = DAYS,
    vehicle: Mapping[str, float] = F1TENTH,
) -> None:
    """Pre-register a robot: a lasting claim can claim its name once, within ``days``. With ``serial``, only
    the machine with this serial number can.

    Raises `StationError` for a registered robot; `claim` opens its name again.
    """
    row = dict(vehicle) if serial is None else {**vehicle, SERIAL: serial}
    registry.enter(cloud, robot, row)
    registry.open_name(cloud, robot, for_s=days * _DAY_S, claim=None)


def revoke_all(cloud: Cloud) -> int:
    """Revoke and delete every lasting claim; returns their number."""
    iot, policy = cloud.client("iot"), claim_name(cloud.namespace)
    pages = iot.get_paginator("list_targets_for_policy").paginate(policyName=policy)
    targets = [target for page in pages for target in page["targets"]]
    for target in targets:
        number = target.rsplit("/", 1)[-1]
        iot.update_certificate(certificateId=number, newStatus="REVOKED")
        iot.detach_policy(policyName=policy, target=target)
        once_detached(iot, iot.delete_certificate, certificateId=number, forceDelete=True)
    return len(targets)


def _serial_of(iot: IoTClient, robot: str) -> dict[str, str]:
    """The serial number of an existing thing, which provisioning must repeat; its name if it has none."""
    try:
        attributes = iot.describe_thing(thingName=robot).get("attributes", {})
    except iot.exceptions.ResourceNotFoundException:
        return {}
    if "serial" not in attributes:
        iot.update_thing(thingName=robot, attributePayload={"attributes": {"serial": robot}, "merge": True})
    return {"serial": attributes.get("serial", robot)}
