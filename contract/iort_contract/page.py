"""The live page: the headers that it is served with, by the station and by CloudFront alike, and a link into
it."""

from __future__ import annotations

from datetime import datetime, timezone
from urllib.parse import quote, urlencode

from iort_contract.messages.analysis import Finding

PUBNUB_ORIGIN = "ps.pndsn.com"
# An action's request has the server's key in it. A browser gets it once for the token in an address.
KEY_HEADER = "X-Iort-Key"
INVITATION = "key"
# Where `iort dashboard` serves it, unless told otherwise.
PAGE_URL = "http://localhost:8080/"
# A link shows at least this much around the evidence.
_AROUND_US = 5_000_000
# Sent with every file, beside the policy.
HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
}


def pubnub_address(origin: str = PUBNUB_ORIGIN, *, tls: bool = True) -> str:
    """The address of PubNub's servers."""
    return f"{'https' if tls else 'http'}://{origin}"


def security_policy(*addresses: str) -> str:
    """The page's Content-Security-Policy: its own files, connections to these addresses, and nothing else."""
    return "; ".join(
        (
            "default-src 'none'",
            "script-src 'self'",
            "worker-src 'self'",
            "style-src 'self'",
            "img-src 'self'",
            " ".join(("connect-src 'self'", *addresses)),
            "base-uri 'none'",
            "form-action 'none'",
            "frame-ancestors 'none'",
        )
    )


def history_link(page_url: str, finding: Finding) -> str:
    """The address of the page's history at the evidence of a finding; without ``page_url`` its part within
    the page."""
    if not finding.stream:
        return f"{page_url}#/car/{quote(finding.drive.robot)}"
    around_us = max(0, _AROUND_US - (finding.to_us - finding.from_us) // 2)
    query = {
        "stream": finding.stream,
        "from": _time(finding.from_us - around_us),
        "to": _time(finding.to_us + around_us),
    }
    if finding.fields:
        query["fields"] = ",".join(finding.fields)
    return f"{page_url}#/history/{quote(finding.drive.robot)}?{urlencode(query, safe=',:')}"


def _time(t_us: int) -> str:
    """A time as the page writes it."""
    when = datetime.fromtimestamp(t_us / 1e6, timezone.utc)
    return f"{when:%Y-%m-%dT%H:%M:%S}.{when.microsecond // 1000:03d}Z"
