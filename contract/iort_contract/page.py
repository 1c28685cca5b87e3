"""The headers that the live page is served with, by the station and by CloudFront alike."""

from __future__ import annotations

PUBNUB_ORIGIN = "ps.pndsn.com"
# An action's request has the server's key in it.
KEY_HEADER = "X-Iort-Key"
# Sent with every file, beside the policy.
HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
}


def security_policy(*, origin: str, tls: bool) -> str:
    """The page's Content-Security-Policy: its own files, PubNub at ``origin``, and nothing else."""
    pubnub = f"{'https' if tls else 'http'}://{origin}"
    return "; ".join(
        (
            "default-src 'none'",
            "script-src 'self'",
            "worker-src 'self'",
            "style-src 'self'",
            "img-src 'self'",
            f"connect-src 'self' {pubnub}",
            "base-uri 'none'",
            "form-action 'none'",
            "frame-ancestors 'none'",
        )
    )
