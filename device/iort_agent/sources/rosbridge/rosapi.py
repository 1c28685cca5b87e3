"""The structure of a topic's messages, asked of the rosapi node beside a rosbridge server.

A ROS 1 server gives the text of a definition (``/rosapi/topics_and_raw_types``), from which the MD5 follows.
An older server, and ROS 2, give only the fields (``/rosapi/message_details``), from which a ROS 1 text is
written. Their constants have no type and no order, so they are left out, and the MD5 of a type with constants
differs from the publisher's.
"""

from __future__ import annotations

import json
import logging
import re
from typing import Any, Callable, Generator, Mapping, NamedTuple, Optional, Tuple

from iort_agent.common.threads import Clock
from iort_contract.limits import MessageError
from iort_contract.ros.definition import (
    DURATION,
    HEADER_TYPE,
    LETTERS,
    RULE,
    STRING,
    TIME,
    VARIABLE,
    Definition,
    Field,
    md5sum,
    parse,
)

_log = logging.getLogger(__name__)

# The first call makes rosapi load every type of the graph, which takes seconds on a small computer.
ANSWER_S = 10.0
# rosapi may start after the server.
AGAIN_S = 30.0

_BUILTIN = {*LETTERS, STRING, TIME, DURATION}
# ROS 2's names for ROS 1's types.
_NAMES = {
    "boolean": "bool",
    "octet": "byte",
    "float": "float32",
    "double": "float64",
    "wstring": STRING,
    "builtin_interfaces/Time": TIME,
    "builtin_interfaces/Duration": DURATION,
    "roslib/Header": HEADER_TYPE,
    "Header": HEADER_TYPE,
}
_NAME = re.compile(r"[A-Za-z]\w*", re.ASCII)
_KIND = re.compile(r"[A-Za-z]\w*/[A-Za-z]\w*", re.ASCII)


class Structure(NamedTuple):
    """A message type as a ROS 1 publisher would declare it."""

    kind: str
    md5sum: str
    text: str
    definition: Definition


def from_text(kind: str, text: str) -> Structure:
    """The structure in a definition's own text. Raises `MessageError` if it is invalid."""
    definition = parse(kind, text)
    return Structure(kind, md5sum(definition, text), text, definition)


def from_typedefs(kind: str, typedefs: Any) -> Structure:
    """The structure in an answer of ``message_details``. Raises `MessageError` if it is invalid."""
    kind = _ros1_kind(kind)
    try:
        bodies = dict(_body(typedef) for typedef in reversed(typedefs))
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise MessageError(f"{kind}: rosapi's answer must be TypeDefs: {error!r}") from error
    if kind not in bodies:
        raise MessageError(f"{kind}: rosapi's answer lacks it")
    nested = [
        f"{RULE}\nMSG: {name}\n{body}"
        for name, body in bodies.items()
        if name != kind and name not in _BUILTIN
    ]
    return from_text(kind, "".join([bodies[kind], *nested]))


def _ros1_kind(kind: str) -> str:
    """ROS 1's name of a type: ROS 2 puts ``msg`` in the middle, and has other names for some."""
    package, _, name = kind.partition("/")
    kind = f"{package}/{name.rpartition('/')[2]}" if name else kind
    return _NAMES.get(kind, kind)


def _body(typedef: Mapping[str, Any]) -> tuple[str, str]:
    kind = _ros1_kind(str(typedef["type"]))
    lines = []
    for name, base, length in zip(typedef["fieldnames"], typedef["fieldtypes"], typedef["fieldarraylen"]):
        # ROS 2 bounds texts and sequences: string<10>, and "double, 3" of a sequence<double, 3>.
        nested = _ros1_kind(re.sub(r"<.*|,.*", "", base).strip())
        if nested not in _BUILTIN:
            _checked(nested, _KIND)
        # rosapi writes -1 for a single value and 0 for a variable array.
        count = None if length == -1 else int(length) or VARIABLE
        # ROS 2 gives the names of Python's slots.
        lines.append(f"{Field(_checked(name.lstrip('_'), _NAME), nested, count)}\n")
    if kind == HEADER_TYPE and "uint32 seq\n" not in lines:
        lines.insert(0, "uint32 seq\n")
    return kind, "".join(lines)


