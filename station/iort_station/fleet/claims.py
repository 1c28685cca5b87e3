"""Claims, which a robot exchanges for a certificate of its own key, and the names that they may have.

A name is opened for one certificate and for a time; functions/admit.py holds every claim to that.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml
from botocore.exceptions import ClientError

from iort_contract.cloud import claim_name, fleet_name
from iort_contract.tables import SERIAL
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.fleet import certificates, registry
from iort_station.fleet.bundle import connection, write_private
from iort_station.fleet.certificates import once_detached
from iort_station.fleet.robots import F1TENTH

# AWS' own claims connect for five minutes; one that connected in the last of them gets its answer.
_CLAIM_S = 6 * 60
DAYS = 30
_DAY_S = 86_400


def claim(
    cloud: Cloud,
    robot: str | None,
    *,
    out: Path,
    vehicle: Mapping[str, float] = F1TENTH,
    lasting: bool = False,
) -> Path:
    """Write a claim into ``out``, which `iort-agent provision` or `renew` exchanges for a certificate.

    It is good for five minutes and for ``robot``, which is entered with its ``vehicle`` parameters if it
    is not registered yet; a name that is taken is opened for another certificate. ``lasting``, it is
    good until it is revoked, to be put on many robots (``robot`` None); which names it may have,
    `register` says.

    Raises `StationError` for a name that is not allowed and a deployment without the template.
    """
    iot = cloud.client("iot")
    settings: dict[str, Any] = {}
    if robot is not None:
        settings["robot"] = registry.checked(robot)
        if registry.find(cloud, robot) is None:
            registry.enter(cloud, robot, vehicle)
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
        raise StationError(f"no claim can be made; are the current stacks deployed? {error}") from error
    if robot is not None:
        for_s = DAYS * _DAY_S if lasting else _CLAIM_S
        known_by = registry.ClaimId(number, certificates.fingerprint(certificate))
        registry.open_name(cloud, robot, for_s=for_s, claim=known_by)
    out.mkdir(parents=True, exist_ok=True, mode=0o700)
    settings.update(connection(cloud, out, certificate, key, prefix="claim-"))
    path = out / "claim.yaml"
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
    """Expect a robot: any of the fleet's claims may have its name, once, within the time; the machine
    with the ``serial`` alone, if one is given.

    Raises `StationError` where the robot is registered already: `claim` opens its name again.
    """
    row = dict(vehicle) if serial is None else {**vehicle, SERIAL: serial}
    registry.enter(cloud, robot, row)
    registry.open_name(cloud, robot, for_s=days * _DAY_S, claim=None)


def revoke_all(cloud: Cloud) -> int:
    """Revoke and delete every lasting claim; how many there were."""
    iot, policy = cloud.client("iot"), claim_name(cloud.namespace)
    pages = iot.get_paginator("list_targets_for_policy").paginate(policyName=policy)
    targets = [target for page in pages for target in page["targets"]]
    for target in targets:
        number = target.rsplit("/", 1)[-1]
        iot.update_certificate(certificateId=number, newStatus="REVOKED")
        iot.detach_policy(policyName=policy, target=target)
        once_detached(iot, iot.delete_certificate, certificateId=number, forceDelete=True)
    return len(targets)


def _serial_of(iot: Any, robot: str) -> dict[str, str]:
    """The serial number of a thing that exists, which provisioning must repeat; its name if it has none."""
    try:
        attributes = iot.describe_thing(thingName=robot).get("attributes", {})
    except iot.exceptions.ResourceNotFoundException:
        return {}
    if "serial" not in attributes:
        merged = {"attributes": {"serial": robot}, "merge": True}
        iot.update_thing(thingName=robot, attributePayload=merged)
    return {"serial": attributes.get("serial", robot)}
