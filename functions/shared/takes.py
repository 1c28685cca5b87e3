"""Has a robot keep what its ring has of the time of a finding, by a take in its shadow.

Only a robot that has a trigger on findings gets takes, and few of them: a run of the analysis may be of a
year's drives.
"""

from __future__ import annotations

import hashlib
import json
import logging
import time
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from botocore.exceptions import BotoCoreError, ClientError

from iort_contract.catalog.analysis import ANALYSIS_FAILED, DRIVES_WAIT, SERIOUS
from iort_contract.limits import ContractError
from iort_contract.messages.analysis import Finding
from iort_contract.messages.recorder import (
    FINDING,
    MAX_SPAN_S,
    MAX_TAKES,
    MAX_TOPICS,
    MAX_WHY,
    RECORDER,
    TAKES,
    Take,
    Trigger,
    check_room,
    decode_take,
    decode_trigger,
    encode_take,
)
from iort_contract.messages.shadow import decode_desired
from iort_contract.topics import SHADOW

if TYPE_CHECKING:
    from types_boto3_iot_data import IoTDataPlaneClient

_log = logging.getLogger(__name__)
# Takes of a robot in a run.
MOST = 3
BY = "analysis"
# An operator's take that is older has been done, or its robot is gone.
_OLD_US = 7 * 86_400 * 1_000_000
# They tell of the analysis, and not of a time in which something happened.
_ABOUT_THE_RUN = (ANALYSIS_FAILED, DRIVES_WAIT)


class Takes:
    """Writes takes into the robots' shadows."""

    def __init__(self, client: IoTDataPlaneClient) -> None:
        self._client = client

    def ask(self, robot: str, findings: Iterable[Finding]) -> int:
        """Have the robot keep the times of its new findings, the most serious and newest first; return how
        many. No finding fails because a shadow cannot be reached."""
        about = [one for one in findings if one.kind not in _ABOUT_THE_RUN]
        if not about:
            return 0
        try:
            change, takes = wanted(self._shadow(robot), about, time.time_ns() // 1000)
            if takes:
                payload = json.dumps({"state": {"desired": change}}, separators=(",", ":"))
                self._client.update_thing_shadow(thingName=robot, shadowName=SHADOW, payload=payload)
        except (BotoCoreError, ClientError) as error:
            _log.warning("%s keeps nothing of its findings: %s", robot, error)
            return 0
        return takes

    def _shadow(self, robot: str) -> Mapping[str, Any]:
        try:
            answer = self._client.get_thing_shadow(thingName=robot, shadowName=SHADOW)
        except self._client.exceptions.ResourceNotFoundException:
            return {}
        content: Mapping[str, Any] = json.loads(answer["payload"].read())
        return content


def wanted(
    document: Mapping[str, Any], findings: Sequence[Finding], now_us: int
) -> tuple[dict[str, Any], int]:
    """The change of the desired part for these findings, and its number of takes. Takes of earlier runs give
    way, an operator's do not."""
    recorder = decode_desired(document.get("state", {}).get("desired")).recorder
    triggers = list(_on_findings(recorder.triggers))
    if not triggers:
        return {}, 0
    kept, gone = dict[str, Any](), dict[str, Any]()
    for name, content in recorder.takes.items():
        (kept if _is_fresh(name, content, now_us) else gone)[name] = content
    newest = sorted(findings, key=lambda one: (one.severity == SERIOUS, one.to_us), reverse=True)
    takes = [_take(one, triggers) for one in newest[: max(0, min(MOST, MAX_TAKES - len(kept)))]]
    while takes:
        entries: dict[str, Any] = dict.fromkeys(gone)
        for take in takes:
            entries |= encode_take(take, {})[RECORDER][TAKES]
        try:
            return dict(check_room(recorder, {RECORDER: {TAKES: entries}})), len(takes)
        except ContractError:
            # The shadow has no room for so many.
            takes.pop()
    return {}, 0


def _on_findings(triggers: Mapping[str, Any]) -> Iterable[Trigger]:
    for name, content in triggers.items():
        try:
            trigger = decode_trigger(name, content)
        except ContractError:
            # The robot's answer says so.
            continue
        if trigger.on == FINDING and not trigger.notify:
            yield trigger


def _is_fresh(name: str, content: Any, now_us: int) -> bool:
    try:
        take = decode_take(name, content)
    except ContractError:
        return False
    return take.by != BY and take.to_us > now_us - _OLD_US


def _take(finding: Finding, triggers: Sequence[Trigger]) -> Take:
    """The time of a finding, and what the triggers want before and after it; of a long one its end, which the
    ring is likelier to have."""
    to_us = finding.to_us + max(one.after_us for one in triggers)
    from_us = finding.from_us - max(one.before_us for one in triggers)
    topics = {topic for one in triggers for topic in one.topics}
    if len(topics) > MAX_TOPICS or not all(one.topics for one in triggers):
        topics = set()
    return Take(
        hashlib.sha256(finding.id.encode()).hexdigest()[:16],
        max(0, from_us, to_us - int(MAX_SPAN_S * 1_000_000)),
        max(to_us, from_us + 1),
        BY,
        f"{finding.kind}: {finding.text}"[:MAX_WHY],
        tuple(sorted(topics)),
    )
