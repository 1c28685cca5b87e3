"""The types of the agent's status: of `iort-agent status`, and at the end of a run of its report.

It is written as JSON, with the fields' names as keys. The rooms fill in the parts that describe them.
"""

import dataclasses
from dataclasses import dataclass
from typing import Any, Dict, List, Mapping, Optional, Tuple, Type, TypeVar, Union, get_type_hints

from iort_agent.common.logs import Trouble
from iort_contract.messages.shadow import OverShare

T = TypeVar("T")

# The counts of a source, of the downlink or of the attachments: each names its own.
Counts = Dict[str, Any]


@dataclass(frozen=True)
class Connection:
    """The connection to the broker. ``since_s`` is the time since it was made or lost."""

    connected: bool
    since_s: float
    connects: int
    last_error: Optional[str] = None
    certificate_id: Optional[str] = None
    endpoint: str = ""


@dataclass(frozen=True)
class RecordState:
    """Whether samples are recorded."""

    enabled: bool


@dataclass(frozen=True)
class LiveState:
    """The live lane. ``asked_hz`` is the rate of a stream now, for so many viewers; ``effective_hz`` is that
    of one that the rate limiter slows down."""

    enabled: bool
    rate_hz: float
    asked_hz: float
    viewers: int
    effective_hz: float
    slowed: bool
    published: int
    refused: int


@dataclass(frozen=True)
class PingState:
    """The pings. ``held_back`` counts those that the rate limiter did not let through."""

    rate_hz: float
    held_back: int


@dataclass(frozen=True)
class Lanes:
    """The three lanes."""

    record: RecordState
    live: LiveState
    ping: PingState


@dataclass(frozen=True)
class StreamState:
    """A stream's counts, as in `iort_agent.lanes.streams.StreamCounts`, and its rates now. ``fields`` are
    those that the settings keep; empty if they keep all."""

    samples: int
    stored: int
    batches: int
    refused: int
    nulled: int
    per_s: float
    live_hz: float
    silent_s: float
    fields: List[str]


@dataclass(frozen=True)
class Queue:
    """The batches that wait, and those that were dropped. ``durable``: those that wait survive the agent."""

    batches: int
    samples: int
    bytes: int
    durable: bool
    dropped_batches: int
    dropped_samples: int


@dataclass(frozen=True)
class Files:
    """The uploads. ``current`` is the file being sent; ``large`` counts the attachments."""

    waiting: int
    uploaded: int
    sent_bytes: int
    current: Optional[str]
    current_bytes: int
    last_error: Optional[str]
    large: Optional[Counts] = None


@dataclass(frozen=True)
class ClockOffset:
    """The cloud's clock minus the robot's, and the largest error of this estimate."""

    offset_ms: float
    uncertainty_ms: float


@dataclass(frozen=True)
class RoundTrips:
    """The pings over one path, and the percentiles of their round trips."""

    sent: int
    received: int
    lost: int
    p50_ms: Optional[float]
    p95_ms: Optional[float]


@dataclass(frozen=True)
class Status:
    """The agent now. Each of ``sources`` is the source's description, ``source``, and its own counts."""

    robot: str
    boot: str
    pid: int
    uptime_s: float
    connection: Connection
    lanes: Lanes
    sources: List[Counts]
    failed_sources: List[str]
    streams: Dict[str, StreamState]
    spool: Queue
    downlink: Optional[Counts]
    files: Optional[Files]
    recorder: Optional[Counts]
    video: Optional[Counts]
    clock: Optional[ClockOffset]
    pings: Dict[str, RoundTrips]
    over_share: Optional[OverShare]
    alarms: List[str]
    troubles: List[Trouble]


def read(cls: Type[T], values: Mapping[str, Any]) -> T:
    """The dataclass of a JSON document. Ignores keys that it does not know; raises `KeyError` for one that
    is missing."""
    return cls(**{name: _value(hint, values[name]) for name, hint in get_type_hints(cls).items()})


def _value(hint: Any, value: Any) -> Any:
    """A value of the type that a field has: a dataclass, or a list, dictionary or `Optional` of one."""
    if dataclasses.is_dataclass(hint):
        return read(hint, value)  # type: ignore[arg-type]  # a type, as it comes from an annotation
    kind: Any = getattr(hint, "__origin__", None)
    inner: Tuple[Any, ...] = getattr(hint, "__args__", ())
    if kind is Union:
        return None if value is None else _value(inner[0], value)
    if kind is list:
        return [_value(inner[0], item) for item in value]
    if kind is dict:
        return {name: _value(inner[1], item) for name, item in value.items()}
    return value
