"""The named shadow `agent`: the operator's desired settings come in, the settings in force go out.

The desired settings overlay the configuration file. A removed one (null) restores the file's value, and a
rejected one leaves the value in force. The agent fetches the whole shadow after every connect and after a
missed change, and follows every accepted change in between. It does not use deltas: a desired value that
equals the reported one makes no delta, although it may end a rejection."""

from __future__ import annotations

import dataclasses
import json
import logging
import math
import threading
from pathlib import Path
from typing import Any, Callable, Iterable, Mapping, Protocol

from iort_agent.common.schema import Place, allowed, did_you_mean, items, text
from iort_agent.errors import ConfigError, UplinkError
from iort_agent.lanes import RuntimeSettings
from iort_agent.mqtt.uplink import Link, MqttMessage
from iort_contract.checks import check_field, json_object
from iort_contract.limits import ContractError
from iort_contract.messages.commands import NO_MOTION, Command, DriveLimits
from iort_contract.messages.recorder import Wanted
from iort_contract.messages.shadow import (
    CHANGEABLE,
    FIELD_LIST,
    FIELDS,
    MOTION_STOPPED,
    SETTINGS,
    Outcome,
    OverShare,
    Rejection,
    Reported,
    decode_desired,
    encode_reported,
)
from iort_contract.messages.video import VideoTerms
from iort_contract.topics import ACCEPTED, SHADOW, check_stream

_PLACE = Place(Path("shadow agent"))
_FIELD_LIST = items(text(check_field), what=FIELD_LIST)
_log = logging.getLogger(__name__)

# Between two reports, and between two fetches: no motion passes before the first has been answered.
_AGAIN_S, _FETCH_AGAIN_S = 30.0, 5.0
# AWS limits a shadow document to 8 KB. A rejected value is quoted up to this length.
_MAX_VALUE_CHARS = 200
_MAX_ANSWERS = 16
_NOT_FOUND = 404


def overlay(
    base: RuntimeSettings,
    in_force: RuntimeSettings,
    desired: Mapping[str, Any],
    known_fields: Mapping[str, Iterable[str]],
    *,
    moves: bool = True,
) -> tuple[RuntimeSettings, dict[str, Rejection]]:
    """The base with the desired settings, and the rejected ones by name; these keep what is ``in_force``.

    ``known_fields`` holds the fields of the streams seen so far; only these can be selected. A robot that no
    command ``moves`` must not seem to be stopped. Only an explicit value ends an emergency stop, because a
    shadow may be deleted, or lost with its cloud. The file's own stop is the file's alone to end: whoever
    wrote it stands beside the robot.
    """
    values: dict[str, Any] = {"motion_stopped": in_force.motion_stopped}
    fields = dict(base.fields)
    rejected: dict[str, Rejection] = {}
    for name, value in desired.items():
        stream = name[len(FIELDS) + 1 :] if name.startswith(f"{FIELDS}.") else None
        attribute = name.replace(".", "_")
        try:
            if stream is not None:
                names = _selection(stream, value, known_fields.get(stream))
                if names:
                    fields[stream] = names
            elif name in SETTINGS:
                values[attribute] = allowed(SETTINGS[name])(value, _PLACE.child(name))
                if name == MOTION_STOPPED and value and not moves:
                    raise _PLACE.child(name).problem(NO_MOTION)
                if name == MOTION_STOPPED and not value and base.motion_stopped:
                    raise _PLACE.child(name).problem(
                        "car.yaml has motion: {stopped: true}; change it on the robot, and restart the agent"
                    )
            else:
                hint = did_you_mean(name, CHANGEABLE)
                raise _PLACE.child(name).problem(
                    f"cannot be changed{hint}; must be one of {', '.join(CHANGEABLE)}"
                )
        except ConfigError as error:
            rejected[name] = Rejection(value, str(error))
            if stream is not None:
                fields.update({stream: in_force.fields[stream]} if stream in in_force.fields else {})
            elif name in SETTINGS:
                values[attribute] = getattr(in_force, attribute)
    return dataclasses.replace(base, fields=fields, **values), rejected


def _selection(stream: str, value: Any, known: Iterable[str] | None) -> tuple[str, ...]:
    place = _PLACE.child(FIELDS).child(stream)
    text(check_stream)(stream, place)
    names: tuple[str, ...] = _FIELD_LIST(value, place)
    for name in names if known is not None else ():
        if name not in (known or ()):
            raise place.problem(f"the stream {stream} has no field {name}{did_you_mean(name, known or ())}")
    return names


