"""A DynamoDB client whose `query` and `batch_write_item` go straight to the service.

botocore spends a millisecond and a half of a processor on a request: endpoint rules, hooks, headers, copies.
That was two thirds of what `summarize` took for a batch. Both requests may be repeated at will, so whatever
is no plain answer goes through botocore, which tries again, waits, and raises its errors:

    request --> kept connection --> 200 and the body is whole --> answer
                     |  closed by the service, an error, bytes in it
                     +--> a new connection, once --> botocore
"""

from __future__ import annotations

import hashlib
import hmac
import http.client
import json
import logging
import ssl
import time
import zlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from botocore.credentials import Credentials

from iort_contract.checks import COMPACT

if TYPE_CHECKING:
    from types_boto3_dynamodb import DynamoDBClient

_log = logging.getLogger(__name__)
_TIMEOUT_S = 10.0
_TYPE = "application/x-amz-json-1.0"
# What http.client raises beside OSError for a connection that ended.
_ENDED = (OSError, http.client.HTTPException)


class Direct:
    """All of ``client``, with two operations of its own. May be used from several threads.

    ``authorities`` is the file of the certificate authorities to trust; None for the system's.
    """

    def __init__(
        self, client: DynamoDBClient, credentials: Credentials, authorities: str | None = None
    ) -> None:
        self._client, self._credentials = client, credentials
        url = urlsplit(client.meta.endpoint_url)
        self._host, self._region = url.netloc, client.meta.region_name
        self._context = ssl.create_default_context(cafile=authorities) if url.scheme == "https" else None
        self._idle: list[http.client.HTTPConnection] = []
        self._key: tuple[tuple[str, str], bytes] = (("", ""), b"")

    def __getattr__(self, name: str) -> Any:
        return getattr(self._client, name)

    def query(self, **request: Any) -> Any:
        """Items of a partition, as botocore answers them."""
        answer = self._answer("Query", request)
        return self._client.query(**request) if answer is None else answer

    def batch_write_item(self, **request: Any) -> Any:
        """Writes and removals, as botocore answers them."""
        answer = self._answer("BatchWriteItem", request)
        return self._client.batch_write_item(**request) if answer is None else answer

    def _answer(self, operation: str, request: Mapping[str, Any]) -> dict[str, Any] | None:
        """The service's answer; None where botocore has to ask."""
        try:
            body = COMPACT.encode(request).encode()
        except (TypeError, ValueError):
            # Bytes, which are base64 on the way.
            return None
        headers = self._signed(f"DynamoDB_20120810.{operation}", body)
        while self._idle:
            connection = self._idle.pop()
            try:
                return self._sent(connection, headers, body)
            except _ENDED:
                # The service closes a connection that waits, and Lambda stops an environment between calls.
                connection.close()
        connection = self._connection()
        try:
            return self._sent(connection, headers, body)
        except _ENDED as error:
            connection.close()
            _log.info("%s goes through botocore: %s", operation, error)
            return None

    def _sent(
        self, connection: http.client.HTTPConnection, headers: Mapping[str, str], body: bytes
    ) -> dict[str, Any] | None:
        connection.request("POST", "/", body, headers)
        response = connection.getresponse()
        text = response.read()
        self._idle.append(connection)
        if response.status != http.client.OK or b'"B"' in text or b'"BS"' in text:
            return None
        if zlib.crc32(text) != int(response.headers.get("x-amz-crc32", zlib.crc32(text))):
            return None
        answer: dict[str, Any] = json.loads(text)
        return answer

    def _connection(self) -> http.client.HTTPConnection:
        if self._context is None:
            return http.client.HTTPConnection(self._host, timeout=_TIMEOUT_S)
        return http.client.HTTPSConnection(self._host, context=self._context, timeout=_TIMEOUT_S)

    def _signed(self, target: str, body: bytes) -> dict[str, str]:
        """The headers of a request, with AWS' Signature Version 4."""
        given = self._credentials.get_frozen_credentials()
        at = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
        headers = {"content-type": _TYPE, "host": self._host, "x-amz-date": at}
        if given.token:
            headers["x-amz-security-token"] = given.token
        headers["x-amz-target"] = target
        names = ";".join(headers)
        lines = "".join(f"{name}:{value}\n" for name, value in headers.items())
        canonical = f"POST\n/\n\n{lines}\n{names}\n{hashlib.sha256(body).hexdigest()}"
        scope = f"{at[:8]}/{self._region}/dynamodb/aws4_request"
        text = f"AWS4-HMAC-SHA256\n{at}\n{scope}\n{hashlib.sha256(canonical.encode()).hexdigest()}"
        key = self._signing_key(scope, str(given.secret_key))
        signature = hmac.digest(key, text.encode(), "sha256").hex()
        headers["authorization"] = (
            f"AWS4-HMAC-SHA256 Credential={given.access_key}/{scope}, SignedHeaders={names}, "
            f"Signature={signature}"
        )
        return headers

    def _signing_key(self, scope: str, secret: str) -> bytes:
        """The key of a day, made once."""
        day, key = self._key
        if day != (scope, secret):
            key = f"AWS4{secret}".encode()
            for part in scope.split("/"):
                key = hmac.digest(key, part.encode(), "sha256")
            self._key = (scope, secret), key
        return key
