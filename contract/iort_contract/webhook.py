"""The webhook of incidents: where its messages go, and how a receiver knows that one is ours and new.

    POST https://lab.example.org/iort
    Iort-Timestamp: 1700000000      when this attempt was sent, in seconds since the epoch
    Iort-Signature: v1=<hex>        HMAC-SHA256 with the secret, over "<timestamp>.<body>"
    Iort-Delivery: <id>             the same in every attempt

The body is JSON: the namespace, the robot, the time of the sample, and the incident's fields.
"""

from __future__ import annotations

import hashlib
import hmac
import json
from dataclasses import dataclass, field
from typing import Mapping
from urllib.parse import urlsplit

from iort_contract.limits import DEFAULT_NAMESPACE, ContractError
from iort_contract.topics import check_namespace

TIMESTAMP, SIGNATURE, DELIVERY = "Iort-Timestamp", "Iort-Signature", "Iort-Delivery"
# In an event for the function incident: send one test message, and answer with its status.
TEST = "test"
_MAX_URL = 1000
_LOOPBACK = ("127.0.0.1", "localhost")


@dataclass(frozen=True)
class Webhook:
    """Where messages go, and the secret that signs them."""

    url: str
    secret: str = field(repr=False)

    def text(self) -> str:
        """What Parameter Store keeps."""
        return json.dumps(vars(self))


def webhook_parameter(namespace: str = DEFAULT_NAMESPACE) -> str:
    """The Parameter Store name (SecureString) of the webhook."""
    return f"/{check_namespace(namespace)}/webhook"


def stored_webhook(text: str, *, plain: bool = False) -> Webhook:
    """The webhook that Parameter Store keeps; raises `ContractError`, without any part of the secret."""
    try:
        content = json.loads(text)
        found = Webhook(content["url"], content["secret"])
    except (KeyError, TypeError, ValueError):
        raise ContractError("the parameter does not hold a webhook: `iort webhook set`") from None
    if not isinstance(found.secret, str) or not found.secret:
        raise ContractError("the parameter has no secret: `iort webhook set`")
    check_url(found.url, plain=plain)
    return found


def check_url(url: object, *, plain: bool = False) -> str:
    """Return the address if messages may go there: by https, or, where ``plain``, by http on this machine."""
    if not isinstance(url, str) or not url.isascii() or not url.isprintable() or " " in url:
        raise ContractError("the webhook's address must be an ASCII text without spaces")
    try:
        parts = urlsplit(url)
        host, _ = parts.hostname, parts.port
    except ValueError as error:
        raise ContractError(f"the webhook's address cannot be read: {error}") from error
    if len(url) > _MAX_URL or not host:
        raise ContractError(f"the webhook's address must be https://host/..., at most {_MAX_URL} characters")
    if parts.username is not None or parts.fragment:
        raise ContractError("the webhook's address must have neither a user nor a fragment")
    if parts.scheme != "https" and not (plain and parts.scheme == "http" and host in _LOOPBACK):
        raise ContractError(f"the webhook's address must begin with https://, got {parts.scheme}://")
    return url


def headers(secret: str, body: bytes, now_s: int, delivery: str) -> Mapping[str, str]:
    """The headers of one attempt."""
    return {
        "Content-Type": "application/json",
        "User-Agent": "iort",
        TIMESTAMP: str(now_s),
        SIGNATURE: f"v1={signature(secret, body, now_s)}",
        DELIVERY: delivery,
    }


def signature(secret: str, body: bytes, now_s: int) -> str:
    """The signature of a body that is sent at that time."""
    return hmac.new(secret.encode(), f"{now_s}.".encode() + body, hashlib.sha256).hexdigest()
