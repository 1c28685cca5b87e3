"""A live update as a listener keeps it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from iort_contract.tables import ROBOT, T_US


class Heard(NamedTuple):
    """One update: its delay from the car to this machine, its sample's time in microseconds, and the hops."""

    robot: str
    stream: str
    boot: str
    seq: int
    delay_ms: float
    t_us: int
    hops: Mapping[str, int]


# Takes an update, the time at which PubNub took it (0 from the broker) and the time of its arrival here, in
# microseconds. It is called in the listener's own thread.
OnUpdate = Callable[[dict[str, Any], int, int], None]


def heard_of(update: Mapping[str, Any], now_us: int) -> Heard:
    """What is kept of an update that arrives now."""
    hops = update["hops"]
    return Heard(
        robot=update[ROBOT],
        stream=update["stream"],
        boot=update["boot"],
        seq=update["seq"],
        delay_ms=(now_us - hops["sent_us"]) / 1000,
        t_us=update[T_US],
        hops=hops,
    )
