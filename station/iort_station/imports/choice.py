"""Which topics of a recording are imported, into which streams and how: as an agent's car.yaml says, or as
`iort-agent init` would choose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from iort_contract.catalog.streams import OWN_STREAMS
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.limits import ContractError
from iort_contract.recordings.rosbag import VESC_TYPE, is_ros_own, stream_for
from iort_contract.topics import check_stream, matches, stream_of
from iort_station.errors import UsageError

_ROS_SOURCES = ("ros1", "ros2", "rosbridge")
_UPLOAD = "upload"


class TopicChoice(NamedTuple):
    """How a topic is imported: its stream; the wanted ``fields``, None for whole messages; whether the time
    is that of ``arrival``; and whether large arrays become files (``upload``)."""

    stream: str
    fields: tuple[str, ...] | None = None
    arrival: bool = False
    upload: bool = False


@dataclass(frozen=True)
class Choice:
    """The topics to import. ``named`` are topics or patterns with their settings; None is every topic but
    ROS' own. ``only`` are patterns that a topic must fit, if there are some. A stream keeps at most one large
    content in ``large_every_s``."""

    named: Sequence[tuple[str, TopicChoice]] | None = None
    only: Sequence[str] = ()
    vesc_stream: str = VESC_STREAM
    # The stream of each topic of a VESC, where a source of recordings names no topics.
    vesc_only: bool = False
    upload: bool = False
    large_every_s: float = 1.0

    def of(self, there: Mapping[str, str]) -> tuple[dict[str, TopicChoice], dict[str, str]]:
        """The choice for each topic, of those that are ``there`` with their types; and why others are left
        out. Raises `UsageError` for a topic that the recording does not have."""
        chosen: dict[str, TopicChoice] = {}
        left_out: dict[str, str] = {}
        taken: dict[str, str] = {}
        for topic, kind in sorted(there.items()):
            one = self._one(topic, kind, taken)
            if self.only and not any(matches(pattern, topic) for pattern in self.only):
                left_out[topic] = "not chosen by --topic"
            elif isinstance(one, str):
                left_out[topic] = one
            else:
                chosen[topic] = one
                taken[one.stream] = topic
        lacking = [pattern for pattern in self.only if not any(matches(pattern, topic) for topic in there)]
        if lacking:
            listed = ", ".join(sorted(there)) or "none"
            raise UsageError(f"--topic {lacking[0]}: the recording has no such topic; it has {listed}")
        return chosen, left_out

    def _one(self, topic: str, kind: str, taken: Mapping[str, str]) -> TopicChoice | str:
        if self.named is not None:
            for pattern, choice in self.named:
                if topic == pattern or ("*" in pattern and matches(pattern, topic)):
                    return choice._replace(stream=choice.stream or stream_of(topic))
            return "not in the configuration"
        if self.vesc_only:
            is_vesc = kind.replace("/msg/", "/") == VESC_TYPE.replace("/msg/", "/")
            return TopicChoice(self.vesc_stream) if is_vesc else "not in the configuration"
        if is_ros_own(topic) and topic not in self.only:
            return "ROS' own"
        stream = stream_for(topic, kind, taken.keys())
        if stream in OWN_STREAMS:
            stream = f"topic-{stream}"
        try:
            check_stream(stream)
        except ContractError:
            return "its name is none of ROS': --config can name a stream for it"
        if stream in taken:
            return f"its stream {stream} is that of {taken[stream]}: --config can name another"
        return TopicChoice(stream, upload=self.upload)


def configured(file: Path, robot: str, only: Sequence[str]) -> Choice:
    """The choice of an agent's car.yaml. Raises `UsageError` for one of another robot, or without topics."""
    try:
        content: Any = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise UsageError(f"{file}: cannot be read: {error}") from error
    if not isinstance(content, dict) or not isinstance(content.get("sources"), list):
        raise UsageError(f"{file}: must be a car.yaml with a list of sources")
    if content.get("robot") not in {None, robot}:
        raise UsageError(f"{file}: is the configuration of {content['robot']}, and not of {robot}")
    files = content.get("files") or {}
    every_s = float(files.get("large_every_s", 1.0)) if isinstance(files, dict) else 1.0
    named: list[tuple[str, TopicChoice]] = []
    bags = [one for one in content["sources"] if isinstance(one, dict) and one.get("type") == "bag"]
    try:
        for source in content["sources"]:
            if isinstance(source, dict) and source.get("type") in {*_ROS_SOURCES, "bag"}:
                named += _topics(source)
    except (ContractError, TypeError, ValueError, AttributeError) as error:
        raise UsageError(f"{file}: sources: {error}") from error
    vesc_stream = str(bags[0].get("stream", VESC_STREAM)) if bags else VESC_STREAM
    if not named and not bags:
        raise UsageError(
            f"{file}: none of its sources has topics (type: {', '.join(_ROS_SOURCES)}, bag): leave out "
            "--config to import every topic"
        )
    upload = any(one.get("large") == _UPLOAD for one in bags)
    given = named or None
    return Choice(given, only, vesc_stream, vesc_only=given is None, upload=upload, large_every_s=every_s)


def _topics(source: Mapping[str, Any]) -> list[tuple[str, TopicChoice]]:
    topics, upload = source.get("topics"), source.get("large") == _UPLOAD
    found = []
    for topic, given in (topics or {}).items():
        if isinstance(given, str):
            found.append((topic, TopicChoice(check_stream(given), upload=upload)))
            continue
        settings = given or {}
        if settings.get("only") is not None:
            continue
        stream = settings.get("stream") or ("" if "*" in topic else stream_of(topic))
        fields = tuple(map(str, settings["fields"])) if settings.get("fields") else None
        large = upload or settings.get("large") == _UPLOAD
        arrival = settings.get("time") == "arrival"
        found.append((topic, TopicChoice(check_stream(stream) if stream else "", fields, arrival, large)))
    return found
