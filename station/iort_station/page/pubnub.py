"""Listens to the fleet's PubNub channels, as the page does."""

from __future__ import annotations

import logging
import threading
from typing import Any

from pubnub.callbacks import SubscribeCallback
from pubnub.enums import PNReconnectionPolicy, PNStatusCategory
from pubnub.pnconfiguration import PNConfiguration
from pubnub.pubnub import PubNub
from pubnub.request_handlers.httpx import HttpxRequestHandler
from typing_extensions import Self

from iort_contract.cloud import channel
from iort_contract.limits import DEFAULT_NAMESPACE
from iort_contract.topics import check_namespace
from iort_station.errors import StationError
from iort_station.page.live import Listening, OnUpdate

_log = logging.getLogger(__name__)
_CONNECT_S = 15.0


class Listener(Listening, SubscribeCallback):  # type: ignore[misc]  # the SDK's base class has no types
    """Subscribes at PubNub.

    ``robot=None`` listens to the whole fleet; ``token`` is PubNub's access token, if Access Manager is on.
    The delay compares the car's clock with this machine's, so it is only as good as they agree. Raises
    `StationError` if PubNub does not answer.
    """

    def __init__(
        self,
        *,
        subscribe_key: str,
        robot: str | None,
        namespace: str = DEFAULT_NAMESPACE,
        origin: str = "",
        tls: bool = True,
        on_update: OnUpdate | None = None,
        token: str = "",
    ) -> None:
        super().__init__(on_update)
        config = PNConfiguration()
        config.subscribe_key, config.user_id = subscribe_key, "iort-station"
        if origin:
            config.origin = origin
        config.ssl, config.daemon = tls, True
        config.disable_config_locking = False
        config.reconnect_policy = PNReconnectionPolicy.EXPONENTIAL
        self._channel = f"{check_namespace(namespace)}.*" if robot is None else channel(robot, namespace)
        self._connected = threading.Event()
        self._client = PubNub(config, custom_request_handler=_Requests)
        if token:
            self._client.set_token(token)
        self._client.add_listener(self)

    def __enter__(self) -> Self:
        self._client.subscribe().channels(self._channel).execute()
        if not self._connected.wait(_CONNECT_S):
            self._client.stop()
            raise StationError(f"PubNub did not accept the subscription within {_CONNECT_S:.0f} s")
        return self

    def __exit__(self, *_error: object) -> None:
        self._client.stop()

    def status(self, _pubnub: Any, status: Any) -> None:
        """Called by the SDK."""
        if status.category == PNStatusCategory.PNConnectedCategory:
            self._connected.set()

    def message(self, _pubnub: Any, message: Any) -> None:
        """Called by the SDK, whose thread must go on, whatever the update's taker does."""
        try:
            self.take(message.message, int(message.timetoken) // 10)
        except Exception:  # noqa: BLE001 - a thread that ends in silence is worse
            _log.exception("a live message could not be taken")


class _Requests(HttpxRequestHandler):  # type: ignore[misc]  # the SDK's class has no types
    """The SDK's requests. The poll that begins while the client stops would make a session of its own, which
    nobody closes."""

    _ended = False

    def close(self) -> None:
        """End all sessions, also those to come."""
        self._ended = True
        super().close()

    def _ensure_session(self) -> Any:
        session = super()._ensure_session()
        if self._ended:
            session.close()
        return session
