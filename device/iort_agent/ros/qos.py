"""Quality of service: what a subscription requests of a topic's publishers, as `ros2 bag record` does.

A request that asks more than a publisher offers gets nothing from it. So reliable delivery and kept messages
are requested only where all publishers offer them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Sequence

from iort_agent.common.schema import choice, number, setting

RELIABLE, BEST_EFFORT = "reliable", "best_effort"
TRANSIENT_LOCAL, VOLATILE = "transient_local", "volatile"
# The middleware keeps as many messages while the agent is busy: seconds of a fast topic, but of images, which
# may have 10 MB each, only as many as fit in the memory.
DEPTH, DEPTH_OF_LARGE = 1000, 20


class Offer(NamedTuple):
    """What a publisher offers, and what a subscription requests."""

    reliable: bool
    transient_local: bool

    def __str__(self) -> str:
        return f"{RELIABLE if self.reliable else BEST_EFFORT}, {self.durability()}"

    def durability(self) -> str:
        """The durability's name."""
        return TRANSIENT_LOCAL if self.transient_local else VOLATILE


@dataclass(frozen=True)
class QosConfig:
    """What is requested of a topic's publishers instead of what all of them offer. A publisher that offers
    less is not heard. ``depth`` is how many messages the middleware keeps while the agent is busy."""

    reliability: str | None = setting(choice(RELIABLE, BEST_EFFORT), None)
    durability: str | None = setting(choice(TRANSIENT_LOCAL, VOLATILE), None)
    depth: int | None = setting(number(1, 100_000, whole=True), None)


class Request(NamedTuple):
    """What a subscription requests, and how many messages the middleware keeps for it. Those of a ``patient``
    one may wait there a moment: they are taken together."""

    offer: Offer
    depth: int
    patient: bool = False


def request(
    offers: Sequence[Offer], config: QosConfig = QosConfig(), *, large: bool = False, patient: bool = False
) -> Request:
    """The request to a topic's publishers, whose messages may be ``large``. It is ``patient`` only where the
    middleware has room for what comes meanwhile."""
    reliable = bool(offers) and all(offer.reliable for offer in offers)
    transient_local = bool(offers) and all(offer.transient_local for offer in offers)
    if config.reliability is not None:
        reliable = config.reliability == RELIABLE
    if config.durability is not None:
        transient_local = config.durability == TRANSIENT_LOCAL
    depth = config.depth or (DEPTH_OF_LARGE if large else DEPTH)
    return Request(Offer(reliable, transient_local), depth, patient and depth >= DEPTH)
