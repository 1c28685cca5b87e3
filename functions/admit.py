"""Admit: decides which claims become robots. AWS IoT calls this pre-provisioning hook before it registers a
thing; it must answer within 5 s, cold start included.

The operator opens a name for one certificate and a limited time (`iort robots claim`, `register`). Every
other request is refused, and so is every request during a failure here. A certificate that was admitted but
never registered gives way to another (decision 39).
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Mapping
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from botocore.config import Config

from functions.shared.clients import connect, variables
from functions.shared.metrics import emit
from iort_contract.catalog.environments import RegistryEnvironment
from iort_contract.limits import ContractError
from iort_contract.tables import (
    ADMIT_CLAIM,
    ADMIT_FINGERPRINT,
    ADMIT_UNTIL_S,
    ADMITTED_CERTIFICATE,
    ADMITTED_MS,
    CONNECTED_MS,
    ROBOT,
    ROBOT_PARAMETER,
    SERIAL,
    SERIAL_PARAMETER,
)
from iort_contract.topics import check_robot

if TYPE_CHECKING:
    from types_boto3_dynamodb import DynamoDBClient

_log = logging.getLogger(__name__)

# Three calls, at their slowest, fit into the function's timeout, and that into AWS' 5 s. A robot asks again.
_CONFIG = Config(connect_timeout=0.6, read_timeout=0.6, retries={"total_max_attempts": 1})
_MAX_TEXT = 800
SPENT = "another certificate has its admission: `iort robots claim` opens it again"
# AWS IoT waits 5 s for this function and then registers. An older admission has succeeded or failed.
SETTLED_MS = 60_000
# "Lifecycle events": the broker's clocks, which time connections, may differ by this much.
_CLOCKS_APART_MS = 120_000


class Earlier(NamedTuple):
    """The certificate that holds the admission, and since when."""

    certificate: str
    admitted_ms: int


def admission(event: Mapping[str, Any], now_ms: int, instead_of: Earlier | None = None) -> dict[str, Any]:
    """Take the robot's open admission: UpdateItem's arguments without the table.

    ``instead_of`` names a certificate that never came through; the update replaces it if it still holds the
    admission.

    The update is one step, so only one of two claims for a name succeeds. The same certificate may ask again,
    because an answer may be lost or late. AWS does not document that a claim keeps the id it was created
    with, so the SHA-256 of its certificate is accepted too. Raises `ContractError` for an incomplete request.
    """
    parameters = event.get("parameters")
    if not isinstance(parameters, Mapping):
        raise ContractError("a request without parameters")
    robot, serial = check_robot(parameters.get(ROBOT_PARAMETER, "")), _text(parameters, SERIAL_PARAMETER)
    certificate, claim = _text(event, "certificateId"), _claim_id(event)
    its = f"attribute_not_exists({ADMIT_CLAIM}) OR {ADMIT_CLAIM} = :claim OR {ADMIT_FINGERPRINT} = :claim"
    unspent = f"attribute_not_exists({ADMITTED_CERTIFICATE})"
    earlier_values: dict[str, Any] = {}
    if instead_of is not None:
        unspent = f"{ADMITTED_CERTIFICATE} = :earlier AND {ADMITTED_MS} = :earlier_ms"
        earlier_values = {
            ":earlier": {"S": instead_of.certificate},
            ":earlier_ms": {"N": str(instead_of.admitted_ms)},
        }
    opened = f"{ADMIT_UNTIL_S} >= :now_s AND ({its}) AND {unspent}"
    machine = f"(attribute_not_exists({SERIAL}) OR {SERIAL} = :serial)"
    return {
        "Key": {ROBOT: {"S": robot}},
        "UpdateExpression": (
            f"SET {SERIAL} = :serial, {ADMITTED_CERTIFICATE} = :certificate, {ADMITTED_MS} = :now_ms"
        ),
        "ConditionExpression": (
            f"attribute_exists({ROBOT}) AND {machine}"
            f" AND ({ADMITTED_CERTIFICATE} = :certificate OR ({opened}))"
        ),
        "ExpressionAttributeValues": {
            ":serial": {"S": serial},
            ":certificate": {"S": certificate},
            ":claim": {"S": claim},
            ":now_s": {"N": str(now_ms // 1000)},
            ":now_ms": {"N": str(now_ms)},
            **earlier_values,
        },
        "ReturnValuesOnConditionCheckFailure": "ALL_OLD",
    }


def earlier(row: Mapping[str, Any]) -> Earlier | None:
    """The certificate that holds the admission of a row; None if no certificate does."""
    if ADMITTED_CERTIFICATE not in row or ADMITTED_MS not in row:
        return None
    return Earlier(row[ADMITTED_CERTIFICATE]["S"], int(row[ADMITTED_MS]["N"]))


def gives_way(row: Mapping[str, Any], status: str | None) -> bool:
    """Whether the certificate that holds the admission never came through, by its ``status`` at AWS IoT.

    A new certificate is PENDING_ACTIVATION until it is registered, and AWS IoT deletes it after an hour
    ("Device provisioning MQTT API"). A deleted one (None) may also have come through first, and then the
    operator deleted it: in that case the robot may have connected since.
    """
    if status is not None:
        return status == "PENDING_ACTIVATION"
    has = earlier(row)
    connected_ms = int(row.get(CONNECTED_MS, {}).get("N", "0"))
    return has is not None and connected_ms < has.admitted_ms - _CLOCKS_APART_MS


def reason(row: Mapping[str, Any], event: Mapping[str, Any], now_ms: int) -> str:
    """Why a row's robot was not admitted, for the log. The row is DynamoDB's, or empty.

    Returns `SPENT` if only another certificate blocks the admission.
    """
    if not row:
        return "it is not registered"
    if row.get(SERIAL, {}).get("S") not in (None, event["parameters"][SERIAL_PARAMETER]):
        return "another machine has the name"
    if ADMIT_UNTIL_S not in row:
        return "no certificate may be issued for it: `iort robots claim` opens it"
    if float(row[ADMIT_UNTIL_S]["N"]) < now_ms // 1000:
        return "the time in which a certificate could be issued for it is over"
    ids = sorted({row[name]["S"] for name in (ADMIT_CLAIM, ADMIT_FINGERPRINT) if name in row})
    if not ids or _claim_id(event) in ids:
        return SPENT
    return f"it is open for another claim: for {' or '.join(ids)}, asked with {event['claimCertificateId']}"


def _claim_id(event: Mapping[str, Any]) -> str:
    """The claim's id in the station's spelling: AWS allows capitals and 0x before the hex digits."""
    claim = _text(event, "claimCertificateId")
    return claim.lower().removeprefix("0x")


def _text(values: Mapping[str, Any], name: str) -> str:
    value = values.get(name)
    if not isinstance(value, str) or not 1 <= len(value) <= _MAX_TEXT:
        raise ContractError(f"{name} must be a text of up to {_MAX_TEXT} characters")
    return value


@cache
def _dynamodb() -> DynamoDBClient:
    return connect("dynamodb", config=_CONFIG)


def _status(certificate: str) -> str | None:
    """A certificate's status at AWS IoT; None if it was deleted."""
    # Its model is large and rarely needed.
    iot = connect("iot", config=_CONFIG)
    try:
        answer = iot.describe_certificate(certificateId=certificate)
    except iot.exceptions.ResourceNotFoundException:
        return None
    return str(answer["certificateDescription"]["status"])


