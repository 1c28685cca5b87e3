"""A receiver's check of iort's webhook: the message is ours, unchanged, and not repeated later."""

from __future__ import annotations

import hashlib
import hmac
import time
from collections.abc import Mapping

TOLERANCE_S = 300


def verified(secret: str, headers: Mapping[str, str], body: bytes, now_s: float | None = None) -> bool:
    """``body`` is the request's bytes as received, before any parsing."""
    sent, signature = headers.get("Iort-Timestamp", ""), headers.get("Iort-Signature", "")
    digest = hmac.new(secret.encode(), sent.encode() + b"." + body, hashlib.sha256).hexdigest()
    if not hmac.compare_digest(signature.encode(), f"v1={digest}".encode()):
        return False
    return abs((time.time() if now_s is None else now_s) - int(sent)) <= TOLERANCE_S
