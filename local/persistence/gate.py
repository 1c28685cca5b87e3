"""Nothing is acknowledged before it is committed.

Every answer of the gateway, every PUBACK and every message of the cloud itself waits until all that was
written before is in the ledger. Whoever waits at the same time shares a commit. If it fails, an API call is
answered by 503, and a robot's message by a PUBACK that says so: it keeps the batch, and stays connected, so
that it can still be stopped. MQTT 3.1.1 has no such PUBACK, and its connection is closed.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar
from functools import wraps
from typing import Any
from urllib.parse import parse_qs

from ministack import app
from ministack.core.iam_actions import access_denied_response
from ministack.core.router import detect_service
from ministack.services import iot

from local.persistence.ledger import Ledger, LedgerError

_log = logging.getLogger(__name__)
Message = dict[str, Any]
Send = Callable[[Message], Awaitable[None]]
# A reason of a PUBACK: MQTT 5, 3.4.2.1.
QUOTA_EXCEEDED = 0x97
# The record lane's action.
_PUT = "dynamoDBv2"
# Why the message that this task publishes was refused.
_refusal: ContextVar[list[LedgerError] | None] = ContextVar("refusal", default=None)


class RefusedError(ConnectionError):
    """A message is not taken. It ends the session, as AWS does when it cannot take a message."""


class Gate:
    """Lets answers out."""

    def __init__(self, ledger: Ledger) -> None:
        self._ledger = ledger
        self._committing: asyncio.Task[None] | None = None
        # Not the loop's own threads: functions may have them all, and wait for answers.
        self._disk = ThreadPoolExecutor(1, "gate")

    def install(self) -> None:
        """Stand before everything that leaves the emulator; the last to be installed."""
        app.app = self._answering(app.app)
        iot.broker_publish = self._acknowledging(iot.broker_publish)
        iot._dispatch_rule_action = self._refusing(iot._dispatch_rule_action)
        iot._WSSession.handle_packet = _telling(iot._WSSession.handle_packet)
        iot._fleet_provisioning_reply = self._replying(iot._fleet_provisioning_reply)

    async def passed(self, since: int) -> None:
        """Wait until all that was written is committed. Raises `LedgerError` if something written after
        `Ledger.undone` was ``since`` is undone."""
        if self._ledger.pending:
            if self._committing is None:
                self._committing = asyncio.create_task(self._commit())
            await asyncio.shield(self._committing)
        if since != self._ledger.undone:
            raise LedgerError("what was written is undone: try again")

    async def _commit(self) -> None:
        # It runs when all who are ready have written; whoever comes later needs the next one.
        self._committing = None
        if self._ledger.sync == "full":
            await asyncio.get_running_loop().run_in_executor(self._disk, self._ledger.commit)
        else:
            self._ledger.commit()

    def _answering(self, serve: Callable[..., Awaitable[None]]) -> Callable[..., Awaitable[None]]:
        @wraps(serve)
        async def answer(scope: Message, receive: Any, send: Send) -> None:
            if scope["type"] != "http":
                await serve(scope, receive, send)
                return
            since, refused = self._ledger.undone, False

            async def send_committed(message: Message) -> None:
                nonlocal refused
                if message["type"] == "http.response.start":
                    try:
                        await self.passed(since)
                    except LedgerError as error:
                        refused = True
                        await _refuse(scope, send, error)
                if not refused:
                    await send(message)

            await serve(scope, receive, send_committed)

        return answer

    def _acknowledging(self, publish: Callable[..., Awaitable[None]]) -> Callable[..., Awaitable[None]]:
        @wraps(publish)
        async def acknowledge(account: str, region: str, topic: str, payload: bytes, **rest: Any) -> None:
            since, refusals, outer = self._ledger.undone, list[LedgerError](), _refusal.get()
            token = _refusal.set(refusals)
            try:
                if rest.get("client_id") is None:
                    # The cloud says what it has done.
                    await self.passed(since)
                await publish(account, region, topic, payload, **rest)
                if rest.get("qos"):
                    await self.passed(since)
            except LedgerError as error:
                refusals.append(error)
            finally:
                _refusal.reset(token)
            if outer is not None:
                outer += refusals
            if refusals and rest.get("qos"):
                raise RefusedError(str(refusals[0]))

        return acknowledge

    def _refusing(self, dispatch: Callable[..., Awaitable[None]]) -> Callable[..., Awaitable[None]]:
        @wraps(dispatch)
        async def refuse(account: str, region: str, rule: str, action: Message, event: Any) -> None:
            refusals = _refusal.get()
            if refusals:
                # The message will come again, so that its error action has nothing to tell.
                return
            try:
                if _PUT in action:
                    self._ledger.check_room()
                await dispatch(account, region, rule, action, event)
            except LedgerError as error:
                if refusals is not None:
                    refusals.append(error)
                raise

        return refuse

    def _replying(self, reply: Callable[..., Awaitable[Any]]) -> Callable[..., Awaitable[Any]]:
        @wraps(reply)
        async def committed(*arguments: Any) -> Any:
            since = self._ledger.undone
            answer = await reply(*arguments)
            await self.passed(since)
            return answer

        return committed


def _telling(handle: Callable[..., Awaitable[bool]]) -> Callable[..., Awaitable[bool]]:
    """A session that tells its client which message is refused."""

    @wraps(handle)
    async def tell(session: Any, kind: int, flags: int, body: bytes) -> bool:
        try:
            return await handle(session, kind, flags, body)
        except RefusedError:
            if session.protocol_version != iot.MQTT_5 or kind != iot.PKT_PUBLISH:
                raise
            _, place = iot._read_string(body, 0)
            number = int.from_bytes(body[place : place + 2], "big")
            why = [(iot.PROP_REASON_STRING, "the cloud could not store it")]
            await session.send_bytes(iot._make_puback(number, QUOTA_EXCEEDED, why))
            return True

    return tell


async def _refuse(scope: Message, send: Send, error: LedgerError) -> None:
    """Answer 503 in the form that the clients of the called service read; so they try again by themselves."""
    _log.warning("a call is refused: %s", error)
    headers = {name.decode("latin-1").lower(): value.decode("latin-1") for name, value in scope["headers"]}
    query = parse_qs(scope.get("query_string", b"").decode("latin-1"))
    service = detect_service(scope["method"], scope["path"], headers, query)
    # Of the data plane of IoT it knows one answer, that something is forbidden. The form is that of IoT.
    _, told, body = access_denied_response(
        "iot" if service == "iot-data" else service,
        "",
        "",
        "",
        error_code="ServiceUnavailable",
        message=str(error),
        headers=headers,
    )
    fields = [(name.lower().encode(), value.encode()) for name, value in told.items()]
    fields.append((b"content-length", str(len(body)).encode()))
    await send({"type": "http.response.start", "status": 503, "headers": fields})
    await send({"type": "http.response.body", "body": body})
