"""Reads recordings: bags of ROS 1 and ROS 2, and the logs of VESC Tool. For the agent, which plays them, and
the station, which imports them; bags need the package rosbags."""

from __future__ import annotations

from typing import Callable, ContextManager, Iterator, Mapping, NamedTuple

from iort_contract.limits import ContractError, Value


class RecordingError(ContractError):
    """A recording that cannot be read; the text says why, and what to do."""


class Message(NamedTuple):
    """A message: the time of recording, counted from the start, and the time of measurement."""

    stream: str
    at_ns: int
    stamp_ns: int
    values: Mapping[str, Value]


# Opens the recording for one round; gives its messages in the order of recording.
Open = Callable[[], ContextManager[Iterator[Message]]]
