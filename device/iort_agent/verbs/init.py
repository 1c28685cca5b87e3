"""`iort-agent init`: looks at what the robot has, and writes the `sources` of car.yaml. It overwrites
nothing: if there is a car.yaml, the new one is written beside it.

A topic is recorded unless there is a reason against it, which is said.
"""

from __future__ import annotations

import re
import sys
from itertools import count
from pathlib import Path
from typing import Callable, Iterator, NamedTuple, Sequence

import yaml

from iort_agent.common.logs import neutral, set_up
from iort_agent.common.schema import read_yaml
from iort_agent.common.threads import Clock, SystemClock
from iort_agent.errors import ConfigError, SourceError
from iort_agent.mqtt.rate_limiter import BYTES_PER_S
from iort_agent.sources import OK, UPLOAD
from iort_agent.sources.intake import ARRIVAL, HEADER
from iort_agent.sources.ros import ros_name
from iort_agent.sources.ros2 import Ros2Config
from iort_agent.verbs.survey import (
    LARGE,
    LOOK_S,
    Found,
    Polls,
    Reasons,
    Ros,
    Topic,
    Vesc,
    graphs,
    listen,
    ports,
)
from iort_agent.video import EXTRA
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.limits import ContractError
from iort_contract.recordings.rosbag import is_ros_own, stream_for
from iort_contract.topics import matches

_DEBUG = re.compile(r".*debug.*", re.IGNORECASE)
# Types whose messages are large, also when none came.
_PICTURES = re.compile(r"sensor_msgs/(msg/)?((Compressed)?Image|PointCloud2)|.*/(msg/)?CompressedImage")
# Whose messages the camera of a driver takes.
_CAMERAS = re.compile(r"sensor_msgs/(msg/)?(Compressed)?Image")
_VIDEO = re.compile(r"^(# )?video: \{source: \{type: topic|^video\s*:", re.MULTILINE)
_TYPE = re.compile(r"(\btype:\s*[\"']?[A-Za-z]\w*)/(msg/)?([A-Za-z]\w*)", re.ASCII)
# A key at the beginning of a line, and what is indented below it or is an item of its list.
_SOURCES = re.compile(r"^sources[ \t]*:.*\n(?:(?:(?:#.*)?\n)*[ \t-].*\n)*", re.MULTILINE)
_HEAD = "# time: header is when it was measured, arrival when it came. The streams' names are free.\nsources:"
_ALONE = "# robot, endpoint, certificate and private_key are in the car.yaml of the robot's bundle."
_FOLDER = "large"
# A VESC answers at once, or never.
_POLL_S = 2.0


class Line(NamedTuple):
    """A topic, and what is to be done with it; ``left_out`` is why it is not recorded, or empty."""

    topic: Topic
    stream: str
    large: bool
    left_out: str

    def settings(self) -> str:
        """As car.yaml has them."""
        time = HEADER if self.topic.stamped else ARRIVAL
        large = f", large: {UPLOAD}" if self.large else ""
        # YAML reads on and null otherwise.
        stream = self.stream if yaml.safe_load(self.stream) == self.stream else f'"{self.stream}"'
        return f"{{stream: {stream}, time: {time}{large}}}"

    def comes(self) -> str:
        """How often it comes, and how large."""
        topic = self.topic
        if not topic.messages:
            return "silent" if topic.published else "nobody publishes it"
        rate = "once" if topic.rate_hz is None else f"{topic.rate_hz:.3g} Hz"
        return f"{rate}, {topic.size:,} bytes"


def plan(ros: Ros | None, *, every: bool, wanted: Sequence[str], taken: set[str]) -> Sequence[Line]:
    """What to do with each topic: ``wanted`` are patterns, and ``taken`` the names of streams, which grows.

    Raises `SourceError` for a pattern without a topic.
    """
    topics = ros.topics if ros is not None else ()
    for pattern in wanted:
        if not any(matches(pattern, topic.name) for topic in topics):
            raise SourceError(f"--topic {pattern}: the graph has no such topic")
    lines = []
    for topic in topics:
        kind, large = topic.kinds[0], _is_large(topic)
        left_out = _why_not(topic, large=large)
        if wanted:
            chosen = any(matches(pattern, topic.name) for pattern in wanted)
            left_out = "" if chosen else left_out or "not chosen by --topic"
        elif every:
            left_out = ""
        left_out = left_out or _cannot(topic, ros)
        stream = stream_for(topic.name, kind, taken)
        if not left_out:
            taken.add(stream)
        lines.append(Line(topic, stream, large, left_out))
    return lines


