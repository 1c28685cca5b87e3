"""A topic of a ROS 2 graph that somebody wants: a subscription to each of its types, by the quality of
service that its publishers offer now.

```
 no publisher ──► subscribed ──── they offer other things ───► two subscriptions
                      ▲                                              │
                      └── the new one is connected, or time is over ─┘
```

A subscription cannot change what it requests. While the next one is connected to the publishers, the one
before is still heard, and what came by both is taken once.
"""

from __future__ import annotations

import logging
from typing import Any, Callable, Mapping, Sequence

from iort_agent.common.logs import ThrottledLog
from iort_agent.common.threads import Clock
from iort_agent.errors import SourceError
from iort_agent.ros.qos import Offer, QosConfig, Request, request
from iort_agent.ros.ros2_session import INCOMPATIBLE, Endpoint, Session, Subscription
from iort_agent.ros.ros2_types import Types
from iort_contract.ros.definition import VARIABLE, Definition

_log = logging.getLogger(__name__)

# A better quality of service is requested once it was offered at so many looks: publishers come and go.
_STEADY = 5
# The next subscription has so many looks to connect.
_CONNECT = 3
_MAX_PUBLISHERS = 32
_NOT_INSTALLED, _DIFFERS, _REFUSED = "type_not_installed", "definition_differs", "refused_by_middleware"

# Takes a message: what a ROS 1 publisher's connection header has, its bytes, and the nanoseconds since the
# epoch at which it was published and received, 0 if nobody tells.
OnMessage = Callable[[Mapping[str, str], bytes, int, int], None]


class _Part:
    """The subscription to one type of the topic."""

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self.asked = Request(Offer(reliable=False, transient_local=False), 0)
        self.header: Mapping[str, str] = {}
        # The header of each publisher, where rclpy tells which one sent a message.
        self.headers: dict[bytes, Mapping[str, str]] = {}
        self.now: Subscription | None = None
        self.before: Subscription | None = None
        # What came while there are two, and how many looks ago the second one began.
        self.both: set[tuple[int, int]] | None = None
        self.looks = 0
        # At how many looks in a row more was offered than is requested.
        self.better = 0

    def header_of(self, gid: bytes) -> Mapping[str, str]:
        """The header of a publisher."""
        header = self.headers.get(gid)
        if header is None:
            if len(self.headers) >= _MAX_PUBLISHERS:
                self.headers.clear()
            header = self.headers[gid] = {**self.header, "callerid": gid.hex()}
        return header

    def settled(self) -> bool:
        """Whether nothing is about to change."""
        return self.both is None and not self.better

    def close(self) -> None:
        """Take what waits, and end."""
        for subscription in (self.before, self.now):
            if subscription is not None:
                subscription.drain()
                subscription.close()
        self.before = self.now = None


