"""The connection that a configuration names. Importing this loads the network's library."""

from __future__ import annotations

from iort_agent.clock import Clock
from iort_agent.config import Config
from iort_agent.mqtt.aws import IotCore
from iort_agent.mqtt.dispatch import Dispatcher


def make_uplink(config: Config, clock: Clock) -> IotCore:
    """The uplink of a robot's configuration."""
    return IotCore(
        endpoint=config.endpoint,
        port=config.port,
        client_id=config.robot,
        certificate=config.certificate,
        private_key=config.private_key,
        root_ca=config.root_ca,
        clock=clock,
        dispatcher=Dispatcher(),
    )
