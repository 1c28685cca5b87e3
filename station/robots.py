"""The robots that may connect: thing, certificate, policy and the registry's row."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Any

import yaml
from boto3.dynamodb.types import TypeDeserializer, TypeSerializer
from botocore.exceptions import ClientError

from contract import ROBOT, VESC_STREAM, ContractError, check_robot, claim_name, fleet_name
from station.cloud import Cloud
from station.errors import StationError

# The F1TENTH stack's vesc.yaml: erpm = gain * m/s + offset.
F1TENTH = {"speed_to_erpm_gain": 4614.0, "speed_to_erpm_offset": 0.0}


@dataclass(frozen=True)
class Bundle:
    """The folder that a robot needs: car.yaml and the files that it names."""

    robot: str
    folder: Path

    @property
    def config(self) -> Path:
        """The agent's configuration."""
        return self.folder / "car.yaml"


def add(
    cloud: Cloud,
    robot: str,
    *,
    out: Path,
    vehicle: Mapping[str, float] = F1TENTH,
    settings: Mapping[str, Any] | None = None,
) -> Bundle:
    """Register a robot and write its bundle into ``out/<robot>``, readable by the owner alone.

    ``vehicle`` are the parameters that Lambda 2 derives speed from; ``settings`` are more of the
    agent's settings for car.yaml (the source is a simulated car unless they say otherwise).

    Raises `StationError` for a name that is not allowed, a robot that is already there, and a
    deployment without the fleet stack.
    """
    try:
        check_robot(robot)
    except ContractError as error:
        raise StationError(str(error)) from error
    folder = out / robot
    if folder.exists() and any(folder.iterdir()):
        raise StationError(f"{folder} is not empty; its keys would be lost")
    # Before anything is registered: the private key that comes back is the only copy.
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    _enter(cloud, robot, vehicle)
    iot, fleet = cloud.client("iot"), fleet_name(cloud.namespace)
    try:
        iot.create_thing(
            thingName=robot, thingTypeName=fleet, attributePayload={"attributes": {"vehicle": "vesc"}}
        )
        iot.add_thing_to_thing_group(thingGroupName=fleet, thingName=robot)
        created = iot.create_keys_and_certificate(setAsActive=True)
        iot.attach_policy(policyName=fleet, target=created["certificateArn"])
        iot.attach_thing_principal(thingName=robot, principal=created["certificateArn"])
    except ClientError as error:
        raise StationError(
            f"robot {robot} is registered in part; remove it and try again: {error}"
        ) from error
    bundle = Bundle(robot, folder)
    _write_bundle(cloud, bundle, created, settings or {})
    return bundle


def claim(
    cloud: Cloud,
    robot: str | None,
    *,
    out: Path,
    vehicle: Mapping[str, float] = F1TENTH,
    lasting: bool = False,
) -> Path:
    """Write a claim into ``out``, which `iort-agent provision` or `renew` exchanges for a certificate.

    It is good for five minutes, for whoever installs the robot; ``lasting``, until it is revoked, to
    be put on many robots before their names are known (``robot`` None), and then to be guarded: until
    the template has a hook, it can get a certificate for any name that has no other serial number.
    A ``robot`` that is not registered yet is entered with its ``vehicle`` parameters.

    Raises `StationError` for a name that is not allowed and a deployment without the template.
    """
    iot, fleet = cloud.client("iot"), fleet_name(cloud.namespace)
    settings: dict[str, Any] = {}
    if robot is not None:
        try:
            settings["robot"] = check_robot(robot)
        except ContractError as error:
            raise StationError(str(error)) from error
        if not _is_entered(cloud, robot):
            _enter(cloud, robot, vehicle)
        settings.update(_serial_of(iot, robot))
    try:
        if lasting:
            created = iot.create_keys_and_certificate(setAsActive=True)
            iot.attach_policy(policyName=claim_name(cloud.namespace), target=created["certificateArn"])
        else:
            created = iot.create_provisioning_claim(templateName=fleet)
    except ClientError as error:
        raise StationError(f"no claim can be made; are the current stacks deployed? {error}") from error
    out.mkdir(parents=True, exist_ok=True, mode=0o700)
    settings.update(_connection(cloud, out, created, prefix="claim-"))
    path = out / "claim.yaml"
    _write_private(path, yaml.safe_dump(settings, sort_keys=False))
    return path


def _is_entered(cloud: Cloud, robot: str) -> bool:
    table, key = cloud.output("storage", "RobotsTable"), {ROBOT: {"S": robot}}
    return "Item" in cloud.client("dynamodb").get_item(TableName=table, Key=key)


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


def listed(cloud: Cloud) -> Iterator[dict[str, Any]]:
    """Every row of the registry, in no order."""
    deserialize = TypeDeserializer().deserialize
    pages = cloud.client("dynamodb").get_paginator("scan")
    for page in pages.paginate(TableName=cloud.output("storage", "RobotsTable")):
        for item in page["Items"]:
            yield {name: deserialize(value) for name, value in item.items()}