class Topic:
    """One topic. Its methods are called in the node's thread, unless they say so."""

    def __init__(self, name: str, session: Session, types: Types, clock: Clock) -> None:
        self.name = name
        self.qos = QosConfig()
        self.takers: tuple[OnMessage, ...] = ()
        # Those of them for which messages may come a moment later.
        self.patient: frozenset[OnMessage] = frozenset()
        # Why one of its types is not heard.
        self.why: str | None = None
        self._session, self._types = session, types
        self._parts: dict[str, _Part] = {}
        self._seen: tuple[tuple[str, ...], int] = ((), 0)
        self._looks = 0
        # Publishers that the middleware has not connected, since the last look.
        self._incompatible = 0
        self._counts: dict[str, int] = {}
        self._throttled = ThrottledLog(_log, clock)

    def heard(self) -> bool:
        """Whether it is subscribed, or nobody wants it."""
        return bool(self._parts) or not self.takers

    def connections(self) -> int:
        """How many publishers it is connected to; in any thread."""
        now = [part.now for part in [*self._parts.values()]]
        return sum(subscription.publishers() for subscription in now if subscription is not None)

    def report(self) -> dict[str, Any]:
        """What was lost, by reason, and the quality of service by which it is heard; in any thread."""
        qos = "; ".join(sorted({str(part.asked.offer) for part in [*self._parts.values()]}))
        return {**self._counts, **({"qos": qos} if qos else {})}

    def look(self, kinds: Sequence[str], every: int = 1) -> None:
        """Subscribe to each type that the topic has now, by what its publishers offer. That is asked for at
        each of so many looks, and when the types or the number of publishers have changed."""
        if not self.takers:
            for kind in [*self._parts]:
                self._parts.pop(kind).close()
            self._seen, self.why = ((), 0), None
            return
        seen = tuple(kinds), self._session.count(self.name) if kinds else 0
        settled = all(part.settled() for part in self._parts.values()) and not self._incompatible
        self._looks += 1
        if seen == self._seen and self._looks < every and settled:
            return
        self._seen, self._looks = seen, 0
        offers: dict[str, list[Endpoint]] = {}
        for endpoint in self._session.publishers(self.name) if seen[1] else ():
            offers.setdefault(endpoint.kind, []).append(endpoint)
        for kind in [*self._parts]:
            # A topic without publishers waits for the next one of the same type.
            if offers and kind not in offers:
                self._parts.pop(kind).close()
        self.why, incompatible = None, self._incompatible
        for kind, endpoints in offers.items():
            self._follow(kind, endpoints)
        # What this look has not mended is not heard.
        if incompatible and self._incompatible:
            offer = ", ".join(str(part.asked.offer) for part in self._parts.values())
            self._count(INCOMPATIBLE, incompatible, f"a publisher does not offer {offer}: it is not heard")
        self._incompatible = 0

    def _follow(self, kind: str, endpoints: Sequence[Endpoint]) -> None:
        try:
            definition, large = self._types.found(kind), _large(self._types.parsed(kind))
        except SourceError as error:
            self._leave_out(_NOT_INSTALLED, str(error))
            return
        part = self._parts.get(kind)
        if part is None:
            part = self._parts[kind] = _Part(kind)
        patient = self.patient.issuperset(self.takers)
        asked = request([one.offer for one in endpoints], self.qos, large=large, patient=patient)
        if part.now is None:
            part.asked = asked
            part.now = self._subscribe(part)
            if part.now is None:
                del self._parts[kind]
                return
        else:
            self._adapt(part, asked, len(endpoints))
        header = self._header(part, definition.text, definition.type_hash, endpoints)
        if header != part.header:
            part.header = header
            part.headers.clear()

    def _adapt(self, part: _Part, asked: Request, publishers: int) -> None:
        """Request what is offered now."""
        part.looks += 1
        if part.before is not None and part.now is not None:
            if part.now.publishers() >= publishers or part.looks >= _CONNECT:
                part.before.drain()
                part.now.drain()
                part.before.close()
                part.before = None
            return
        part.both = None
        part.better = part.better + 1 if asked != part.asked else 0
        if not part.better or (_more(asked.offer, part.asked.offer) and part.better < _STEADY):
            return
        _log.info("topic %s: its publishers offer %s now", self.name, asked.offer)
        part.before, before = part.now, part.asked
        part.both, part.looks, part.better = set(), 0, 0
        part.asked = asked
        part.now = self._subscribe(part)
        if part.now is None:
            part.now, part.before, part.both, part.asked = part.before, None, None, before
        else:
            self._incompatible = 0

    def _subscribe(self, part: _Part) -> Subscription | None:
        def take(data: bytes, info: Mapping[str, Any]) -> None:
            source_ns, both = info["source_timestamp"], part.both
            if both is not None:
                key = source_ns, hash(data)
                if key in both:
                    return
                both.add(key)
            gid, received_ns = info.get("publisher_gid"), info.get("received_timestamp", 0)
            # Rolling tells it, Humble and Jazzy do not.
            header = part.header if gid is None else part.header_of(bytes(gid["data"]))
            for taker in self.takers:
                try:
                    taker(header, data, source_ns, received_ns)
                except Exception:  # noqa: BLE001, PERF203 - a taker's error costs this message, not the node
                    _log.exception("topic %s: a message could not be taken", self.name)

        def told(reason: str, many: int) -> None:
            if reason == INCOMPATIBLE:
                self._incompatible += many
            else:
                self._count(reason, many, f"the middleware has lost {many} message(s)")

        message_class = self._types.found(part.kind).message_class
        try:
            return self._session.subscribe(self.name, message_class, part.asked, take, told)
        except Exception as error:  # noqa: BLE001 - the middleware's own; the other topics must be heard
            self._leave_out(_REFUSED, f"{part.kind} cannot be subscribed to: {error}")
            return None

    def _header(
        self, part: _Part, text: str, type_hash: str, endpoints: Sequence[Endpoint]
    ) -> dict[str, str]:
        """What a ROS 1 publisher's connection header has. A definition that does not fit the publisher's type
        hash is left out."""
        fitting = {"message_definition": text}
        hashes = {one.type_hash for one in endpoints if one.type_hash} or {type_hash}
        if type_hash not in hashes and type_hash.startswith("RIHS"):
            other = min(hashes)
            if part.header.get("md5sum") != other:
                why = f"its publisher's definition of {part.kind} ({other}) is not the installed one"
                self._count(_DIFFERS, 1, f"{why} ({type_hash}): source the publisher's workspace")
            fitting, type_hash = {}, other
        return {
            "type": part.kind,
            "md5sum": type_hash,
            **fitting,
            "callerid": endpoints[0].node if len(endpoints) == 1 else "",
            # Also where it is not requested yet: what comes now may come again once it is.
            "latching": "1" if any(one.offer.transient_local for one in endpoints) else "0",
        }

    def _leave_out(self, reason: str, why: str) -> None:
        """A type of the topic is not heard; it is tried again at each look."""
        self.why = f"topic {self.name}: {why}"
        if reason not in self._counts:
            self._count(reason, 1, why)

    def _count(self, reason: str, many: int, why: str) -> None:
        self._counts = {**self._counts, reason: self._counts.get(reason, 0) + many}
        self._throttled.warn(reason, f"topic {self.name}: {why}")


def _more(one: Offer, other: Offer) -> bool:
    """Whether an offer has all that another has."""
    return one.reliable >= other.reliable and one.transient_local >= other.transient_local


def _large(definition: Definition | None) -> bool:
    """Whether messages may have bytes without a limit, such as images."""
    fields = [field for fields in definition.types.values() for field in fields] if definition else []
    return any(field.kind in ("uint8", "byte", "char") and field.length == VARIABLE for field in fields)
