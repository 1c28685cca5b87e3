"""The named shadow `agent`: the operator's wishes come in, what is in force and what was refused goes out.

What the operator desires lies over the configuration file; a wish withdrawn (null) lets the file's
value count again. The whole shadow is fetched after every connect and whenever a change was missed;
between those, every accepted change is followed. Those say more than the deltas do: a wish that
equals what is reported already makes no delta, though it may end a refusal.
"""

from __future__ import annotations

import json
import logging
from typing import Any, Callable, Mapping

from iort_agent.clock import Clock
from iort_agent.control.runtime_settings import Tuning, overlay
from iort_agent.errors import UplinkError
from iort_agent.mqtt.uplink import Message, Uplink
from iort_agent.rate_limiter import Allowance
from iort_contract.messages.commands import Command
from iort_contract.tables import AGENT_VERSION, OVER_SHARE, PUT_OFF, PUT_OFF_LAST_MS, PUT_OFF_SINCE_MS
from iort_contract.topics import ACCEPTED, COMMANDS, SHADOW

_log = logging.getLogger(__name__)

_AGAIN_S = 30.0
# AWS' limit of a shadow document is 8 KB; a value that was refused is quoted up to here.
_MAX_VALUE_CHARS = 200
_NOT_FOUND = 404
# No count and no time that a calendar has is as large.
_MOST = 10**15


class Remote:
    """Follows the shadow, and says there which version of the agent does so. `tick` is called now and
    then, the rest by the uplink. ``over_share`` is what the cloud said last of batches that it put off:
    since when and when last, in its own milliseconds, and how many."""

    def __init__(
        self,
        *,
        robot: str,
        base: Tuning,
        apply: Callable[[Tuning], None],
        known_fields: Callable[[], Mapping[str, Any]],
        version: str,
        uplink: Uplink,
        clock: Clock,
        allowance: Allowance,
    ) -> None:
        self._base = self.tuning = base
        self._apply = apply
        self._known_fields = known_fields
        self._agent_version = version
        self._uplink = uplink
        self._clock = clock
        self._allowance = allowance
        prefix = f"$aws/things/{robot}/shadow/name/{SHADOW}"
        self._get, self._update = f"{prefix}/get", f"{prefix}/update"
        self._filters = {
            f"{self._get}/accepted": self._on_document,
            f"{self._get}/rejected": self._on_get_refused,
            f"{self._update}/accepted": self._on_change,
            f"{self._update}/rejected": self._on_report_refused,
        }
        self.over_share: dict[str, int] | None = None
        self._desired: dict[str, Any] = {}
        self._rejected: dict[str, dict[str, Any]] = {}
        self._answers: dict[str, dict[str, Any]] = {}
        # What the shadow holds of ours, as far as known; None before it was fetched.
        self._reported: dict[str, Any] | None = None
        self._version = 0
        self._fetch_at: float | None = None
        self._report_at: float | None = None
        for topic_filter, handler in self._filters.items():
            uplink.subscribe(topic_filter, handler)
        uplink.on_connection(self._on_connection)

    def tick(self) -> None:
        """Fetch or report, if that is due and the way back is open."""
        now = self._clock.monotonic()
        if self._fetch_at is not None and now >= self._fetch_at:
            if all(self._uplink.subscribed(topic_filter) for topic_filter in self._filters):
                self._fetch_at = now + _AGAIN_S
                self._publish(self._get, b"")
        elif self._report_at is not None and self._reported is not None and now >= self._report_at:
            self._report_at = now + _AGAIN_S
            change = _difference(self._reported, self._state())
            if change:
                self._publish(self._update, json.dumps({"state": {"reported": change}}).encode())
            else:
                self._report_at = None

    def answer(self, name: str, command: Command, refusal: str | None) -> None:
        """Report what became of a command; the newest of each name counts."""
        outcome = ACCEPTED if refusal is None else _quoted(refusal)
        self._answers[name] = {"session": command.session, "seq": command.seq, "outcome": outcome}
        self._report_at = self._clock.monotonic()

    def _on_connection(self, connected: bool) -> None:  # noqa: FBT001 - the uplink's signature
        self._fetch_at = self._clock.monotonic() if connected else None
        self._reported = None

    def _on_document(self, message: Message) -> None:
        """The whole shadow: the answer to a fetch."""
        document = _read(message)
        if document is None:
            return
        self._fetch_at = None
        self._version = _version(document)
        state = document.get("state")
        state = state if isinstance(state, dict) else {}
        self._desired = _mapping(state.get("desired"))
        self._reported = _mapping(state.get("reported"))
        self._follow()

    def _on_get_refused(self, message: Message) -> None:
        document = _read(message) or {}
        if document.get("code") != _NOT_FOUND:
            _log.warning("the shadow %s cannot be fetched: %s", SHADOW, document.get("message"))
            return
        # Nobody has wished for anything yet; reporting makes the shadow.
        self._fetch_at, self._version = None, 0
        self._desired, self._reported = {}, {}
        self._follow()

    def _on_change(self, message: Message) -> None:
        """An accepted change, by the operator or by ourselves."""
        document = _read(message)
        if document is None or self._reported is None:
            return
        version = _version(document)
        if version <= self._version:
            return  # older than what we have
        if version > self._version + 1:
            self._fetch_at = self._clock.monotonic()
            return
        self._version = version
        state = document.get("state")
        state = state if isinstance(state, dict) else {}
        if "reported" in state:
            self._reported = _merged(self._reported, _mapping(state["reported"]))
        if "desired" in state:
            self._desired = _merged(self._desired, _mapping(state["desired"])) if state["desired"] else {}
        self._follow()

    def _on_report_refused(self, message: Message) -> None:
        document = _read(message) or {}
        _log.warning("the shadow %s refuses our report: %s", SHADOW, document.get("message"))

    def _follow(self) -> None:
        """Bring into force what is allowed of the wishes, and report."""
        self._hear(self._desired.get(OVER_SHARE))
        wishes = {name: value for name, value in self._desired.items() if name != OVER_SHARE}
        tuning, rejected = overlay(self._base, wishes, self._known_fields())
        for name, refusal in rejected.items():
            if self._rejected.get(name) != refusal:
                _log.warning("refused: %s", refusal["reason"])
        self._rejected = rejected
        if tuning != self.tuning:
            _log.info("now in force: %s", json.dumps(tuning.as_document()))
            self.tuning = tuning
            self._apply(tuning)
        self._report_at = self._clock.monotonic()

    def _hear(self, said: Any) -> None:
        """Note what the cloud says of the robot's share, and log it once."""
        said = _mapping(said)
        names = (PUT_OFF_SINCE_MS, PUT_OFF_LAST_MS, PUT_OFF)
        if not all(type(said.get(name)) is int and 0 <= said[name] < _MOST for name in names):
            return
        before, self.over_share = self.over_share, {name: said[name] for name in names}
        if before is None or before[PUT_OFF_SINCE_MS] != said[PUT_OFF_SINCE_MS]:
            _log.warning(
                "more is recorded than this robot's share of the cloud: summaries are made later, "
                "and nothing is lost"
            )

    def _state(self) -> dict[str, Any]:
        rejected = {
            name: {**refusal, "value": _quoted(refusal["value"])} for name, refusal in self._rejected.items()
        }
        return {
            **self.tuning.as_document(),
            "rejected": rejected,
            COMMANDS: dict(self._answers),
            AGENT_VERSION: self._agent_version,
        }

    def _publish(self, topic: str, payload: bytes) -> None:
        self._allowance.spend(topic, payload)
        self._uplink.publish(topic, payload, qos=1, done=_done)


