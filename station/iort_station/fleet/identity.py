"""Who a robot is to the broker: certificates and their rotation, provisioning claims, and the robot's bundle.

A bundle is a folder with car.yaml, certificate and key, readable by its owner only. A robot exchanges a claim
for a certificate; its name is opened for one certificate and for a limited time, which functions/admit.py
enforces. A rotation deletes the old certificates once the robot has stayed connected with its new one.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import yaml
from botocore.exceptions import ClientError
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.cloud import claim_name, fleet_name
from iort_contract.messages.commands import DOWNLINK_NOTE, VIDEO_NOTE, stick_downlink
from iort_contract.tables import CERTIFICATE_ID, ONLINE, SERIAL, SESSION_VERSION
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.fleet import registry
from iort_station.fleet.registry import F1TENTH
from iort_station.output import write_private

if TYPE_CHECKING:
    from types_boto3_iot import IoTClient


class Certificate(NamedTuple):
    """A certificate at AWS IoT; ``status`` is ACTIVE, INACTIVE, REVOKED or PENDING_ACTIVATION."""

    id: str
    arn: str
    status: str
    created: datetime
    expires: datetime | None


class NewCertificate(NamedTuple):
    """A new certificate and its private key as PEM; nothing else keeps the key."""

    id: str
    arn: str
    pem: str
    private_key_pem: str


def make_certificate(iot: IoTClient, name: str) -> NewCertificate:
    """Make a key on the curve P-256, which stays on this machine, and an active certificate for it.

    Raises botocore's `ClientError` if AWS refuses.
    """
    key = ec.generate_private_key(ec.SECP256R1())
    request = x509.CertificateSigningRequestBuilder(
        subject_name=x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    ).sign(key, hashes.SHA256())
    pem = request.public_bytes(serialization.Encoding.PEM).decode()
    answer = iot.create_certificate_from_csr(certificateSigningRequest=pem, setAsActive=True)
    private = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    return NewCertificate(
        answer["certificateId"], answer["certificateArn"], answer["certificatePem"], private.decode()
    )


def fingerprint(pem: str) -> str:
    """The SHA-256 of a certificate, in hex."""
    return x509.load_pem_x509_certificate(pem.encode()).fingerprint(hashes.SHA256()).hex()


def certificates(cloud: Cloud, robot: str) -> list[Certificate]:
    """The certificates of the robot's thing, the oldest first; empty without a thing."""
    iot = cloud.client("iot")
    try:
        pages = iot.get_paginator("list_thing_principals").paginate(thingName=robot)
        arns = [arn for page in pages for arn in page["principals"]]
    except iot.exceptions.ResourceNotFoundException:
        return []
    return sorted((_described(iot, arn) for arn in arns), key=lambda certificate: certificate.created)


def _described(iot: IoTClient, arn: str) -> Certificate:
    number = arn.rsplit("/", 1)[-1]
    description = iot.describe_certificate(certificateId=number)["certificateDescription"]
    expires = description.get("validity", {}).get("notAfter")
    return Certificate(number, arn, description["status"], description["creationDate"], expires)


def revoke_certificate(cloud: Cloud, certificate: Certificate) -> None:
    """Revoke a certificate, permanently."""
    cloud.client("iot").update_certificate(certificateId=certificate.id, newStatus="REVOKED")


def delete_certificate(cloud: Cloud, robot: str, certificate: Certificate) -> None:
    """Detach a revoked certificate from the robot, and delete it."""
    iot, arn = cloud.client("iot"), certificate.arn
    iot.detach_policy(policyName=fleet_name(cloud.namespace), target=arn)
    iot.detach_thing_principal(thingName=robot, principal=arn)
    once_detached(iot, iot.delete_certificate, certificateId=certificate.id, forceDelete=True)


def once_detached(iot: IoTClient, change: Callable[..., Any], **what: Any) -> None:
    """Delete something that was just detached: AWS takes seconds to register that, and sends no event."""
    for pause_s in (0.5, 1.0, 2.0, 4.0, 8.0, 16.0):
        try:
            change(**what)
        except (  # noqa: PERF203 - the loop retries
            iot.exceptions.DeleteConflictException,
            iot.exceptions.InvalidRequestException,
        ):
            time.sleep(pause_s)
        else:
            return
    change(**what)


def end_session(cloud: Cloud, robot: str) -> bool:
    """End the robot's session with its queued messages; returns whether it had one."""
    data = cloud.client("iot-data")
    try:
        # A removed robot must not publish its last will.
        data.delete_connection(clientId=robot, cleanSession=True, preventWillMessage=True)
    except data.exceptions.ResourceNotFoundException:
        return False
    return True


@dataclass(frozen=True)
class Bundle:
    """The folder of car.yaml and the files that it names."""

    robot: str
    folder: Path

    @property
    def config(self) -> Path:
        return self.folder / "car.yaml"


