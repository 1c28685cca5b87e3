"""The rates in a robot's car.yaml that make a bill; `iort-agent check` judges the whole file."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import mean
from typing import Any

import yaml

from iort_contract.messages.control.settings import ALWAYS, WATCHED
from iort_station.cost.usage import TRANSPORTS, Usage
from iort_station.errors import StationError

# Sources that take samples at a rate of their own, with its default; a test compares them with the agent's.
_OWN_RATE_HZ = {"sim": 50.0, "vesc": 50.0}
# A simulated car's poses, a stream beside its samples.
_POSE_RATE_HZ = 20.0


def as_configured(usage: Usage, file: Path) -> Usage:
    """The usage with the rates of a car.yaml; raises `StationError` for an invalid file.

    The file does not tell the rates of ROS topics and recordings; these stay as in ``usage``.
    """
    car = _Section(file, "", _content(file))
    rates = [rate for source in car.items("sources") for rate in _rates_hz(source)]
    live, metrics = car.section("live"), car.section("metrics")
    live_hz = live.number("rate_hz", usage.live_hz)
    when = live.choice("when", (WATCHED, ALWAYS), WATCHED)
    transport = live.choice("transport", TRANSPORTS, usage.live_transport)
    return replace(
        usage,
        # The limit applies to each stream, which sends at most what its source delivers.
        live_hz=sum(min(live_hz, rate_hz or math.inf) for rate_hz in rates) if live.enabled() else 0.0,
        batch_s=car.section("record").number("batch_s", usage.batch_s),
        watched_hours=None if when == ALWAYS else usage.watched_hours,
        live_transport=transport if when == ALWAYS else usage.live_transport,
        ping_hz=car.section("ping").number("rate_hz", usage.ping_hz),
        agent_every_s=metrics.number("every_s", usage.agent_every_s) if metrics.enabled() else 0.0,
        streams=len(rates),
        rate_hz=mean(rate_hz or usage.rate_hz for rate_hz in rates),
    )


def _rates_hz(source: _Section) -> list[float | None]:
    """The rate of each stream of a source; None if the file does not tell it."""
    kind = source.values.get("type")
    if kind in _OWN_RATE_HZ:
        rate_hz = source.number("rate_hz", _OWN_RATE_HZ[kind])
        poses_hz = source.section("pose").number("rate_hz", _POSE_RATE_HZ) if kind == "sim" else 0.0
        return [rate_hz, min(rate_hz, poses_hz)] if poses_hz else [rate_hz]
    topics = source.section("topics").values.values()
    names = {str(topic.get("stream") if isinstance(topic, dict) else topic) for topic in topics}
    return [None] * max(1, len(names))


class _Section:
    """A mapping in the file; errors name the file and the key."""

    def __init__(self, file: Path, name: str, values: Any) -> None:
        self._file, self._name = file, name
        self.values: Mapping[Any, Any] = values or {}
        if not isinstance(self.values, Mapping):
            raise self._error("", "a mapping", values)

    def section(self, key: str) -> _Section:
        return _Section(self._file, self._path(key), self.values.get(key))

    def items(self, key: str) -> list[_Section]:
        found = self.values.get(key)
        if not isinstance(found, list) or not found:
            raise self._error(key, "a list of at least one item", found)
        return [_Section(self._file, self._path(f"{key}[{i}]"), item) for i, item in enumerate(found)]

    def number(self, key: str, default: float) -> float:
        found = self.values.get(key, default)
        if isinstance(found, bool) or not isinstance(found, (int, float)) or not 0 <= found < math.inf:
            raise self._error(key, "a number of at least 0", found)
        return float(found)

    def choice(self, key: str, allowed: Sequence[str], default: str) -> str:
        found = self.values.get(key, default)
        if found not in allowed:
            raise self._error(key, f"one of {', '.join(allowed)}", found)
        return str(found)

    def enabled(self) -> bool:
        found = self.values.get("enabled", True)
        if not isinstance(found, bool):
            raise self._error("enabled", "true or false", found)
        return found

    def _path(self, key: str) -> str:
        return f"{self._name}.{key}".strip(".")

    def _error(self, key: str, allowed: str, found: Any) -> StationError:
        path = self._path(key)
        return StationError(f"{self._file}: {path}{': ' * bool(path)}must be {allowed}, got {found!r}")


def _content(file: Path) -> Any:
    try:
        return yaml.safe_load(file.read_text())
    except (OSError, UnicodeDecodeError) as error:
        raise StationError(f"{file} cannot be read: {error}") from error
    except yaml.YAMLError as error:
        raise StationError(f"{file} is not YAML: {error}") from error
