"""Listens to the fleet's live messages: at PubNub, or at AWS IoT's broker."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Any

from typing_extensions import Self

from iort_contract.catalog.vesc import absent
from iort_contract.cloud import PUBNUB
from iort_contract.limits import ContractError
from iort_contract.messages.live import decode_live, live_update
from iort_contract.tables import ROBOT
from iort_contract.topics import LIVE, check_robot, parse_topic
from iort_station.cloud import Cloud
from iort_station.fleet.broker import Broker
from iort_station.fleet.roles import Role
from iort_station.page.live import Listening, OnUpdate
from iort_station.page.page import load_keys


def listening(
    cloud: Cloud,
    live: str,
    *,
    robot: str | None = None,
    on_update: OnUpdate | None = None,
    token: str = "",
) -> AbstractContextManager[Listening]:
    """Listen to a robot, or to the whole fleet, by the way ``live``.

    Raises `StationError` if that way cannot be used.
    """
    if live != PUBNUB:
        return BrokerListener(cloud, robot=robot, on_update=on_update)
    # Without PubNub nobody needs its SDK.
    from iort_station.page.pubnub import Listener  # noqa: PLC0415 - as above

    return Listener(
        robot=robot,
        namespace=cloud.namespace,
        on_update=on_update,
        token=token,
        **load_keys(cloud).reading(),
    )


class BrokerListener(Listening):
    """Subscribes as a viewer.

    An update has the form of Lambda 1's without its times, and with all fields. A malformed message becomes
    an update that `decode_live_update` refuses, and that has its robot and the ``error``.
    """

    def __init__(self, cloud: Cloud, *, robot: str | None = None, on_update: OnUpdate | None = None) -> None:
        name = "+" if robot is None else check_robot(robot)
        super().__init__(on_update)
        self._broker = Broker(
            cloud, Role(cloud), filters=[f"{LIVE}/{cloud.namespace}/{name}/+"], on_message=self._take
        )

    def __enter__(self) -> Self:
        self._broker.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self._broker.__exit__(*error)

    def _take(self, topic: str, message: bytes) -> None:
        self.take(update_of(topic, message), 0)


def update_of(topic: str, message: bytes) -> dict[str, Any]:
    """The update of a car's own live message; of one that is malformed, what is known of it."""
    robot = {}
    try:
        named = parse_topic(topic)
        robot = {ROBOT: named.robot}
        live = decode_live(message)
    except ContractError as error:
        return {**robot, "error": str(error)}
    # As Lambda 1 does: a sensor that is not there has no value.
    sample = {name: None if absent(name, value) else value for name, value in live.sample.items()}
    return live_update(named.robot, named.name, replace(live, sample=sample))
