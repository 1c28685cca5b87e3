"""A robot's certificates at AWS IoT: made, listed, revoked and deleted."""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import datetime
from typing import TYPE_CHECKING, Any, NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from iort_contract.cloud import fleet_name
from iort_station.cloud import Cloud

if TYPE_CHECKING:
    from types_boto3_iot import IoTClient


class Certificate(NamedTuple):
    """A certificate at AWS IoT; ``status`` is ACTIVE, INACTIVE, REVOKED or PENDING_ACTIVATION."""

    id: str
    arn: str
    status: str
    created: datetime
    expires: datetime | None


class Made(NamedTuple):
    """A new certificate and its private key as PEM; nothing else keeps the key."""

    id: str
    arn: str
    pem: str
    private_key_pem: str


def make(iot: IoTClient, name: str) -> Made:
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
    return Made(answer["certificateId"], answer["certificateArn"], answer["certificatePem"], private.decode())


def fingerprint(pem: str) -> str:
    """The SHA-256 of a certificate, in hex."""
    return x509.load_pem_x509_certificate(pem.encode()).fingerprint(hashes.SHA256()).hex()


def attached(cloud: Cloud, robot: str) -> list[Certificate]:
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
    said = iot.describe_certificate(certificateId=number)["certificateDescription"]
    expires = said.get("validity", {}).get("notAfter")
    return Certificate(number, arn, said["status"], said["creationDate"], expires)


def revoke(cloud: Cloud, certificate: Certificate) -> None:
    """Revoke a certificate, permanently."""
    cloud.client("iot").update_certificate(certificateId=certificate.id, newStatus="REVOKED")


def delete(cloud: Cloud, robot: str, certificate: Certificate) -> None:
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


def cut(cloud: Cloud, robot: str) -> bool:
    """End the robot's session with its queued messages; returns whether it had one."""
    data = cloud.client("iot-data")
    try:
        # A removed robot must not publish its last will.
        data.delete_connection(clientId=robot, cleanSession=True, preventWillMessage=True)
    except data.exceptions.ResourceNotFoundException:
        return False
    return True