def write_bundle(
    cloud: Cloud, bundle: Bundle, certificate_pem: str, private_key_pem: str, settings: Mapping[str, Any]
) -> None:
    """Write the bundle's files."""
    written = connection(cloud, bundle.folder, certificate_pem, private_key_pem)
    config: dict[str, Any] = {"robot": bundle.robot, **written}
    config["sources"] = [{"type": "sim", "stream": VESC_STREAM, "rate_hz": 50}]
    config["queue"] = {"path": "queue.db"}
    config.update(settings)
    text = yaml.safe_dump(config, sort_keys=False)
    # Other sources may have no ROS graph to take commands.
    if not {"sources", "downlink"} & settings.keys():
        text += DOWNLINK_NOTE + yaml.safe_dump({"downlink": stick_downlink()}, sort_keys=False) + VIDEO_NOTE
    write_private(bundle.config, text)


def connection(
    cloud: Cloud, folder: Path, certificate_pem: str, private_key_pem: str, *, prefix: str = ""
) -> dict[str, Any]:
    """Write the connection's files into the folder; returns the settings that name them."""
    files = {"certificate": f"{prefix}certificate.pem", "private_key": f"{prefix}private.key"}
    write_private(folder / files["certificate"], certificate_pem)
    write_private(folder / files["private_key"], private_key_pem)
    if cloud.root_ca_pem is not None:
        files["root_ca"] = "root-ca.pem"
        write_private(folder / files["root_ca"], cloud.root_ca_pem)
    return {
        "namespace": cloud.namespace,
        "endpoint": cloud.mqtt_endpoint,
        "port": cloud.mqtt_port,
        **files,
    }


def configure(bundle: Bundle, settings: Mapping[str, Any]) -> None:
    """Change settings in a bundle's car.yaml."""
    config = yaml.safe_load(bundle.config.read_text())
    write_private(bundle.config, yaml.safe_dump({**config, **settings}, sort_keys=False))


# The claim's file in its folder.
CLAIM_FILE = "claim.yaml"
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
            new = make_certificate(iot, claim_name(cloud.namespace))
            iot.attach_policy(policyName=claim_name(cloud.namespace), target=new.arn)
            number, certificate, key = new.id, new.pem, new.private_key_pem
        else:
            created = iot.create_provisioning_claim(templateName=fleet_name(cloud.namespace))
            number, certificate = created["certificateId"], created["certificatePem"]
            key = created["keyPair"]["PrivateKey"]
    except ClientError as error:
        raise StationError(f"the claim failed; are the current stacks deployed? {error}") from error
    if robot is not None:
        for_s = DAYS * _DAY_S if lasting else _CLAIM_S
        known_by = registry.ClaimId(number, fingerprint(certificate))
        registry.open_name(cloud, robot, for_s=for_s, claim=known_by)
    out.mkdir(parents=True, exist_ok=True, mode=0o700)
    settings.update(connection(cloud, out, certificate, key, prefix="claim-"))
    path = out / CLAIM_FILE
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


def revoke_claims(cloud: Cloud) -> int:
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


# `iort-agent renew` returns to the old certificate if the new one does not connect within 60 s, so a robot
# keeps a connection that is older than that.
SETTLED_S = 90.0
_LOOK_S = 1.0


def finish_rotation(
    cloud: Cloud,
    robot: str,
    *,
    settled_s: float = SETTLED_S,
    wait_s: float = 3600.0,
    progress: Callable[[str], None] = lambda _what: None,
) -> list[Certificate]:
    """Wait until the robot has been connected with its newest certificate for ``settled_s`` without a break,
    then revoke and delete the others; returns these.

    Nothing changes before that, so the robot can always connect, and the wait may be stopped and repeated.
    ``progress`` receives what it waits for. Raises `StationError` if the robot is not registered, has no
    active certificate, or does not settle within ``wait_s``.
    """
    registry.get(cloud, robot)
    deadline, settling, said = time.monotonic() + wait_s, None, ""
    while True:
        held = certificates(cloud, robot)
        active = [certificate for certificate in held if certificate.status == "ACTIVE"]
        if not active:
            raise StationError(f"robot {robot} has no active certificate: make a claim (`iort robots claim`)")
        newest, row = active[-1], registry.get(cloud, robot)
        if not row.get(ONLINE):
            now, session = f"{robot} is not connected", None
        elif row.get(CERTIFICATE_ID) != newest.id:
            now, session = f"{robot} is still connected with an older certificate", None
        else:
            now, session = f"{robot} has its new certificate", (newest.id, row.get(SESSION_VERSION))
        if session is None:
            settling = None
        elif settling is None or settling[0] != session:
            settling = (session, time.monotonic())
        if settling is not None and time.monotonic() - settling[1] >= settled_s:
            break
        if now != said:
            progress(now)
            said = now
        if time.monotonic() > deadline:
            raise StationError(f"{now}; its old certificate stays. Run this again later")
        # The registry sends no events.
        time.sleep(_LOOK_S)
    old = [certificate for certificate in held if certificate.id != newest.id]
    for certificate in old:
        revoke_certificate(cloud, certificate)
        delete_certificate(cloud, robot, certificate)
    return old
