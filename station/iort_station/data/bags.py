"""Writes recordings for other tools: MCAP, which Foxglove opens, ROS 1 bags, which `rosbag play` plays, and
folders of ROS 2, which `ros2 bag play` plays, as it does an MCAP of ROS 2."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import NamedTuple, Protocol

from mcap.writer import Writer as McapWriter
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as FolderWriter
from rosbags.rosbag2.metadata import dump_qos_v8

from iort_contract.ros.message import MessageType
from iort_station.data.ros_forms import Form, form_of, from_ros2
from iort_station.errors import StationError
from iort_station.output import whole, whole_folder

Write = Callable[[int, bytes], None]


class Topic(NamedTuple):
    """A topic's messages of one type in a file. ``write`` takes the time in nanoseconds since the epoch and
    a message as it was recorded, and raises `ConversionError`; ``form`` is what the file has of it."""

    write: Write
    form: Form


class Recording(Protocol):
    """A file of messages."""

    def topic(self, kind: MessageType) -> Topic:
        """Begin a topic's messages of one type. Raises `StationError` for a type that the file cannot
        hold."""


class _File(ABC):
    def __init__(self, *, ros2: bool | None) -> None:
        self._ros2 = ros2
        self._begun: dict[tuple[str, str, str], Write] = {}

    def topic(self, kind: MessageType) -> Topic:
        form = form_of(kind, ros2=from_ros2(kind) if self._ros2 is None else self._ros2)
        named = (kind.topic, form.kind, form.md5sum)
        if named not in self._begun:
            try:
                self._begun[named] = self._begin(kind.topic, form)
            except StationError:
                raise
            except Exception as error:  # a bag library may raise anything
                raise StationError(
                    f"topic {kind.topic} of type {form.kind} cannot be written: {error}"
                ) from error
        write = self._begun[named]
        return Topic(lambda t_ns, message: write(t_ns, form.convert(message)), form)

    @abstractmethod
    def _begin(self, topic: str, form: Form) -> Write:
        """Begin a topic's messages of one type."""


class _Bag(_File):
    def __init__(self, writer: BagWriter) -> None:
        super().__init__(ros2=False)
        self._writer = writer

    def _begin(self, topic: str, form: Form) -> Write:
        connection = self._writer.add_connection(
            topic,
            form.kind.replace("/", "/msg/"),
            msgdef=form.definition,
            md5sum=form.md5sum,
            # A bag tells two types of one topic apart by their publishers.
            callerid="/iort" if not self._begun else f"/iort_{len(self._begun)}",
        )
        return lambda t_ns, message: self._writer.write(connection, t_ns, message)


class _Mcap(_File):
    def __init__(self, writer: McapWriter, *, ros2: bool) -> None:
        super().__init__(ros2=True if ros2 else None)
        self._writer = writer
        self._sequence = 0
        self.profiles: set[str] = set()

    def _begin(self, topic: str, form: Form) -> Write:
        self.profiles.add("ros2" if form.ros2 else "ros1")
        schema = self._writer.register_schema(
            form.kind, "ros2msg" if form.ros2 else "ros1msg", form.definition.encode()
        )
        if form.ros2:
            about = {"offered_qos_profiles": dump_qos_v8(_qos(topic)), "topic_type_hash": form.md5sum}
        else:
            about = {"md5sum": form.md5sum, "callerid": "/iort"}
        channel = self._writer.register_channel(topic, "cdr" if form.ros2 else "ros1", schema, about)

        def write(t_ns: int, message: bytes) -> None:
            self._writer.add_message(channel, t_ns, message, t_ns, self._sequence)
            self._sequence += 1

        return write


class _Folder(_File):
    def __init__(self, writer: FolderWriter) -> None:
        super().__init__(ros2=True)
        self._writer = writer
        self._kinds: dict[str, str] = {}
        self._hashes: dict[str, str] = {}

    def _begin(self, topic: str, form: Form) -> Write:
        # The player opens a publisher for each topic, and the file has a definition for each type's name.
        if self._kinds.setdefault(topic, form.kind) != form.kind:
            problem = f"{topic} has messages of {self._kinds[topic]} and {form.kind}"
        elif self._hashes.setdefault(form.kind, form.md5sum) != form.md5sum:
            problem = f"{form.kind} has two definitions in this range"
        else:
            connection = self._writer.add_connection(
                topic,
                form.kind,
                msgdef=form.definition,
                rihs01=form.md5sum,
                offered_qos_profiles=_qos(topic),
            )
            return lambda t_ns, message: self._writer.write(connection, t_ns, message)
        raise StationError(f"{problem}, which a folder of ROS 2 cannot hold: an .mcap can")


# Topics whose last messages a subscriber gets that comes later. Others may subscribe to them as to any.
_LATCHED = ("map", "map_metadata", "robot_description", "tf_static")
_UNLIMITED = QosTime(2147483647, 4294967295)


def _qos(topic: str) -> list[Qos]:
    """What a player offers, so that every subscriber of the robot's gets the messages."""
    latched = topic.rpartition("/")[2] in _LATCHED
    return [
        Qos(
            QosHistory.KEEP_LAST,
            10,
            QosReliability.RELIABLE,
            QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
            _UNLIMITED,
            _UNLIMITED,
            QosLiveliness.AUTOMATIC,
            _UNLIMITED,
            avoid_ros_namespace_conventions=False,
        )
    ]


@contextmanager
def bag(path: Path, *, force: bool = False) -> Iterator[Recording]:
    """A new ROS 1 bag, which appears once it is whole. Raises `StationError` if the file exists."""
    with whole(path, force=force) as part, BagWriter(part) as writer:
        yield _Bag(writer)


@contextmanager
def mcap(path: Path, *, force: bool = False, ros2: bool = False) -> Iterator[Recording]:
    """A new MCAP file, which appears once it is whole; with ``ros2``, of ROS 2's messages alone. Raises
    `StationError` if the file exists."""
    with whole(path, force=force) as part, part.open("wb") as file:
        writer = McapWriter(file)
        _start(writer, "")
        recording = _Mcap(writer, ros2=ros2)
        yield recording
        writer.finish()
        # Some readers of ROS 2 insist on its profile; a file of both has none.
        profiles, head = recording.profiles, BytesIO()
        _start(McapWriter(head), profiles.pop() if len(profiles) == 1 else "")
        file.seek(0)
        file.write(head.getvalue())


def _start(writer: McapWriter, profile: str) -> None:
    """Write the head of a file, of the same length for every profile."""
    writer.start(profile=profile, library="iort".ljust(len("iortros2") - len(profile)))


@contextmanager
def folder(path: Path, *, force: bool = False) -> Iterator[Recording]:
    """A new folder of ROS 2 with an SQLite database, which appears once it is whole. Raises `StationError` if
    it exists; with ``force``, if it is something else than such a folder."""
    # Humble reads this version, as all after it do.
    with (
        whole_folder(path, "metadata.yaml", "recording of ROS 2", force=force) as part,
        FolderWriter(part, version=8, storage_plugin=StoragePlugin.SQLITE3) as writer,
    ):
        yield _Folder(writer)


KINDS = {".bag": bag, ".mcap": mcap, "": folder}
