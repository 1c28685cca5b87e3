"""The webhook of incidents: where its messages go, and the secret that signs them, in Parameter Store."""

from __future__ import annotations

import json
import secrets

from iort_contract.limits import ContractError
from iort_contract.webhook import TEST, Webhook, check_url, stored_webhook, webhook_parameter
from iort_station.cloud import Cloud, invoke
from iort_station.errors import StationError, UsageError


def store(cloud: Cloud, url: str) -> Webhook:
    """Store an address in place of the one before, with a new secret. Raises `UsageError` for one that the
    cloud does not take."""
    try:
        webhook = Webhook(check_url(url, plain=cloud.endpoint_url is not None), secrets.token_urlsafe(32))
    except ContractError as error:
        raise UsageError(str(error)) from error
    cloud.client("ssm").put_parameter(
        Name=webhook_parameter(cloud.namespace), Value=webhook.text(), Type="SecureString", Overwrite=True
    )
    return webhook


def stored(cloud: Cloud) -> Webhook | None:
    """The webhook; None if there is none. Raises `StationError` for a parameter that is none."""
    ssm = cloud.client("ssm")
    try:
        answer = ssm.get_parameter(Name=webhook_parameter(cloud.namespace), WithDecryption=True)
    except ssm.exceptions.ParameterNotFound:
        return None
    try:
        return stored_webhook(answer["Parameter"]["Value"], plain=cloud.endpoint_url is not None)
    except ContractError as error:
        raise StationError(str(error)) from error


def remove(cloud: Cloud) -> bool:
    """Remove the webhook; return whether there was one."""
    ssm = cloud.client("ssm")
    try:
        ssm.delete_parameter(Name=webhook_parameter(cloud.namespace))
    except ssm.exceptions.ParameterNotFound:
        return False
    return True


def send_test(cloud: Cloud) -> int:
    """Have the cloud send a signed test message; return the receiver's status. Raises `StationError` if it
    does not take the message."""
    event = json.dumps({TEST: True}).encode()
    answer = invoke(cloud, "processing", "IncidentFunction", event, "the webhook's test")
    return int(json.loads(answer)["status"])
