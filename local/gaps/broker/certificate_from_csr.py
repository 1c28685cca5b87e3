"""Fleet provisioning with a key that the device made.

AWS: CreateCertificateFromCsr signs a certificate request over MQTT
  (https://docs.aws.amazon.com/iot/latest/developerguide/fleet-provision-api.html).
ministack: has CreateKeysAndCertificate only, with keys made in the cloud.
Test: tests/local/test_identity.py::test_a_claim_becomes_a_robot_that_drives
Patch: local/patches/certificate_from_csr.patch
"""

from __future__ import annotations

import json
import secrets
import time
from collections.abc import Callable
from functools import wraps
from typing import Any

from ministack.services import iot

_OPERATION = "create-from-csr"
_TOPIC = "$aws/certificates/create-from-csr/json"


def install() -> None:
    """Close the gap in this process."""
    iot._parse_fleet_provisioning_topic = _with_csr(iot._parse_fleet_provisioning_topic)
    iot._fleet_provisioning_reply = _certifying(iot._fleet_provisioning_reply)


def is_open() -> bool:
    """Ask whether the topic is known."""
    return iot._parse_fleet_provisioning_topic(_TOPIC) is None


def _with_csr(parse: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(parse)
    def parse_topic(topic: str) -> tuple[str, str | None] | None:
        return (_OPERATION, None) if topic == _TOPIC else parse(topic)

    return parse_topic


def _certifying(reply: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(reply)
    async def answer(account: str, region: str, operation: str, *rest: Any) -> Any:
        if operation != _OPERATION:
            return await reply(account, region, operation, *rest)
        request = _json_object(rest[1]).get("certificateSigningRequest")
        try:
            pem = iot.sign_certificate_request(*iot._ensure_ca(), request or "")
        except ValueError:
            return iot._fleet_rejected("InvalidCsr", "CSR violates constraints")
        number, token = iot.get_certificate_id(pem), secrets.token_urlsafe(48)
        with iot.request_scope(account, region):
            iot._certificates[number] = iot._certificate_record(number, pem, "PENDING_ACTIVATION")
            expires = time.time() + iot._OWNERSHIP_TOKEN_SECONDS
            iot._ownership_tokens[token] = {"certificateId": number, "expiration": expires}
        return "accepted", {
            "certificateId": number,
            "certificatePem": pem,
            "certificateOwnershipToken": token,
        }

    return answer


def _json_object(payload: bytes) -> dict[str, Any]:
    try:
        value = json.loads(payload)
    except (RecursionError, ValueError):
        value = None
    return value if isinstance(value, dict) else {}
