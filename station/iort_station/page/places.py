"""Places for requests: how many are worked on at once, of all clients, of one client, and of one kind.

A request that finds none waits its turn, for a time and among few: whoever has the fewest places is next.
Beyond that it is refused at once, so nothing is queued without a bound. What may never wait for reading, such
as a stop, has a lane of its own. Who waits for a robot has no place meanwhile.
"""

from __future__ import annotations

import asyncio
import ipaddress
import threading
from collections import Counter
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from contextlib import suppress
from typing import NamedTuple, TypeVar

_T = TypeVar("_T")
READING, ACTING, WRITING = "reading", "acting", "writing"
# The answers that are worked on at a time, and as many actions; those of one client, and of one kind of its.
MOST_ANSWERS, ANSWERS_OF_CLIENT, ANSWERS_OF_KIND = 16, 8, 4
# Further ones of a client wait for so long, and still further ones are refused.
MOST_WAITING, WAIT_S = 32, 30.0
# A file of a long range takes a gigabyte of memory while it is written. A client has one at a time.
MOST_DOWNLOADS = 2
# The same of what takes much memory for a moment.
MOST_FEW = 2
# For how many robots something waits at once, and how often it looks.
_MOST_PENDING, PENDING_OF_CLIENT, _LOOK_S, _LONGEST_LOOK_S = 64, 16, 0.1, 1.0


class Busy(Exception):  # noqa: N818 - no fault
    """There is no place. ``own`` says that the client itself has all that it may have."""

    def __init__(self, *, own: bool) -> None:
        super().__init__("too many requests of this client" if own else "too many requests")
        self.own = own


class _Request(NamedTuple):
    client: str
    kind: str
    free: asyncio.Future[None]


class Places:
    """``most`` places: ``of_client`` for a client, and ``of_kind`` of these for one kind. ``waiting``
    requests of a client wait, ``wait_s`` each. One event loop uses them."""

    def __init__(self, most: int, *, of_client: int, of_kind: int, waiting: int, wait_s: float) -> None:
        self._most, self._of_client, self._of_kind = most, of_client, of_kind
        self._most_waiting, self._wait_s = waiting, wait_s
        self._clients: Counter[str] = Counter()
        self._kinds: Counter[tuple[str, str]] = Counter()
        self._waiting: list[_Request] = []

    async def take(self, client: str, kind: str) -> None:
        """Take a place until `free`; raises `Busy`."""
        if self._admits(client, kind):
            self._clients[client] += 1
            self._kinds[client, kind] += 1
            return
        waiting = sum(request.client == client for request in self._waiting)
        if waiting >= self._most_waiting or len(self._waiting) >= self._most_waiting * self._most:
            raise self._busy(client, kind)
        request = _Request(client, kind, asyncio.get_running_loop().create_future())
        self._waiting.append(request)
        try:
            await asyncio.wait_for(asyncio.shield(request.free), self._wait_s)
        except BaseException as error:
            if request.free.done():
                # It came at this moment.
                self.free(client, kind)
            else:
                self._waiting.remove(request)
            if isinstance(error, asyncio.TimeoutError):
                raise self._busy(client, kind) from error
            raise

    def free(self, client: str, kind: str) -> None:
        """Give a place back; the next request has it."""
        # Without a count of zero: there are many clients.
        self._clients -= Counter([client])
        self._kinds -= Counter([(client, kind)])
        ready = [request for request in self._waiting if self._admits(request.client, request.kind)]
        if ready:
            # The first of those with the fewest places.
            first = min(ready, key=lambda request: self._clients[request.client])
            self._waiting.remove(first)
            self._clients[first.client] += 1
            self._kinds[first.client, first.kind] += 1
            first.free.set_result(None)

    def _busy(self, client: str, kind: str) -> Busy:
        own = self._clients[client] >= self._of_client or self._kinds[client, kind] >= self._of_kind
        return Busy(own=own)

    def _admits(self, client: str, kind: str) -> bool:
        return (
            self._clients.total() < self._most
            and self._clients[client] < self._of_client
            and self._kinds[client, kind] < self._of_kind
        )


class Work:
    """What a server works on, in a thread for each: in the lanes `READING`, `ACTING` and `WRITING`, and those
    of ``first`` and of ``few`` in a lane for each kind. One event loop uses it."""

    def __init__(self, first: Iterable[str], few: Iterable[str] = ()) -> None:
        self._lanes = {
            READING: _places(),
            ACTING: _places(),
            WRITING: _places(MOST_DOWNLOADS, 1, 1),
            **{kind: _places(of_client=MOST_ANSWERS, of_kind=MOST_ANSWERS) for kind in first},
            **{kind: _places(MOST_FEW, 1, 1) for kind in few},
        }
        self._pending = _places(_MOST_PENDING, PENDING_OF_CLIENT, PENDING_OF_CLIENT, waiting=0)

    async def do(self, work: Callable[[], _T], lane: str, client: str, kind: str) -> _T:
        """The result, in a place of the lane, or of the kind's own; raises `Busy`."""
        places = self._lanes.get(kind, self._lanes[lane])
        await places.take(client, kind)
        # Not where the result is awaited: a viewer who leaves does not end the thread.
        return await off_the_loop(work, lambda: places.free(client, kind))

    async def until(self, look: Callable[[], _T | None], lane: str, client: str, kind: str) -> _T:
        """The first result, in a place for each look and without one between them; raises `Busy` before the
        first."""
        await self._pending.take(client, kind)
        pause_s, looked = _LOOK_S, False
        try:
            while True:
                try:
                    result = await self.do(look, lane, client, kind)
                except Busy:
                    if not looked:
                        raise
                else:
                    looked = True
                    if result is not None:
                        return result
                await asyncio.sleep(pause_s)
                pause_s = min(1.5 * pause_s, _LONGEST_LOOK_S)
        finally:
            self._pending.free(client, kind)


def _places(
    most: int = MOST_ANSWERS,
    of_client: int = ANSWERS_OF_CLIENT,
    of_kind: int = ANSWERS_OF_KIND,
    waiting: int = MOST_WAITING,
) -> Places:
    return Places(most, of_client=of_client, of_kind=of_kind, waiting=waiting, wait_s=WAIT_S)


async def off_the_loop(work: Callable[[], _T], ended: Callable[[], None] = lambda: None) -> _T:
    """Run ``work`` in a daemon thread, so that a slow answer delays neither a file nor the exit. ``ended`` is
    called in the loop when the thread ends."""
    loop = asyncio.get_running_loop()
    done: Future[_T] = Future()
    done.set_running_or_notify_cancel()

    def run() -> None:
        try:
            done.set_result(work())
        except BaseException as error:  # noqa: BLE001 - raised where the answer is awaited
            done.set_exception(error)
        with suppress(RuntimeError):  # the server has ended
            loop.call_soon_threadsafe(ended)

    try:
        threading.Thread(target=run, name="page answer", daemon=True).start()
    except RuntimeError:  # the machine has no thread left
        ended()
        raise
    return await asyncio.wrap_future(done)


def client_of(address: str) -> str:
    """Who a limit for each client counts: an IPv4 address, or the network of an IPv6 address, because whoever
    has one address of it has them all."""
    try:
        known = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    return str(known) if known.version == 4 else str(ipaddress.ip_network((known, 64), strict=False))
