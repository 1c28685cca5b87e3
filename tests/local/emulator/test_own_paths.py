"""What a user of this machine gets from the gateway without a signature."""

from __future__ import annotations

import ssl
import urllib.error
import urllib.request

import pytest

from testkit.waiting import GUARD_S


@pytest.mark.parametrize(
    "asked",
    [
        "POST /_ministack/reset",
        "POST /_ministack/config",
        "GET /_ministack/sqs/messages",
        "GET /_ministack/lambda-code/live",
        "GET /_localstack/health",
    ],
)
def test_nobody_erases_or_reads_a_cloud_without_a_signature(embedded, asked):
    method, path = asked.split()
    request = urllib.request.Request(f"{embedded.cloud.endpoint_url}{path}", method=method)
    context = ssl.create_default_context(cafile=embedded.cloud.ca_bundle)
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(request, context=context, timeout=GUARD_S)
