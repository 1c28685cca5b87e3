"""The adapter to PubNub's SDK: one client and one persistent connection per environment."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable
from typing import Any
from urllib.parse import quote

import urllib3
from botocore.exceptions import BotoCoreError, ClientError
from pubnub.enums import PNStatusCategory
from pubnub.exceptions import PubNubException
from pubnub.pnconfiguration import PNConfiguration
from pubnub.pubnub import PubNub
from pubnub.request_handlers.base import BaseRequestHandler
from pubnub.structures import Envelope, PlatformOptions, RequestOptions

from functions.shared.clients import connect
from iort_contract.limits import MAX_PUBNUB_BYTES

_log = logging.getLogger(__name__)

# These loggers log request paths, which contain PubNub's keys.
for _logger in ("httpx", "httpcore", "urllib3", "pubnub"):
    logging.getLogger(_logger).setLevel(logging.WARNING)
# A live sample is stale after 2 s; a longer wait for PubNub only delays the next one.
_TIMEOUT_S = 1
# Lambda freezes an idle environment, which does not see that PubNub or a router ends its connection.
_IDLE_S = 5


# Keys that come later are seen within this time. Every message would be a call to Parameter Store otherwise.
_LOOK_AGAIN_S = 10.0


class PublishError(Exception):
    """PubNub did not take the message, or the request failed; the text says why, without keys."""


class NotConfiguredError(PublishError):
    """PubNub's keys are not stored, so there is nowhere to publish."""


class _Requests(BaseRequestHandler):  # type: ignore[misc]  # the SDK has no types
    """The SDK's requests over urllib3, which takes a quarter of httpx' processor time; publishing only."""

    def __init__(self, pubnub: PubNub) -> None:
        self._origin = f"{pubnub.config.scheme()}://{pubnub.config.origin}"
        self._pool = self._connections()
        self._used_s = 0.0

    def _connections(self) -> urllib3.HTTPConnectionPool:
        # A failed publish is not repeated: the next sample is newer.
        return urllib3.connection_from_url(
            self._origin, timeout=urllib3.Timeout(connect=_TIMEOUT_S, read=_TIMEOUT_S), retries=False
        )

    def sync_request(
        self, platform_options: PlatformOptions, endpoint_call_options: RequestOptions
    ) -> Envelope:
        """Send a request and return the answer, or raise PubNub's exception."""
        asked = endpoint_call_options
        # The monotonic clock may stand still in a frozen environment.
        if not 0 <= time.time() - self._used_s < _IDLE_S:
            self.close()
            self._pool = self._connections()
        try:
            answer = self._pool.request(
                asked.method_string,
                f"{asked.path}?{asked.query_string}",
                body=asked.data,
                headers={**platform_options.headers, **(asked.request_headers or {})},
            )
            found = json.loads(answer.data) if answer.status == 200 else None
        except (urllib3.exceptions.HTTPError, ValueError) as error:
            raise PubNubException(errormsg=type(error).__name__) from error
        if found is None:
            raise PubNubException(errormsg="refused", status_code=answer.status)
        self._used_s = time.time()
        status = asked.create_status(PNStatusCategory.PNAcknowledgmentCategory, found, None, None)
        return Envelope(asked.create_response(found), status)

    def close(self) -> None:
        """Close the connections."""
        self._pool.close()


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
        self._client = PubNub(config, custom_request_handler=_Requests)

    @classmethod
    def from_parameter(cls, name: str) -> PubNubPublisher:
        """Read the keys from Parameter Store; see `pubnub_parameter` for their form.

        Raises `NotConfiguredError` if there are none, and `PublishError` if they cannot be read.
        """
        ssm = connect("ssm")
        try:
            answer = ssm.get_parameter(Name=name, WithDecryption=True)
        except ssm.exceptions.ParameterNotFound as error:
            raise NotConfiguredError(f"no PubNub keys in {name}: `iort pubnub` stores them") from error
        except (BotoCoreError, ClientError) as error:
            raise PublishError(f"PubNub's keys cannot be read from {name}: {error}") from error
        try:
            keys: dict[str, Any] = json.loads(answer["Parameter"]["Value"])
            return cls(
                publish_key=keys["publish_key"],
                subscribe_key=keys["subscribe_key"],
                origin=keys.get("origin", ""),
                tls=keys.get("tls", True),
            )
        except (KeyError, TypeError, ValueError):
            # The error's own text may have a part of the value.
            raise NotConfiguredError(
                f"{name} does not hold PubNub's keys: `iort pubnub` stores them"
            ) from None

    def publish(self, channel: str, message: dict[str, Any]) -> None:
        """Publish without storing; raises `PublishError` if PubNub does not confirm it."""
        text = json.dumps(message, separators=(",", ":"))
        # A character takes at most three in an URL, and most messages are far below the limit.
        size = 3 * len(text) if 3 * len(text) <= MAX_PUBNUB_BYTES else len(quote(text))
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


class StoredPublisher:
    """Publishes with the keys in Parameter Store's ``parameter``, which it reads at the first message.
    Without keys it looks again after `_LOOK_AGAIN_S`."""

    def __init__(self, parameter: str, clock: Callable[[], float] = time.time) -> None:
        self._parameter, self._clock = parameter, clock
        self._publisher: PubNubPublisher | None = None
        self._missing: PublishError | None = None
        self._looked_s = 0.0

    def publish(self, channel: str, message: dict[str, Any]) -> None:
        """Publish as `PubNubPublisher.publish`; raises `NotConfiguredError` while there are no keys."""
        if self._publisher is None:
            self._publisher = self._look()
        self._publisher.publish(channel, message)

    def _look(self) -> PubNubPublisher:
        now_s = self._clock()
        if self._missing is not None and 0 <= now_s - self._looked_s < _LOOK_AGAIN_S:
            raise self._missing
        self._looked_s = now_s
        try:
            return PubNubPublisher.from_parameter(self._parameter)
        except PublishError as error:
            # Once: a line for each message of each robot would cost more than it says.
            if self._missing is None:
                _log.warning("%s", error)
            self._missing = error
            raise
