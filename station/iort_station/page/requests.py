"""Requests to the page's server and its answers: parameters, errors, and bodies, plain and packed."""

from __future__ import annotations

import gzip
import hashlib
import json
import math
import re
from collections.abc import Callable, Generator, Mapping
from typing import Any, NamedTuple, TypeVar

from botocore.exceptions import BotoCoreError, ClientError

from iort_contract.limits import ContractError
from iort_contract.topics import check_robot
from iort_station.errors import StationError
from iort_station.page.page import TYPES

# What waits for a robot yields whenever it does, and holds no place meanwhile.
Waiting = Generator[None, None, Mapping[str, Any]]
Handler = Callable[[Mapping[str, str]], Mapping[str, Any] | Waiting]
_T = TypeVar("_T")
# A coding of Accept-Encoding and its weight.
_CODING = re.compile(r"([^\s,;]+)\s*(?:;\s*q\s*=\s*([0-9.]+))?")


class Body(NamedTuple):
    """A body, and packed by gzip. ``etag`` tells whether a browser has it already."""

    kind: str
    plain: bytes
    packed: bytes
    etag: str


def as_json(value: Mapping[str, Any], level: int = 6) -> Body:
    """A value as JSON."""
    try:
        text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    except ValueError:
        text = json.dumps(_finite(value), allow_nan=False, separators=(",", ":"))
    return packed(TYPES[".json"], text.encode(), level)


def _finite(value: Any) -> Any:
    """The value, with null for each number that JSON does not have."""
    if isinstance(value, Mapping):
        return {name: _finite(entry) for name, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def packed(kind: str, content: bytes, level: int = 6) -> Body:
    """The body of a content; a lower ``level`` packs faster."""
    return Body(kind, content, gzip.compress(content, level, mtime=0), hashlib.sha256(content).hexdigest())


def takes_gzip(accepted: str) -> bool:
    """Whether an Accept-Encoding allows gzip: RFC 9110, 12.5.3. A weight of 0 refuses a coding."""
    weights: dict[str, str] = dict(_CODING.findall(accepted.lower()))
    weight = weights.get("gzip", weights.get("*", "0"))
    return weight == "" or weight.strip("0.") != ""


def text(request: Mapping[str, str], name: str) -> str:
    """A text that is not empty; raises `StationError`."""
    if not request.get(name):
        raise StationError(f"the request must have the parameter {name}")
    return request[name]


def robot_of(request: Mapping[str, str]) -> str:
    """The parameter ``robot``; raises `StationError`, and `ContractError` for a name that no robot has."""
    return check_robot(text(request, "robot"))


def number(request: Mapping[str, str], name: str) -> float:
    """A number; raises `StationError`."""
    value = text(request, name)
    try:
        return float(value)
    except ValueError as error:
        raise StationError(f"{name} must be a number, got {value[:40]!r}") from error


def whole(request: Mapping[str, str], name: str, least: int, most: int) -> int:
    """A whole number in the range; raises `StationError`."""
    value = text(request, name)
    # Sixteen digits are enough for every allowed number.
    if not (value.isascii() and value.isdecimal()) or len(value) > 16 or not least <= int(value) <= most:
        raise StationError(f"{name} must be a whole number from {least} to {most}, got {value[:40]!r}")
    return int(value)


def outcome(work: Callable[[], Mapping[str, Any] | _T]) -> tuple[int, Body] | _T:
    """The status and the body of an answer or of an error; anything else as it is. A generator answers by its
    end."""
    try:
        result = work()
    except StopIteration as end:
        result = end.value
    except (StationError, ContractError) as error:
        return 400, as_json({"error": str(error)})
    except (BotoCoreError, ClientError) as error:
        return 502, as_json({"error": f"AWS refused a call: {error}"})
    return (200, as_json(result, level=1)) if isinstance(result, Mapping) else result