def _is_large(topic: Topic) -> bool:
    picture = _PICTURES.fullmatch(topic.kinds[0]) is not None
    return (topic.blobs and topic.size >= LARGE) or (picture and (topic.blobs or not topic.messages))


def _cannot(topic: Topic, ros: Ros | None) -> str:
    try:
        ros_name(topic.name)
    except ContractError as error:
        return str(error)
    if len(topic.kinds) > 1:
        return f"several types: {', '.join(topic.kinds)}"
    # ROS 1's publishers tell their definitions.
    return "" if topic.known or ros is None or ros.version == 1 else "its package is not sourced here"


def _why_not(topic: Topic, *, large: bool) -> str:
    if is_ros_own(topic.name):
        return "ROS' own"
    if _DEBUG.fullmatch(topic.name):
        return "for debugging"
    if not topic.published:
        return "nobody publishes it"
    if large:
        return f"large: --topic {topic.name} sends it as files"
    if (topic.rate_hz or 0) * topic.size > BYTES_PER_S:
        return f"more than the {BYTES_PER_S // 1024} KB a second of a connection"
    return ""


def table(lines: Sequence[Line]) -> Iterator[str]:
    """The topics for a person."""
    rows = [("topic", "type", "rate, size", "stream")] if lines else []
    for line in lines:
        stream = f"- {line.left_out}" if line.left_out else line.stream
        rows.append((line.topic.name, ", ".join(line.topic.kinds), line.comes(), stream))
    widths = [max(len(row[i]) for row in rows) if rows else 0 for i in range(3)]
    for row in rows:
        yield neutral("  ".join([*(text.ljust(width) for text, width in zip(row, widths)), row[3]]))


def sources(title: str, version: int, lines: Sequence[Line], vescs: Sequence[Vesc], taken: set[str]) -> str:
    """The section `sources`, with a comment a line. Empty if there is nothing to record."""
    text = []
    if not all(line.left_out for line in lines):
        text = [f"- type: ros{version}  # {title}", "  topics:"]
        # Those that are left out come last.
        for line in sorted(lines, key=lambda line: bool(line.left_out)):
            begin, end = ("# ", f"; {line.left_out}") if line.left_out else ("", "")
            about = f"{line.topic.kinds[0]}, {line.comes()}{end}"
            text.append(neutral(f"    {begin}{line.topic.name}: {line.settings()}  # {about}"))
    for vesc in vescs:
        if vesc.samples:
            names = (VESC_STREAM if n == 1 else f"{VESC_STREAM}-{n}" for n in count(1))
            stream = next(name for name in names if name not in taken)
            taken.add(stream)
            text.append(
                f"- {{type: vesc, port: {vesc.port}, stream: {stream}, rate_hz: 50}}  # a VESC answered"
            )
    return "\n".join([_HEAD, *text, ""]) if text else ""


def beside(file: Path, section: str, version: int) -> str:
    """The text of a configuration with other sources, and everything else as it is. The types of its commands
    take the form of the ROS, 1 or 2, or 0 for none. Raises `ConfigError` if its text cannot be changed."""
    text = file.read_text(encoding="utf-8").rstrip("\n") + "\n"
    before = read_yaml(file) or {}
    if not isinstance(before, dict):
        raise ConfigError(f"{file}: must be a mapping")
    rest = _SOURCES.sub("", text)
    if version:
        rest = _TYPE.sub(r"\1/msg/\3" if version == 2 else r"\1/\3", rest)
    whole = f"{rest.strip()}\n\n{section}"
    try:
        kept = {*before} - {"sources"}
        good = {*(yaml.safe_load(rest) or ())} == kept and {*yaml.safe_load(whole)} >= kept
    except yaml.YAMLError:
        good = False
    if not good:
        raise ConfigError(f"{file}: cannot be rewritten; put this into it by hand:\n{section}")
    return whole


