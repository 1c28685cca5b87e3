"""From samples to messages: streams, batches, live samples and pings. It uses sources, spool, files and
mqtt."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Mapping

from iort_agent.common.schema import allowed, choice, items, number, setting
from iort_contract.cloud import IOT, PUBNUB
from iort_contract.limits import LIVE_MAX_RATE_HZ
from iort_contract.messages.shadow import FIELDS, SETTINGS, WATCHED
from iort_contract.topics import PING_PATHS


@dataclass(frozen=True)
class RecordConfig:
    """The record lane. A batch spans at most ``batch_s``; with 0 each sample is sent by itself."""

    enabled: bool = setting(allowed(SETTINGS["record.enabled"]), default=True)
    batch_s: float = setting(number(0, 1, unit="s"), default=1.0)


@dataclass(frozen=True)
class LiveConfig:
    """The live lane. ``rate_hz`` is the most messages a second of each stream. While nobody
    looks, one in ten seconds is sent, unless ``when`` is ``always``. Then ``transport`` says whether viewers
    listen at PubNub or at AWS IoT; otherwise they say so themselves."""

    enabled: bool = setting(allowed(SETTINGS["live.enabled"]), default=True)
    rate_hz: float = setting(allowed(SETTINGS["live.rate_hz"]), LIVE_MAX_RATE_HZ)
    when: str = setting(allowed(SETTINGS["live.when"]), default=WATCHED)
    transport: str = setting(choice(PUBNUB, IOT), PUBNUB)


@dataclass(frozen=True)
class PingConfig:
    """The pings. ``rate_hz`` is the number a second over each path; 0 sends none."""

    rate_hz: float = setting(allowed(SETTINGS["ping.rate_hz"]), 0.0)
    paths: tuple[str, ...] = setting(
        items(
            choice(*PING_PATHS),
            at_least=1,
            what=f"a list of some of {', '.join(PING_PATHS)}",
        ),
        PING_PATHS,
    )
    padding_bytes: int = setting(number(0, 100_000, whole=True, unit="bytes"), 0)


@dataclass(frozen=True)
class RuntimeSettings:
    """The settings in force. ``fields`` maps a stream to its selected fields; other streams keep all."""

    record_enabled: bool
    live_enabled: bool
    live_rate_hz: float
    ping_rate_hz: float
    log_level: str
    live_when: str = WATCHED
    motion_stopped: bool = False
    fields: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def by_name(self) -> dict[str, Any]:
        """The settings by the names that the shadow has."""
        return {
            **{name: getattr(self, name.replace(".", "_")) for name in SETTINGS},
            **{f"{FIELDS}.{stream}": list(names) for stream, names in sorted(self.fields.items())},
        }
