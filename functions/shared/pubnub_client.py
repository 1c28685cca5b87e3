"""The adapter to PubNub's SDK: one client and one persistent connection per environment."""

from __future__ import annotations

import json
import logging
from typing import Any
from urllib.parse import quote

import boto3
from pubnub.pnconfiguration import PNConfiguration
from pubnub.pubnub import PubNub

from iort_contract.limits import MAX_PUBNUB_BYTES

# These loggers log request paths, which contain PubNub's keys.
for _logger in ("httpx", "httpcore", "pubnub"):
    logging.getLogger(_logger).setLevel(logging.WARNING)
# A live sample is stale after 2 s; a longer wait for PubNub only delays the next one.
_TIMEOUT_S = 1


class PublishError(Exception):
    """PubNub did not take the message, or the request failed; the text says why, without keys."""


class PubNubPublisher:
    """Publishes JSON messages; create it once, outside the handler."""

    def __init__(self, *, publish_key: str, subscribe_key: str, origin: str = "", tls: bool = True) -> None:
        config = PNConfiguration()
        config.publish_key, config.subscribe_key = publish_key, subscribe_key
        config.user_id = "iort-live"
        if origin:
            config.origin = origin
        config.ssl = tls
        config.connect_timeout = config.non_subscribe_request_timeout = _TIMEOUT_S
        config.enable_subscribe = False
        config.daemon = True
        config.disable_config_locking = False
        self._client = PubNub(config)

    @classmethod
    def from_parameter(cls, name: str) -> PubNubPublisher:
        """Read the keys from Parameter Store; see `pubnub_parameter` for their form."""
        answer = boto3.client("ssm").get_parameter(Name=name, WithDecryption=True)
        keys: dict[str, Any] = json.loads(answer["Parameter"]["Value"])
        return cls(
            publish_key=keys["publish_key"],
            subscribe_key=keys["subscribe_key"],
            origin=keys.get("origin", ""),
            tls=keys.get("tls", True),
        )

    def publish(self, channel: str, message: dict[str, Any]) -> None:
        """Publish without storing; raises `PublishError` if PubNub does not confirm it."""
        size = len(quote(json.dumps(message, separators=(",", ":"))))
        if size > MAX_PUBNUB_BYTES:
            raise PublishError(
                f"message must be at most {MAX_PUBNUB_BYTES} bytes after URL encoding, got {size}"
            )
        request = self._client.publish().channel(channel).message(message)
        try:
            request.should_store(should_store=False).use_post(use_post=True).sync()
        except Exception as error:
            # The SDK does not wrap the errors of its libraries, for example on an answer that is not JSON.
            status = getattr(error, "_status_code", 0)
            raise PublishError(f"{type(error).__name__}, status {status}") from error