class Seams(NamedTuple):
    """What a test replaces."""

    clock: Clock = SystemClock()
    graphs: Callable[[Clock, Reasons], Iterator[Found]] = graphs
    ports: Callable[[], Iterator[str]] = ports


SEAMS = Seams()


def init(out: Path, *, every: bool, wanted: Sequence[str], listen_s: float, seams: Seams = SEAMS) -> Path:
    """Look, print what is there, and write the file, whose path is returned. Raises `SourceError` if there is
    nothing to record, and `ConfigError` if the file cannot be written."""
    target = out.with_name(f"{out.stem}.new{out.suffix}") if out.exists() else out
    if target.exists():
        raise ConfigError(f"{target}: exists already: move it, or name another file with --out")
    set_up("warning")
    clock = seams.clock
    reasons: Reasons = []
    polls = [Polls(port, clock) for port in seams.ports()]
    found: list[Ros] = []
    for version, title, node in seams.graphs(clock, reasons):
        print(f"{title}: listening for {listen_s:g} s", file=sys.stderr)
        try:
            found.append(Ros(version, title, listen(node, clock, listen_s, _show)))
        finally:
            node.close()
    # A machine may have both ROS: the one with more topics is the robot's.
    graph = max(found, key=lambda ros: sum(not is_ros_own(one.name) for one in ros.topics), default=None)
    vescs = [poll.end(min(_POLL_S, listen_s)) for poll in polls]
    taken: set[str] = set()
    lines = plan(graph, every=every, wanted=wanted, taken=taken)
    rows = [*table(lines), *(f"{vesc.port}: {vesc.why or 'a VESC answers'}" for vesc in vescs)]
    version, title = (graph.version, graph.title) if graph is not None and lines else (0, "")
    section = sources(title, version, lines, vescs, taken)
    if not section:
        print("\n".join(rows))
        raise SourceError("; ".join(["nothing to record", *reasons]))
    if any(line.large and not line.left_out for line in lines):
        section += _files(out)
    section += _camera(out, lines)
    text = f"{_ALONE}\n{section}" if target == out else beside(out, section, version)
    with target.open("x", encoding="utf-8") as file:
        file.write(text)
    print("\n".join(rows))
    if version == 2 and not any(line.topic.messages for line in lines):
        # Perhaps none comes, whatever is published.
        why = [one for one in Ros2Config(topics=()).check("") if one.level != OK]
        print("no message came", *(f"{one.text}: {one.todo}" for one in why), sep="; ", file=sys.stderr)
    return target


def _files(out: Path) -> str:
    """The section for the contents of large messages, unless the configuration has it. Raises `ConfigError`
    if it has half of it."""
    files = (read_yaml(out) or {}).get("files") if out.exists() else None
    if files is None:
        return f"files: {{large_folder: {_FOLDER}}}  # where the contents of `large: upload` wait\n"
    if "large_folder" not in files:
        raise ConfigError(f"{out}: files.large_folder: set it first: contents of large topics wait there")
    return ""


def _camera(out: Path, lines: Sequence[Line]) -> str:
    """A hint at the section `video`, with the camera that sends least; none if the file has the section."""
    before = out.read_text(encoding="utf-8") if out.exists() else ""
    cameras = [
        line.topic for line in lines if line.topic.published and _CAMERAS.fullmatch(line.topic.kinds[0])
    ]
    if not cameras or _VIDEO.search(before):
        return ""
    least = min(cameras, key=lambda topic: (not topic.messages, topic.size))
    hint = f"# video: {{source: {{type: topic, topic: {least.name}}}}}"
    return neutral(f"{hint}  # to drive by sight: pip install '{EXTRA}'") + "\n"


def _show(left_s: float, topics: int, messages: int) -> None:
    """Overwrite a line on a terminal."""
    if sys.stderr.isatty():
        end = "\n" if left_s < LOOK_S else ""
        print(f"\r{left_s:4.1f} s, {topics} topics, {messages:,} messages ", end=end, file=sys.stderr)