def _checked(name: str, pattern: re.Pattern[str]) -> str:
    if not pattern.fullmatch(name):
        raise ValueError(name)
    return name


# Yields a service and its arguments, and is sent the values of the answer, or None without an answer.
_Search = Generator[Tuple[str, str], Optional[Mapping[str, Any]], Optional[Structure]]
Send = Callable[[Mapping[str, Any]], None]
Found = Callable[[str, Optional[Structure]], None]


class Rosapi:
    """Asks for the structures of topics; all in the thread of the connection."""

    def __init__(self, send: Send, found: Found, clock: Clock) -> None:
        self._send = send
        self._found = found
        self._clock = clock
        self._listed: dict[str, tuple[str, str]] = {}
        self._calls: dict[str, _Call] = {}
        self._count = 0

    def restart(self) -> None:
        """Forget the answers of another connection's server, and the open calls."""
        self._listed.clear()
        self._calls.clear()

    def ask(self, topic: str, kind: str | None) -> None:
        """Find the structure of a topic's messages; ``found`` is called with it, or with None."""
        self._step(topic, self._search(topic, kind), None)

    def answer(self, said: Mapping[str, Any]) -> None:
        """Take a ``service_response``."""
        call = self._calls.pop(str(said.get("id")), None)
        if call is None:
            return
        values = said.get("values")
        good = said.get("result") is not False and isinstance(values, dict)
        if not good:
            _log.info("%s: no answer: %.200s", call.service, values)
        self._go_on(call, values if good else None)

    def look(self) -> None:
        """Give up the calls that nobody answers."""
        now = self._clock.monotonic()
        for name, call in list(self._calls.items()):
            if now >= call.due:
                del self._calls[name]
                _log.warning("%s: no answer within %g s", call.service, ANSWER_S)
                self._go_on(call, None)

    def _go_on(self, call: _Call, values: Mapping[str, Any] | None) -> None:
        for topic, search in call.waiting:
            self._step(topic, search, values)

    def _step(self, topic: str, search: _Search, values: Mapping[str, Any] | None) -> None:
        try:
            service, arguments = search.send(values)
        except StopIteration as end:
            self._found(topic, end.value)
            return
        for call in self._calls.values():
            if (call.service, call.arguments) == (service, arguments):
                call.waiting.append((topic, search))
                return
        self._count += 1
        name = f"iort:rosapi:{self._count}"
        due = self._clock.monotonic() + ANSWER_S
        self._calls[name] = _Call(service, arguments, due, [(topic, search)])
        self._send({"op": "call_service", "id": name, "service": service, "args": json.loads(arguments)})

    def _search(self, topic: str, kind: str | None) -> _Search:
        if topic not in self._listed:
            self._list((yield "/rosapi/topics_and_raw_types", "{}"))
        listed, text = self._listed.get(topic, ("", ""))
        kind = listed or kind
        # ROS 2 has its own language for definitions.
        if kind is not None and text.strip() and "/msg/" not in kind:
            try:
                return from_text(kind, text)
            except (MessageError, KeyError, ValueError) as error:
                _log.warning("topic %s: its definition cannot be read: %r", topic, error)
        if kind is None:
            values = yield "/rosapi/topic_type", json.dumps({"topic": topic})
            kind = str((values or {}).get("type") or "")
        if not kind:
            return None
        values = yield "/rosapi/message_details", json.dumps({"type": kind})
        if values is None:
            return None
        try:
            structure = from_typedefs(kind, values.get("typedefs"))
        except (MessageError, KeyError, ValueError) as error:
            _log.warning("topic %s: rosapi's answer for %s cannot be used: %r", topic, kind, error)
            return None
        if any(typedef.get("constnames") for typedef in values["typedefs"]):
            _log.warning("topic %s: %s has constants, so its MD5 differs from the publisher's", topic, kind)
        return structure

    def _list(self, values: Mapping[str, Any] | None) -> None:
        lists = [(values or {}).get(name) for name in ("topics", "types", "typedefs_full_text")]
        if all(isinstance(one, list) for one in lists):
            self._listed.update((str(topic), (str(kind), str(text))) for topic, kind, text in zip(*lists))


class _Call(NamedTuple):
    """A call: when it is given up, and the topics that wait for its answer."""

    service: str
    arguments: str
    due: float
    waiting: list[tuple[str, _Search]]
