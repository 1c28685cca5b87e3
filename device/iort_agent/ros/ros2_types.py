"""rclpy and the message types that are installed on this machine. Nothing here is imported before it is
used."""

from __future__ import annotations

import hashlib
import importlib
import json
import logging
import re
from pathlib import Path
from typing import Any, Iterator, NamedTuple

from iort_agent.errors import SourceError
from iort_contract.limits import MessageError
from iort_contract.ros.definition import RULE, Definition, parse

_log = logging.getLogger(__name__)

_HELP = (
    "the agent's Python cannot import rclpy. ROS 2 has it for one Python only (Humble: 3.10, Jazzy: 3.12): "
    "`source /opt/ros/<distribution>/setup.bash`, then "
    "`/usr/bin/python3 -m venv --system-site-packages <folder>` and install the agent into that"
)
_KIND = re.compile(r"([a-z]\w*)/msg/([A-Za-z]\w*)", re.ASCII)
# A field's type, whose arrays and limits of lengths are left out.
_FIELD = re.compile(r"\s*([A-Za-z][\w/]*)(?:<=\d+)?(?:\[[^\]]*\])?\s+[A-Za-z]", re.ASCII)
_BUILTIN = frozenset(
    [
        "bool", "byte", "char", "float32", "float64", "int8", "uint8", "int16", "uint16", "int32", "uint32",
        "int64", "uint64", "string", "wstring",
    ]
)  # fmt: skip
# IDL's names of builtin types, as Python's classes tell them -> those of message definitions.
_IDL = {"boolean": "bool", "octet": "byte", "float": "float32", "double": "float64", "char": "uint8"}
_SEQUENCE = re.compile(r"sequence<(.*?)(?:, (\d+))?>(?!.*>)|(.*)\[(\d+)\]", re.ASCII)
_MAX_DEPTH = 50


class Installed(NamedTuple):
    """An installed message type: its class, the text of its definition in the form that MCAP calls ros2msg,
    and its type hash, which is a hash of this text where the distribution has none."""

    message_class: Any
    text: str
    type_hash: str


class Types:
    """The installed types that were asked for."""

    def __init__(self) -> None:
        self._found: dict[str, Installed] = {}
        self._parsed: dict[str, Definition | None] = {}

    def found(self, kind: str) -> Installed:
        """The type. Raises `SourceError` if it is not installed."""
        if kind not in self._found:
            self._found[kind] = installed(kind)
        return self._found[kind]

    def parsed(self, kind: str) -> Definition | None:
        """Its definition, None if that cannot be read. Raises as `found`."""
        if kind not in self._parsed:
            try:
                self._parsed[kind] = parse(kind, self.found(kind).text)
            except MessageError as error:
                _log.warning("the definition of %s cannot be read: %s", kind, error)
                self._parsed[kind] = None
        return self._parsed[kind]

    def definition(self, kind: str) -> Definition:
        """Its definition. Raises `SourceError` if it is not installed, or if that cannot be read."""
        definition = self.parsed(kind)
        if definition is None:
            raise SourceError(f"the definition of the ROS type {kind} cannot be read")
        return definition


def rclpy() -> Any:
    """The module. Raises `SourceError` without it."""
    try:
        return importlib.import_module("rclpy")
    except ImportError as error:
        raise SourceError(f"{_HELP} ({error})") from error


def installed(kind: str) -> Installed:
    """The installed type of a name such as sensor_msgs/msg/Imu. Raises `SourceError` if it is not
    installed."""
    match = _KIND.fullmatch(kind)
    if match is None:
        raise SourceError(f"a ROS 2 message type is package/msg/Type, got {kind!r}")
    package, name = match.groups()
    message_class = _class_of(package, name)
    text = "\n".join([_definition(package, name), *_nested(package, name, {f"{package}/{name}"}, 0)])
    type_hash = _installed_hash(package, name) or f"sha256_{hashlib.sha256(text.encode()).hexdigest()}"
    return Installed(message_class, text, type_hash)


def service(kind: str) -> Any:
    """The class of an installed service type. Raises `SourceError` if it is not installed."""
    package, _, name = kind.partition("/srv/")
    try:
        return getattr(importlib.import_module(f"{package}.srv"), name)
    except (ImportError, AttributeError) as error:
        raise _missing(package, kind, error) from error


def _class_of(package: str, name: str) -> Any:
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError) as error:
        raise _missing(package, f"{package}/msg/{name}", error) from error


def _missing(package: str, kind: str, error: Exception) -> SourceError:
    debian = f"ros-<distribution>-{package.replace('_', '-')}"
    return SourceError(
        f"the ROS type {kind} is not installed: source the workspace that has its package, {package} "
        f"(`source <workspace>/install/setup.bash`), or apt install {debian} ({error})"
    )


def _nested(package: str, name: str, seen: set[str], depth: int) -> Iterator[str]:
    """The sections of the types in a type, in the order of `ros2 bag record`."""
    if depth > _MAX_DEPTH:
        raise SourceError(f"the ROS type {package}/msg/{name} is nested too deeply")
    for nested in sorted(_uses(package, _definition(package, name)) - {f"{package}/{name}"}):
        if nested not in seen:
            seen.add(nested)
            inner = nested.split("/")
            yield f"{RULE}\nMSG: {nested}\n{_definition(inner[0], inner[1])}"
            yield from _nested(inner[0], inner[1], seen, depth + 1)


def _uses(package: str, text: str) -> set[str]:
    """The types of a definition's fields, as package/Type."""
    kinds = {match.group(1) for match in map(_FIELD.match, text.splitlines()) if match} - _BUILTIN
    parts = [kind.split("/") for kind in kinds]
    return {f"{part[0] if len(part) > 1 else package}/{part[-1]}" for part in parts}


def _definition(package: str, name: str) -> str:
    """The text of a type's own definition: its file, or, of a type that was written in IDL, its class'
    fields."""
    share = _share(package)
    file = share / "msg" / f"{name}.msg" if share is not None else None
    if file is not None and file.is_file():
        return file.read_text(encoding="utf-8")
    fields = _class_of(package, name).get_fields_and_field_types()
    return "".join(f"{_field_type(kind)} {field}\n" for field, kind in fields.items())


def _field_type(kind: str) -> str:
    """A field's type as in a definition, of the name that its class has for it."""
    match = _SEQUENCE.fullmatch(kind)
    if match is None:
        base, length = kind, ""
    elif match.group(1):
        base, length = match.group(1), f"[<={match.group(2)}]" if match.group(2) else "[]"
    else:
        base, length = match.group(3), f"[{match.group(4)}]"
    # A text's longest length: string<10> of IDL is string<=10 of a definition.
    return _IDL.get(base, re.sub(r"(string)<(\d+)>", r"\1<=\2", base)) + length


def _installed_hash(package: str, name: str) -> str:
    """The hash that the distribution's generator has written, from Iron on."""
    share = _share(package)
    try:
        described = json.loads((share / "msg" / f"{name}.json").read_text()) if share is not None else {}
        hashes = {one["type_name"]: one["hash_string"] for one in described.get("type_hashes", [])}
        return str(hashes.get(f"{package}/msg/{name}", ""))
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return ""


def _share(package: str) -> Path | None:
    try:
        packages: Any = importlib.import_module("ament_index_python.packages")
        return Path(packages.get_package_share_directory(package))
    except (ImportError, LookupError):
        return None  # without a file, its class tells the definition
