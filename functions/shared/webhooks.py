"""Sends signed messages to the webhook that the operator has stored: `iort_contract.webhook`."""

from __future__ import annotations

import http.client
import logging
import ssl
import time
from collections.abc import Callable
from urllib.parse import urlsplit

from botocore.exceptions import BotoCoreError, ClientError

from functions.shared import clients
from functions.shared.clients import connect
from iort_contract.limits import ContractError
from iort_contract.webhook import Webhook, headers, stored_webhook

_log = logging.getLogger(__name__)
# Of a connection and of each read.
TIMEOUT_S = 8.0
# Between the tries of one invocation; with these, and the timeout of each, it ends within a minute.
PAUSES_S = (1.0, 4.0)
_SKIPPED_BYTES = 4096


class WebhookError(Exception):
    """There is no webhook, or the receiver did not take the message; the text has neither the address' query
    nor the secret."""


class StoredWebhook:
    """The webhook in Parameter Store's ``parameter``, which is read for each message: a new one, or none,
    holds at once."""

    def __init__(
        self,
        parameter: str,
        *,
        plain: bool = False,
        clock: Callable[[], float] = time.time,
        pause: Callable[[float], object] = time.sleep,
    ) -> None:
        self._parameter, self._plain = parameter, plain
        self._clock, self._pause = clock, pause
        self._webhook: Webhook | None = None

    def stored(self) -> bool:
        """Whether there is one. Raises `WebhookError` if that cannot be known."""
        self._webhook = self._read()
        return self._webhook is not None

    def deliver(self, body: bytes, delivery: str, tries: int = 1 + len(PAUSES_S)) -> int:
        """Send a message to the webhook that was `stored`; return the receiver's status, or raise
        `WebhookError` after the ``tries``."""
        webhook = self._webhook
        if webhook is None:
            raise WebhookError("no webhook is stored: `iort webhook set`")
        for pause_s in PAUSES_S[: tries - 1]:
            try:
                return self._send(webhook, body, delivery)
            except WebhookError as error:  # noqa: PERF203 - each try may fail
                _log.info("%s; once more in %g s", error, pause_s)
                self._pause(pause_s)
        return self._send(webhook, body, delivery)

    def _send(self, webhook: Webhook, body: bytes, delivery: str) -> int:
        parts = urlsplit(webhook.url)
        place = f"the webhook at {parts.hostname}"
        target = f"{parts.path or '/'}{'?' if parts.query else ''}{parts.query}"
        if parts.scheme == "https":
            context = ssl.create_default_context(cafile=clients.authorities())
            connection: http.client.HTTPConnection = http.client.HTTPSConnection(
                parts.netloc, timeout=TIMEOUT_S, context=context
            )
        else:
            connection = http.client.HTTPConnection(parts.netloc, timeout=TIMEOUT_S)
        try:
            made = headers(webhook.secret, body, int(self._clock()), delivery)
            connection.request("POST", target, body, dict(made))
            answer = connection.getresponse()
            answer.read(_SKIPPED_BYTES)
        except (OSError, http.client.HTTPException) as error:
            raise WebhookError(f"{place} did not answer: {type(error).__name__}") from error
        finally:
            connection.close()
        # A redirect is no answer either: the message is for this address alone.
        if not 200 <= answer.status < 300:
            raise WebhookError(f"{place} answered {answer.status}")
        return answer.status

    def _read(self) -> Webhook | None:
        ssm = connect("ssm")
        try:
            answer = ssm.get_parameter(Name=self._parameter, WithDecryption=True)
        except ssm.exceptions.ParameterNotFound:
            return None
        except (BotoCoreError, ClientError) as error:
            raise WebhookError(f"the webhook cannot be read: {error}") from error
        try:
            return stored_webhook(answer["Parameter"].get("Value", ""), plain=self._plain)
        except ContractError as error:
            raise WebhookError(str(error)) from None
