"""What an analysis says of a drive: estimates with their intervals, events, and tables."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import wraps
from typing import Any, NamedTuple, ParamSpec, TypeAlias, TypeVar

from numpy.typing import NDArray

from iort_analysis import NoResultError
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.messages.analysis import DriveKey, Estimate, decode_estimate, encode_estimate

# A table of results, such as the laps of a drive: columns of equal length, whose names end with their units.
Table: TypeAlias = Mapping[str, NDArray[Any]]
_P = ParamSpec("_P")
_T = TypeVar("_T")


class Event(NamedTuple):
    """Something that happened in a drive: ``kind`` is one of the catalogue's kinds of findings.

    ``effect`` is its size, ``p`` the chance of it in a healthy car; None if no model gives one.
    """

    kind: str
    start_us: int
    end_us: int
    stream: str
    fields: tuple[str, ...]
    text: str
    effect: Estimate | None = None
    p: float | None = None


@dataclass(frozen=True)
class Mined:
    """What one miner found. ``estimates`` are by the names of the catalogue's parameters; ``missing`` gives
    the reason for each that could not be computed."""

    estimates: Mapping[str, Estimate] = field(default_factory=dict)
    missing: Mapping[str, str] = field(default_factory=dict)
    events: Sequence[Event] = ()
    tables: Mapping[str, Table] = field(default_factory=dict)


def miner(*names: str) -> Callable[[Callable[_P, Mined]], Callable[_P, Mined]]:
    """A miner of these parameters: if it raises `NoResultError`, all of them are missing for that reason."""

    def frame(mine: Callable[_P, Mined]) -> Callable[_P, Mined]:
        @wraps(mine)
        def framed(*args: _P.args, **more: _P.kwargs) -> Mined:
            try:
                return mine(*args, **more)
            except NoResultError as error:
                return Mined(missing=dict.fromkeys(names, str(error)))

        return framed

    return frame


def attempt(function: Callable[_P, _T], *args: _P.args, **more: _P.kwargs) -> _T | str:
    """What a function returns; or the reason why it does not, for a miner that goes on without."""
    try:
        return function(*args, **more)
    except NoResultError as error:
        return str(error)


def merge(parts: Iterable[Mined]) -> Mined:
    """What several miners found, as one. A name that one of them has found is not missing."""
    parts = list(parts)
    estimates = {name: estimate for part in parts for name, estimate in part.estimates.items()}
    missing = {name: reason for part in parts for name, reason in part.missing.items()}
    return Mined(
        estimates=estimates,
        missing={name: reason for name, reason in missing.items() if name not in estimates},
        events=sorted((event for part in parts for event in part.events), key=lambda event: event.start_us),
        tables={name: table for part in parts for name, table in part.tables.items()},
    )


@dataclass(frozen=True)
class DriveResult:
    """The result of one drive. ``repairs`` counts what was cleaned, by kind; ``mined`` is of all miners.

    ``vesc`` is the name of the stream with the VESC's fields.
    """

    drive: DriveKey
    end_us: int
    samples: int
    repairs: Mapping[str, int]
    mined: Mined
    vesc: str = VESC_STREAM

    @property
    def measured(self) -> Measured:
        """The estimates alone."""
        return Measured(self.drive, self.mined.estimates)


class Measured(NamedTuple):
    """The estimates of one drive, as they are kept for comparing with later ones."""

    drive: DriveKey
    estimates: Mapping[str, Estimate]


def encode_result(result: DriveResult) -> dict[str, Any]:
    """The result as an object for JSON, without its tables."""
    return {
        "drive": vars(result.drive),
        "end_us": result.end_us,
        "samples": result.samples,
        "repairs": dict(result.repairs),
        "vesc": result.vesc,
        "estimates": {name: encode_estimate(one) for name, one in result.mined.estimates.items()},
        "missing": dict(result.mined.missing),
        "events": [
            {**event._asdict(), "effect": event.effect and encode_estimate(event.effect)}
            for event in result.mined.events
        ],
    }


def decode_result(content: Mapping[str, Any]) -> DriveResult:
    """Decode what `encode_result` wrote; raises KeyError or `iort_contract.limits.ContractError`."""
    mined = Mined(
        estimates={name: decode_estimate(one) for name, one in content["estimates"].items()},
        missing=content["missing"],
        events=[_decode_event(event) for event in content["events"]],
    )
    return DriveResult(
        drive=DriveKey(**content["drive"]),
        end_us=content["end_us"],
        samples=content["samples"],
        repairs=content["repairs"],
        mined=mined,
        vesc=content["vesc"],
    )


def _decode_event(content: Mapping[str, Any]) -> Event:
    effect = None if content["effect"] is None else decode_estimate(content["effect"])
    return Event(**{**content, "fields": tuple(content["fields"]), "effect": effect})
