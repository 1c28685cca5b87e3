"""The configuration's sections `record`, `live` and `ping`."""

from __future__ import annotations

from dataclasses import dataclass

from iort_agent.schema import choice, flag, items, number, setting
from iort_contract.limits import LIVE_MAX_RATE_HZ, LIVE_MIN_RATE_HZ
from iort_contract.topics import PING_PATHS


@dataclass(frozen=True)
class RecordConfig:
    """The record lane. ``batch_s``: a batch spans at most this; 0 sends each sample by itself."""

    enabled: bool = setting(flag(), default=True)
    batch_s: float = setting(number(0, 1, unit="s"), default=1.0)


@dataclass(frozen=True)
class LiveConfig:
    """The live lane. ``rate_hz``: at most so many messages a second of each stream."""

    enabled: bool = setting(flag(), default=True)
    rate_hz: float = setting(
        number(LIVE_MIN_RATE_HZ, LIVE_MAX_RATE_HZ, unit="Hz"),
        LIVE_MAX_RATE_HZ,
    )


@dataclass(frozen=True)
class PingConfig:
    """Round trips to measure: so many a second over each path, 0 for none."""

    rate_hz: float = setting(number(0, 20, unit="Hz"), 0.0)
    paths: tuple[str, ...] = setting(
        items(
            choice(*PING_PATHS),
            at_least=1,
            what=f"a list of some of {', '.join(PING_PATHS)}",
        ),
        PING_PATHS,
    )
    padding_bytes: int = setting(number(0, 100_000, whole=True, unit="bytes"), 0)