class Recorder(Protocol):
    """What keeps incidents, as the shadow sees it: it is told what is wanted, and answers later."""

    answers: Mapping[str, str]

    def want(self, wanted: Wanted) -> None: ...


NO_RECORDER = "the robot has no recorder: car.yaml has no section recorder"


class Shadow:
    """Follows the shadow and reports there. The ticker calls `tick`, the uplink all else. ``over_share`` is
    the cloud's last report of batches that it put off. ``in_force`` are the
    settings until the shadow is known, if not the file's. ``drive`` and ``moves`` are reported: what a stick
    drives, and whether the robot has a motion that can be stopped. ``no_recorder`` is the answer to triggers
    without a recorder. ``video`` is what the camera can show."""

    def __init__(
        self,
        link: Link,
        *,
        base: RuntimeSettings,
        in_force: RuntimeSettings | None = None,
        apply: Callable[[RuntimeSettings], None],
        known_fields: Callable[[], Mapping[str, Any]],
        version: str,
        drive: DriveLimits | None = None,
        moves: bool = False,
        recorder: Recorder | None = None,
        no_recorder: str = NO_RECORDER,
        video: VideoTerms | None = None,
    ) -> None:
        self._recorder, self._no_recorder = recorder, no_recorder
        self._base, self.settings = base, in_force or base
        self._apply = apply
        self._known_fields = known_fields
        self._agent_version, self._drive, self._moves = version, drive, moves
        self._video = video
        self._link, self._uplink, self._clock = link, link.uplink, link.clock
        prefix = f"$aws/things/{link.robot}/shadow/name/{SHADOW}"
        self._get, self._update = f"{prefix}/get", f"{prefix}/update"
        self._filters = {
            f"{self._get}/accepted": self._on_document,
            f"{self._get}/rejected": self._on_get_rejected,
            f"{self._update}/accepted": self._on_change,
            f"{self._update}/rejected": self._on_report_rejected,
        }
        self.over_share: OverShare | None = None
        self._desired: dict[str, Any] = {}
        self._rejected: dict[str, Rejection] = {}
        self._wanted = Wanted()
        self._answers: dict[str, Outcome] = {}
        # The reported part of the shadow, as far as known; None before it was fetched.
        self._reported: dict[str, Any] | None = None
        # The version that is followed, and the newest one that was heard of on this connection.
        self._version = self._newest = 0
        self._fetch_at: float | None = None
        # Whether the state may have changed since the last report; any thread sets it, the ticker clears it.
        self._news = False
        # Set with it: the ticker, which clears it, waits no longer. An emergency stop's word is such news.
        self.changed = threading.Event()
        # When the ticker repeats a report that is not confirmed.
        self._again_at = math.inf
        for topic_filter, handler in self._filters.items():
            self._uplink.subscribe(topic_filter, handler)
        self._uplink.on_connection(self._on_connection)

    def tick(self) -> None:
        """Fetch or report, if that is due and the answer can come back."""
        now = self._clock.monotonic()
        if self._fetch_at is not None and now >= self._fetch_at:
            if all(self._uplink.subscribed(topic_filter) for topic_filter in self._filters):
                self._fetch_at = now + _FETCH_AGAIN_S
                self._publish(self._get, b"")
        elif (self._news or now >= self._again_at) and (reported := self._reported) is not None:
            # Before the state is read: whatever another thread changes from here on is news again.
            self._news = False
            change = _difference(reported, self._state())
            self._again_at = now + _AGAIN_S if change else math.inf
            if change:
                self._publish(self._update, json.dumps({"state": {"reported": change}}).encode())

    def fetching(self) -> bool:
        """Whether the shadow is to be fetched, or its answer is awaited."""
        return self._fetch_at is not None

    def known(self) -> bool:
        """Whether the operator's settings are known: fetched on this connection, and no change was missed."""
        return self._reported is not None and self._fetch_at is None

    def answer(self, name: str, command: Command, rejection: str | None) -> None:
        """Report the outcome of a command; only the newest of each name is kept, and of
        some names only."""
        outcome = ACCEPTED if rejection is None else _quoted(rejection)
        self._answers.pop(name, None)
        while len(self._answers) >= _MAX_ANSWERS:
            # Names that nobody has given the robot must not fill the shadow.
            del self._answers[next(iter(self._answers))]
        self._answers[name] = Outcome(command.session, command.seq, outcome)
        self.tell()

    def tell(self) -> None:
        """Report soon: an answer has changed. From any thread."""
        self._news = True
        self.changed.set()

    def _on_connection(self, connected: bool) -> None:  # noqa: FBT001 - the uplink's signature
        self._fetch_at = self._clock.monotonic() if connected else None
        self._reported = None
        self._newest = 0

    def _on_document(self, message: MqttMessage) -> None:
        """Take the whole shadow, the answer to a fetch."""
        document = _read(message)
        if document is None:
            return
        version = _version(document)
        if version < self._newest:
            # A change has overtaken it.
            self._fetch_at = self._clock.monotonic()
            return
        self._fetch_at, self._version = None, version
        state = _mapping(document.get("state"))
        self._desired = _mapping(state.get("desired"))
        self._reported = _mapping(state.get("reported"))
        self._follow()

    def _on_get_rejected(self, message: MqttMessage) -> None:
        document = _read(message) or {}
        if document.get("code") != _NOT_FOUND:
            _log.warning("the shadow %s cannot be fetched: %s", SHADOW, document.get("message"))
            return
        if self._newest:
            # It was made meanwhile.
            self._fetch_at = self._clock.monotonic()
            return
        # There is no shadow yet; the first report creates it.
        self._fetch_at, self._version = None, 0
        self._desired, self._reported = {}, {}
        self._follow()

    def _on_change(self, message: MqttMessage) -> None:
        """Take an accepted change, by the operator or by ourselves."""
        document = _read(message)
        if document is None:
            return
        version = _version(document)
        # AWS counts on for 48 hours after a shadow was deleted, and then from 0.
        anew = self._reported is not None and version <= self._version
        self._newest = version if anew else max(self._newest, version)
        if self._reported is None:
            return
        if version != self._version + 1:
            # A change was missed, or this one came late.
            self._fetch_at = self._clock.monotonic()
            return
        self._version = version
        state = _mapping(document.get("state"))
        if "reported" in state:
            self._reported = _merged(self._reported, _mapping(state["reported"]))
        if "desired" in state:
            self._desired = _merged(self._desired, _mapping(state["desired"])) if state["desired"] else {}
        self._follow()

    def _on_report_rejected(self, message: MqttMessage) -> None:
        document = _read(message) or {}
        _log.warning("the shadow %s rejects our report: %s", SHADOW, document.get("message"))

    def _follow(self) -> None:
        """Apply the desired settings that are allowed, and report."""
        desired = decode_desired(self._desired)
        if desired.over_share is not None:
            self._note_over_share(desired.over_share)
        self._wanted = desired.recorder
        if self._recorder is not None:
            self._recorder.want(desired.recorder)
        settings, rejected = overlay(
            self._base, self.settings, desired.settings, self._known_fields(), moves=self._moves
        )
        for name, rejection in rejected.items():
            if self._rejected.get(name) != rejection:
                _log.warning("rejected: %s", rejection.reason)
        self._rejected = rejected
        if settings != self.settings:
            _log.info("now in force: %s", json.dumps(settings.by_name()))
            self.settings = settings
            self._apply(settings)
        self.tell()

    def _note_over_share(self, over_share: OverShare) -> None:
        """Note that the cloud put off batches, and log it once."""
        before, self.over_share = self.over_share, over_share
        if before is None or before.since_ms != over_share.since_ms:
            _log.warning(
                "more is recorded than this robot's share of the cloud: summaries are made later, "
                "and nothing is lost"
            )

    def _state(self) -> dict[str, Any]:
        rejected = {
            name: rejection._replace(value=_quoted(rejection.value))
            for name, rejection in self._rejected.items()
        }
        recorder, wanted = self._recorder, self._wanted.triggers
        return encode_reported(
            Reported(
                self.settings.by_name(),
                rejected,
                dict(self._answers),
                self._agent_version,
                self._drive,
                self._moves,
                recorder.answers if recorder is not None else dict.fromkeys(wanted, self._no_recorder),
                self._video,
            )
        )

    def _publish(self, topic: str, payload: bytes) -> None:
        self._link.publish(topic, payload, qos=1, done=_log_error)


def _log_error(error: UplinkError | None) -> None:
    """`tick` repeats a publish without an answer."""
    if error is not None:
        _log.debug("shadow %s: %s", SHADOW, error)


def _read(message: MqttMessage) -> dict[str, Any] | None:
    try:
        return json_object(message.payload, "a message")
    except ContractError as error:
        _log.warning("shadow %s: %s", SHADOW, error)
        return None


def _version(document: Mapping[str, Any]) -> int:
    version = document.get("version")
    return version if type(version) is int else 0


def _mapping(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _merged(old: Mapping[str, Any], change: Mapping[str, Any]) -> dict[str, Any]:
    """Merge as the shadow does: null removes, objects merge, everything else replaces."""
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
    """The change that merges the old into the new."""
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