def row(cloud: Cloud, robot: str) -> dict[str, Any] | None:
    """The robot's row of the registry, None where it has none."""
    deserialize = TypeDeserializer().deserialize
    table, key = cloud.output("storage", "RobotsTable"), {ROBOT: {"S": robot}}
    item = cloud.client("dynamodb").get_item(TableName=table, Key=key).get("Item")
    return None if item is None else {name: deserialize(value) for name, value in item.items()}


def remove(cloud: Cloud, robot: str) -> None:
    """Take a robot away: its certificates are revoked and deleted, then its thing and its row.

    Raises `StationError` for a robot that is not registered.
    """
    iot, fleet = cloud.client("iot"), fleet_name(cloud.namespace)
    table, key = cloud.output("storage", "RobotsTable"), {ROBOT: {"S": robot}}
    if not _is_entered(cloud, robot):
        raise StationError(f"robot {robot} is not registered")
    try:
        pages = iot.get_paginator("list_thing_principals").paginate(thingName=robot)
        principals = [arn for page in pages for arn in page["principals"]]
    except iot.exceptions.ResourceNotFoundException:
        # Registered in part: the row came first.
        principals = []
    for arn in principals:
        certificate = arn.rsplit("/", 1)[-1]
        iot.update_certificate(certificateId=certificate, newStatus="REVOKED")
        iot.detach_thing_principal(thingName=robot, principal=arn)
        iot.detach_policy(policyName=fleet, target=arn)
        _once_detached(iot, iot.delete_certificate, certificateId=certificate, forceDelete=True)
    _once_detached(iot, iot.delete_thing, thingName=robot)
    cloud.client("dynamodb").delete_item(TableName=table, Key=key)


def _once_detached(iot: Any, delete: Callable[..., Any], **what: Any) -> None:
    """Delete what has just been detached: AWS takes some seconds to know of it, and tells nobody when."""
    for pause_s in (0.5, 1.0, 2.0, 4.0, 8.0, 16.0):
        try:
            delete(**what)
        except (  # noqa: PERF203 - trying again is what the loop is for
            iot.exceptions.DeleteConflictException,
            iot.exceptions.InvalidRequestException,
        ):
            time.sleep(pause_s)
        else:
            return
    delete(**what)


def _enter(cloud: Cloud, robot: str, vehicle: Mapping[str, float]) -> None:
    """Write the registry's row, which is what makes a name taken: making a thing twice is no error."""
    serialize = TypeSerializer().serialize
    row = {ROBOT: robot, **{name: Decimal(repr(value)) for name, value in vehicle.items()}}
    dynamodb = cloud.client("dynamodb")
    try:
        dynamodb.put_item(
            TableName=cloud.output("storage", "RobotsTable"),
            Item={name: serialize(value) for name, value in row.items()},
            ConditionExpression="attribute_not_exists(#robot)",
            ExpressionAttributeNames={"#robot": ROBOT},
        )
    except dynamodb.exceptions.ConditionalCheckFailedException as error:
        raise StationError(f"robot {robot} is already registered; remove it first") from error


def _write_bundle(
    cloud: Cloud, bundle: Bundle, created: Mapping[str, Any], settings: Mapping[str, Any]
) -> None:
    config: dict[str, Any] = {"robot": bundle.robot, **_connection(cloud, bundle.folder, created)}
    config["sources"] = [{"type": "sim", "stream": VESC_STREAM, "rate_hz": 50}]
    config["queue"] = {"path": "queue.db"}
    config.update(settings)
    _write_private(bundle.config, yaml.safe_dump(config, sort_keys=False))


def _connection(
    cloud: Cloud, folder: Path, created: Mapping[str, Any], *, prefix: str = ""
) -> dict[str, Any]:
    """Write what the connection needs into the folder; the settings that name it."""
    files = {"certificate": f"{prefix}certificate.pem", "private_key": f"{prefix}private.key"}
    _write_private(folder / files["certificate"], created["certificatePem"])
    _write_private(folder / files["private_key"], created["keyPair"]["PrivateKey"])
    if cloud.root_ca_pem is not None:
        files["root_ca"] = "root-ca.pem"
        _write_private(folder / files["root_ca"], cloud.root_ca_pem)
    return {
        "namespace": cloud.namespace,
        "endpoint": cloud.mqtt_endpoint,
        "port": cloud.mqtt_port,
        **files,
    }


def configure(bundle: Bundle, settings: Mapping[str, Any]) -> None:
    """Change some of the agent's settings in a bundle's car.yaml."""
    config = yaml.safe_load(bundle.config.read_text())
    _write_private(bundle.config, yaml.safe_dump({**config, **settings}, sort_keys=False))


def _write_private(path: Path, text: str) -> None:
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w") as file:
        file.write(text)