def handler(event: dict[str, Any], _context: object) -> dict[str, bool]:
    """Entry point of the template's pre-provisioning hook."""
    try:
        allowed = _admit(event)
    except Exception:  # noqa: BLE001 - whatever went wrong, nobody was found to be expected
        _log.exception("refused, because the check failed")
        allowed = False
    emit("admit", RobotsAdmitted=allowed, RobotsRefused=not allowed)
    return {"allowProvisioning": allowed}


def _admit(event: Mapping[str, Any]) -> bool:
    now_ms = time.time_ns() // 1_000_000
    try:
        row = _take(admission(event, now_ms))
        if row is not None:
            why, has = reason(row, event, now_ms), earlier(row)
            if why == SPENT and has is not None and now_ms - has.admitted_ms >= SETTLED_MS:
                status = _status(has.certificate)
                if gives_way(row, status):
                    _log.warning("certificate %s was admitted but never registered", has.certificate)
                    row = _take(admission(event, now_ms, has))
    except ContractError as error:
        _log.warning("refused: %s", error)
        return False
    robot = event["parameters"][ROBOT_PARAMETER]
    if row is not None:
        _log.warning("%s refused: %s", robot, reason(row, event, now_ms))
        return False
    _log.info(
        "%s admitted: certificate %s, claim %s", robot, event["certificateId"], event["claimCertificateId"]
    )
    return True


def _take(update: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Do the update. If its condition fails, return the row that failed it (empty if none exists)."""
    dynamodb = _dynamodb()
    try:
        dynamodb.update_item(TableName=variables(RegistryEnvironment).robots_table, **update)
    except dynamodb.exceptions.ConditionalCheckFailedException as error:
        return cast("Mapping[str, Any]", error.response.get("Item", {}))
    return None


if "AWS_LAMBDA_INITIALIZATION_TYPE" in os.environ:
    # In Lambda, create the client before the first request needs it.
    _dynamodb()
