"""Servers for video by WebRTC across the internet: STUN and TURN of Amazon Kinesis Video Streams, by a
viewer's rights. They belong to a signalling channel, over which nothing is signalled."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any
from urllib.parse import urlsplit

from botocore.credentials import ReadOnlyCredentials
from botocore.exceptions import BotoCoreError, ClientError

from iort_contract.cloud import VIEWER
from iort_contract.messages.video import IceServer
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.fleet.roles import Role

# Credentials are good for 300 s ("IceServer": Ttl). A viewer and a robot begin to use them within seconds,
# and get none that end sooner than this.
_LEAST_S = 60.0
# The end of these servers' names, before the region and AWS' domain of the partition.
_SERVICE = "kinesisvideo."
# Makes a client of the service with a viewer's credentials, in the region, at the address if there is one.
Clients = Callable[[str, ReadOnlyCredentials, "str | None", "str | None"], Any]


def _client(service: str, credentials: ReadOnlyCredentials, region: str | None, url: str | None) -> Any:
    # Its import takes longer than `iort --help` may.
    import boto3  # noqa: PLC0415 - see above
    from botocore.config import Config  # noqa: PLC0415 - see above

    session = boto3.Session(
        aws_access_key_id=credentials.access_key,
        aws_secret_access_key=credentials.secret_key,
        aws_session_token=credentials.token,
        region_name=region,
    )
    config = Config(retries={"mode": "standard", "max_attempts": 2}, connect_timeout=3, read_timeout=5)
    return session.client(service, endpoint_url=url, config=config)  # type: ignore[call-overload]  # any name


class Relays:
    """The servers of a deployment. Asked once for all viewers, until the credentials nearly end; may be used
    from several threads."""

    def __init__(
        self, cloud: Cloud, *, clients: Clients = _client, clock: Callable[[], float] = time.time
    ) -> None:
        self._cloud, self._clients, self._clock = cloud, clients, clock
        self._role = Role(cloud, VIEWER)
        self._lock = threading.Lock()
        self._until_s = float("-inf")
        self._servers: list[IceServer] = []

    def servers(self) -> list[IceServer]:
        """The servers, with credentials that are good for a minute or more; none if the deployment has no
        channel (`turn`). Raises `StationError` if AWS gives none."""
        channel = self._cloud.find_output("fleet", "TurnChannel")
        if channel is None:
            return []
        with self._lock:
            if self._clock() >= self._until_s:
                began_s = self._clock()
                try:
                    self._servers, lasts_s = self._ask(channel)
                except (BotoCoreError, ClientError) as error:
                    raise StationError(f"no relay for video: {error}") from error
                except LookupError as error:
                    raise StationError(f"no relay for video: AWS' answer has no {error}") from error
                self._until_s = began_s + lasts_s - _LEAST_S
            return self._servers

    def _ask(self, channel: str) -> tuple[list[IceServer], float]:
        """The servers, and how long their credentials are good."""
        credentials, region = self._role.credentials(), self._cloud.region_name
        endpoints = self._clients("kinesisvideo", credentials, region, None).get_signaling_channel_endpoint(
            ChannelARN=channel,
            SingleMasterChannelEndpointConfiguration={"Protocols": ["HTTPS"], "Role": "VIEWER"},
        )["ResourceEndpointList"]
        address = {one["Protocol"]: one["ResourceEndpoint"] for one in endpoints}["HTTPS"]
        told = self._clients("kinesis-video-signaling", credentials, region, address).get_ice_server_config(
            ChannelARN=channel
        )["IceServerList"]
        turn = [IceServer(tuple(one["Uris"]), one["Username"], one["Password"]) for one in told]
        domain = _SERVICE + (urlsplit(address).hostname or "").partition(_SERVICE)[2]
        stun = IceServer((f"stun:stun.{domain}:443",))
        return [stun, *turn], min((one["Ttl"] for one in told), default=0)
