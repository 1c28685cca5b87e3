"""The adapter to PubNub's SDK: one client and one kept connection for the life of the environment."""

from __future__ import annotations

import json
import logging
from typing import Any
from urllib.parse import quote

import boto3
from pubnub.pnconfiguration import PNConfiguration
from pubnub.pubnub import PubNub

from iort_contract import MAX_PUBNUB_BYTES

# PubNub's keys are in the path of every request, which these log.
for _logger in ("httpx", "httpcore", "pubnub"):
    logging.getLogger(_logger).setLevel(logging.WARNING)
# A live sample is stale after 2 s; waiting longer than this for PubNub only makes the next one late.
_TIMEOUT_S = 1


class PublishError(Exception):
    """PubNub did not take the message, or could not be asked to; the text says why, without keys."""


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
        """Read the keys from Parameter Store; see `iort_contract.pubnub_parameter` for their form."""
        answer = boto3.client("ssm").get_parameter(Name=name, WithDecryption=True)
        keys: dict[str, Any] = json.loads(answer["Parameter"]["Value"])
        return cls(
            publish_key=keys["publish_key"],
            subscribe_key=keys["subscribe_key"],
            origin=keys.get("origin", ""),
            tls=keys.get("tls", True),
        )

    def publish(self, channel: str, message: dict[str, Any]) -> None:
        """Publish without storing; raises `PublishError` where PubNub does not confirm it."""
        size = len(quote(json.dumps(message, separators=(",", ":"))))
        if size > MAX_PUBNUB_BYTES:
            raise PublishError(f"{size} bytes after URL encoding; PubNub takes {MAX_PUBNUB_BYTES}")
        request = self._client.publish().channel(channel).message(message)
        try:
            request.should_store(should_store=False).use_post(use_post=True).sync()
        except Exception as error:
            # The SDK lets through what its parts raise, on an answer that is not JSON for one.
            status = getattr(error, "_status_code", 0)
            raise PublishError(f"{type(error).__name__}, status {status}") from error
