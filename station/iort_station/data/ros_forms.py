"""A type of messages in the form of either ROS, and its messages converted to it, by the package rosbags."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

from rosbags.convert.converter import STATIC_MSGTYPE_RENAMES, is_same_wireformat, migrate_bytes
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from iort_contract.limits import MessageError
from iort_contract.ros.definition import is_ros2, parse
from iort_contract.ros.definition import md5sum as md5sum_of
from iort_contract.ros.message import ROS2, MessageType
from iort_station.errors import StationError

_HEADER = "std_msgs/msg/Header"
# Each ROS has its own of these: a header with a seq or without, and times that are messages or not.
_OF_EACH = (_HEADER, "builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
_EMPTY = "std_msgs/msg/Empty"
# ROS 2 may bound a text or an array, which changes nothing in its bytes.
_BOUND = re.compile(r"(?<=string)<=\d+|(?<=\[)<=\d+(?=\])")
_CHAR = re.compile(r"^\s*char\b", re.MULTILINE)
_LITTLE_ENDIAN, _CDR_START = b"\0\1", 4


class ConversionError(StationError):
    """A message does not fit its type."""


class Form(NamedTuple):
    """A type as a file has it: ``md5sum`` is the MD5 of ROS 1 or the hash of ROS 2. ``convert`` makes the
    file's messages of the recorded ones and raises `ConversionError`; ``note`` says to a person what it
    does."""

    kind: str
    definition: str
    md5sum: str
    ros2: bool
    note: str
    convert: Callable[[bytes], bytes] = bytes


def from_ros2(kind: MessageType) -> bool:
    """Whether the messages are ROS 2's, or were before they were recorded."""
    return is_ros2(kind.kind) or kind.converted_from == ROS2


def form_of(kind: MessageType, *, ros2: bool, own: bool = False) -> Form:
    """The type in the form of one ROS.

    A type that both have, such as ``sensor_msgs/CameraInfo``, becomes the other's of that name; with ``own``
    it keeps its fields. Raises `StationError` for a definition that is invalid or that the other ROS cannot
    have.
    """
    if is_ros2(kind.kind) != ros2:
        try:
            return _converted(kind, ros2=ros2, own=own or kind.converted_from == ROS2)
        except Exception as error:  # a bag library may raise anything
            problem = f"the type {kind.kind} cannot be written as one of ROS {2 if ros2 else 1}: {error}"
            raise StationError(f"{problem}; an .mcap has it as it is") from error
    note = "as they were published"
    if kind.converted_from == ROS2:
        note = "of ROS 2, converted to ROS 1 when they were recorded"
    md5sum = _type_hash(kind) if ros2 else kind.md5sum or _checksum(kind)
    return Form(kind.kind, kind.definition, md5sum, ros2, note)


def _checksum(kind: MessageType) -> str:
    """ROS 1's MD5 of a definition. Raises `StationError` if the definition is invalid."""
    try:
        return md5sum_of(parse(kind.kind, kind.definition), kind.definition)
    except (MessageError, KeyError, ValueError) as error:
        raise StationError(f"the type {kind.kind} cannot be read: {error}") from error


def _type_hash(kind: MessageType) -> str:
    """ROS 2's hash of a type, which Humble does not have; of a type that the library cannot read, ours."""
    if kind.md5sum.startswith("RIHS01_"):
        return kind.md5sum
    try:
        # ROS 2 hashes a char as what it is; the library does not.
        types = get_types_from_msg(_CHAR.sub("uint8", kind.definition), kind.kind)
        return str(_store(types).hash_rihs01(kind.kind))
    except Exception:  # noqa: BLE001 - as above
        return kind.md5sum or f"sha256_{hashlib.sha256(kind.definition.encode()).hexdigest()}"


def _store(types: Any, known: Any = None) -> Any:
    store = known or get_typestore(Stores.EMPTY)
    # A message of ROS 2 is never empty.
    filled = get_typestore(Stores.ROS2_JAZZY).fielddefs[_EMPTY][1]
    store.register(
        {
            name: (constants, fields or filled)
            for name, (constants, fields) in types.items()
            if name not in store.fielddefs
        }
    )
    return store


def _converted(kind: MessageType, *, ros2: bool, own: bool) -> Form:
    name = kind.kind.replace("/", "/msg/", 1) if ros2 else kind.kind
    source = _store(get_types_from_msg(_BOUND.sub("", kind.definition), name))
    every = [field for _, fields in source.fielddefs.values() for _, field in fields]
    if ros2 and any(node is Nodetype.ARRAY and not array[1] for node, array in every):
        raise ValueError("it has an array of no elements")
    # The newest of the distributions that robots have: where an older type is shorter, its readers leave out
    # what comes after.
    known = get_typestore(Stores.ROS2_JAZZY if ros2 else Stores.ROS1_NOETIC)
    if own:
        target = _store({**source.fielddefs, **{same: known.fielddefs[same] for same in _OF_EACH}})
        new = name
    else:
        new = STATIC_MSGTYPE_RENAMES.get(name, name) if ros2 else name
        target = _store(source.fielddefs, known)
    text, md5sum = target.generate_msgdef(new, ros_version=2 if ros2 else 1)
    same = is_same_wireformat(source, target, name, new)
    direct = partial(target.ros1_to_cdr, typename=new) if ros2 else partial(source.cdr_to_ros1, typename=name)
    migrate = partial(
        migrate_bytes, source, target, name, new, {}, src_is2=not ros2, dst_is2=ros2
    )  # fmt: skip

    def convert(message: bytes) -> bytes:
        # What converts directly reads little-endian messages only.
        little = message[:2] == _LITTLE_ENDIAN
        try:
            if little and not ros2:
                # Bytes may follow that the middleware had reserved for nothing.
                size_of = source.get_msgdef(name).getsize_cdr_to_ros1
                message = message[: _CDR_START + size_of(message[_CDR_START:], 0, None, 0, source)[0]]
            return bytes((direct if same and (ros2 or little) else migrate)(message))
        except Exception as error:
            raise ConversionError(f"a message does not fit {kind.kind}: {error}") from error

    note = f"of ROS {1 if ros2 else 2}, converted to ROS {2 if ros2 else 1}"
    if kind.converted_from == ROS2:
        note = "of ROS 2, converted to ROS 1 when they were recorded and back for this file"
    elif _HEADER in source.fielddefs:
        note += ", without the seq of headers" if ros2 else ", with 0 as the seq of headers"
    if not same:
        note += ", fields by name"
    if ros2:
        md5sum = _type_hash(kind._replace(kind=new, definition=text, md5sum=""))
    return Form(new if ros2 else new.replace("/msg/", "/"), text, md5sum, ros2, note, convert)
