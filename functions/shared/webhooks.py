"""Sends signed messages to the webhook that the operator has stored: `iort_contract.webhook`."""

from __future__ import annotations

import http.client
import logging
import socket
import ssl
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from concurrent.futures import TimeoutError as LateError
from contextlib import suppress
from urllib.parse import urlsplit

from botocore.exceptions import BotoCoreError, ClientError

from functions.shared import clients
from functions.shared.clients import connect
from iort_contract.limits import ContractError
from iort_contract.webhook import Webhook, headers, stored_webhook

_log = logging.getLogger(__name__)
# Of a whole try: name, connection, and the answer's head, however slowly its bytes come.
TIMEOUT_S = 8.0
# Between the tries of one invocation; with these, and the timeout of each, it ends within a minute.
PAUSES_S = (1.0, 4.0)


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
        timeout_s: float = TIMEOUT_S,
        clock: Callable[[], float] = time.time,
        pause: Callable[[float], object] = time.sleep,
    ) -> None:
        self._parameter, self._plain, self._timeout_s = parameter, plain, timeout_s
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
                parts.netloc, timeout=self._timeout_s, context=context
            )
        else:
            connection = http.client.HTTPConnection(parts.netloc, timeout=self._timeout_s)
        made = headers(webhook.secret, body, int(self._clock()), delivery)
        try:
            status = _posted(connection, target, body, made, self._timeout_s)
        except LateError:
            raise WebhookError(f"{place} did not answer within {self._timeout_s:g} s") from None
        except (OSError, http.client.HTTPException) as error:
            raise WebhookError(f"{place} did not answer: {type(error).__name__}") from error
        # A redirect is no answer either: the message is for this address alone.
        if not 200 <= status < 300:
            raise WebhookError(f"{place} answered {status}")
        return status

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


def _posted(
    connection: http.client.HTTPConnection, target: str, body: bytes, made: Mapping[str, str], seconds: float
) -> int:
    """The status of a request's answer; raises `LateError` after so many seconds.

    A socket's timeout is that of each read alone, and looking up a name has none: so it is another thread
    that waits for them.
    """
    status: Future[int] = Future()
    late = threading.Event()

    def post() -> None:
        try:
            connection.connect()
            if not late.is_set():  # it was told that nothing came
                connection.request("POST", target, body, dict(made))
                status.set_result(connection.getresponse().status)
        except Exception as error:  # noqa: BLE001 - raised where the status is awaited
            status.set_exception(error)
        finally:
            connection.close()

    threading.Thread(target=post, name="webhook", daemon=True).start()
    try:
        return status.result(seconds)
    finally:
        late.set()
        # Ends a thread that still waits.
        if (waiting := connection.sock) is not None:
            with suppress(OSError):
                waiting.shutdown(socket.SHUT_RDWR)
