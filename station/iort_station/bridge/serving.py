"""The bridge put together: channels, what fills them, the wheel, and the door in front."""

from __future__ import annotations

import errno
import ssl
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from urllib.parse import quote, urlencode

from iort_station.bridge.channels import Channels, waiting
from iort_station.bridge.door import Admission, Door, Wheel, everybody
from iort_station.bridge.driving import ENCODINGS, PublishedWheel
from iort_station.bridge.live import Live, Streams
from iort_station.bridge.player import Player
from iort_station.bridge.stored import Source
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.fleet.seat import Seat


@dataclass(frozen=True, kw_only=True)
class Access:
    """Where the bridge listens, and who may come in. ``key`` is what the address needs, if it may be told;
    ``shown`` is the host that others reach, if it is another one."""

    host: str = "127.0.0.1"
    port: int = 8765
    shown: str = ""
    admits: Admission = everybody
    key: str = ""
    origins: Sequence[str] = ()
    context: ssl.SSLContext | None = None


@dataclass(frozen=True)
class Served:
    """A bridge that serves: the address of its WebSocket, and its channels."""

    url: str
    channels: Channels

    @property
    def desktop(self) -> str:
        """What opens it in Foxglove's desktop program."""
        return f"foxglove://open?{self._source()}"

    @property
    def web(self) -> str:
        """What opens it in Foxglove's web application."""
        return f"https://app.foxglove.dev/~/view?{self._source()}"

    def _source(self) -> str:
        return urlencode({"ds": "foxglove-websocket", "ds.url": self.url})


@contextmanager
def playing(source: Source, name: str, access: Access) -> Iterator[Served]:
    """Play what is stored. Raises `StationError` if the port is in use."""
    channels = Channels(
        name,
        topics=source.topics,
        range_ns=(source.start_ns, source.end_ns),
        backlog=waiting(source.largest_bytes),
    )
    player = Player(source, channels)
    channels.on_wanted, channels.on_control = player.rewanted, player.control
    with channels, player, _door(channels, access) as served:
        yield served


@contextmanager
def serving(
    cloud: Cloud,
    robots: Sequence[str],
    access: Access,
    *,
    way: str,
    rate_hz: float,
    token: str = "",
    seat: Seat | None = None,
) -> Iterator[Served]:
    """Serve robots live; with a driver's seat, what clients publish drives.

    Raises `StationError` for an unknown robot, if the port is in use, and for a driver without the right.
    """
    streams = Streams(cloud, robots)
    publishes = () if seat is None else ENCODINGS
    channels = Channels(f"iort {cloud.namespace}", topics=streams.topics, publishes=publishes)
    lanes = Live(cloud, streams, channels, way=way, rate_hz=rate_hz, token=token)
    channels.on_wanted = lanes.rewanted
    with ExitStack() as stack:
        stack.enter_context(channels)
        stack.enter_context(lanes)
        wheel = None
        if seat is not None:
            wheel = stack.enter_context(PublishedWheel(seat, partial(channels.say, name="driving")))
        yield stack.enter_context(_door(channels, access, wheel))


@contextmanager
def _door(channels: Channels, access: Access, wheel: Wheel | None = None) -> Iterator[Served]:
    door = Door(
        access.host,
        access.port,
        inner=f"ws://{channels.host}:{channels.port}/",
        admits=access.admits,
        origins=access.origins,
        context=access.context,
        wheel=wheel,
    )
    try:
        door.start()
    except OSError as error:
        where = f"cannot serve the bridge on {access.host} port {access.port}"
        why = "the port is in use; choose another, or 0 for any" if error.errno == errno.EADDRINUSE else error
        raise StationError(f"{where}: {why}") from error
    try:
        yield Served(_url(access, door.port), channels)
    finally:
        door.stop()


def _url(access: Access, port: int) -> str:
    scheme = "ws" if access.context is None else "wss"
    host = access.shown or access.host
    key = f"?key={quote(access.key, safe='')}" if access.key else ""
    return f"{scheme}://{f'[{host}]' if ':' in host else host}:{port}/{key}"