def _done(error: UplinkError | None) -> None:
    """`tick` publishes again what was not answered."""
    if error is not None:
        _log.debug("shadow %s: %s", SHADOW, error)


def _read(message: Message) -> dict[str, Any] | None:
    try:
        document = json.loads(message.payload)
    except (ValueError, RecursionError):
        document = None
    if not isinstance(document, dict):
        _log.warning("shadow %s: a message that is no JSON object", SHADOW)
        return None
    return document


def _version(document: Mapping[str, Any]) -> int:
    version = document.get("version")
    return version if type(version) is int else 0


def _mapping(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _merged(old: Mapping[str, Any], change: Mapping[str, Any]) -> dict[str, Any]:
    """As the shadow merges: null removes, objects merge, everything else replaces."""
    new = dict(old)
    for key, value in change.items():
        if value is None:
            new.pop(key, None)
        elif isinstance(value, dict):
            new[key] = _merged(_mapping(new.get(key)), value)
        else:
            new[key] = value
    return new


def _difference(old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, Any]:
    """What to merge into the old to have the new."""
    change: dict[str, Any] = dict.fromkeys(old.keys() - new.keys())
    for key, value in new.items():
        if isinstance(value, dict) and isinstance(old.get(key), dict):
            inner = _difference(old[key], value)
            if inner:
                change[key] = inner
        elif old.get(key) != value and not (value == {} and key not in old):
            change[key] = value
    return change


def _quoted(value: Any) -> Any:
    text = json.dumps(value)
    return value if len(text) <= _MAX_VALUE_CHARS else text[:_MAX_VALUE_CHARS] + "..."
