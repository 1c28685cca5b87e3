"""What the messages of a rosbridge server consist of, asked of the rosapi node that runs beside it.

A ROS 1 server gives the definitions' own text (``/rosapi/topics_and_raw_types``), from which the md5sum
follows as ROS computes it. An older one, and ROS 2, give the fields alone (``/rosapi/message_details``): of
those a ROS 1 text is written. There the constants are without type and order, so they are left out, and the
md5sum of a type that has any is not the publisher's.
"""

from __future__ import annotations

import hashlib
import json
import logging
import re
from typing import Any, Callable, Generator, Mapping, NamedTuple, Optional, Tuple

from iort_agent.clock import Clock
from iort_contract.limits import MessageError
from iort_contract.ros1.definition import DURATION, HEADER_TYPE, LETTERS, STRING, TIME, Definition, parse

_log = logging.getLogger(__name__)

# The first call makes rosapi load every type of the graph, which takes seconds on a small computer.
ANSWER_S = 10.0
# rosapi may start after the server.
AGAIN_S = 30.0

_RULE = "=" * 80
_BUILTIN = {*LETTERS, STRING, TIME, DURATION}
# As ROS 2 calls them, where they are called otherwise.
_NAMES = {
    "boolean": "bool",
    "octet": "byte",
    "float": "float32",
    "double": "float64",
    "wstring": STRING,
    "builtin_interfaces/Time": TIME,
    "builtin_interfaces/Duration": DURATION,
}
_HEADER = ("std_msgs/Header", "roslib/Header", "Header")
_NAME = re.compile(r"[A-Za-z]\w*", re.ASCII)
_KIND = re.compile(r"[A-Za-z]\w*/[A-Za-z]\w*", re.ASCII)


class Structure(NamedTuple):
    """A message type as a ROS 1 publisher would declare it."""

    kind: str
    md5sum: str
    text: str
    definition: Definition


def from_text(kind: str, text: str) -> Structure:
    """The structure in a definition's own text. Raises `MessageError` for what is none."""
    definition = parse(kind, text)
    return Structure(kind, md5sum(kind, text), text, definition)


def from_typedefs(kind: str, typedefs: Any) -> Structure:
    """The structure in an answer of ``message_details``. Raises `MessageError` for what is none."""
    kind = ros1_kind(kind)
    try:
        bodies = dict(_body(typedef) for typedef in reversed(typedefs))
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise MessageError(
            f"{kind}: rosapi's answer has not the members of its TypeDef: {error!r}"
        ) from error
    bodies = {name: body for name, body in bodies.items() if name not in _BUILTIN}
    if kind not in bodies:
        raise MessageError(f"{kind}: rosapi's answer lacks it")
    nested = [f"{_RULE}\nMSG: {name}\n{body}" for name, body in bodies.items() if name != kind]
    return from_text(kind, "".join([bodies[kind], *nested]))


def ros1_kind(kind: str) -> str:
    """The name of a type as ROS 1 has it: ROS 2 puts ``msg`` in the middle."""
    package, _, name = kind.partition("/")
    return f"{package}/{name.rpartition('/')[2]}" if name else kind


def _body(typedef: Mapping[str, Any]) -> tuple[str, str]:
    kind = ros1_kind(str(typedef["type"]))
    kind = HEADER_TYPE if kind in _HEADER else kind
    kind = _NAMES.get(kind, kind)
    lines = []
    for name, base, length in zip(typedef["fieldnames"], typedef["fieldtypes"], typedef["fieldarraylen"]):
        # ROS 2 gives the names of Python's slots.
        lines.append(f"{_field_type(base)}{_brackets(length)} {_checked(name.lstrip('_'), _NAME)}\n")
    if kind == HEADER_TYPE and "uint32 seq\n" not in lines:
        lines.insert(0, "uint32 seq\n")
    return kind, "".join(lines)


def _field_type(base: str) -> str:
    # ROS 2 bounds texts and sequences: string<10>, and "double, 3" of a sequence<double, 3>.
    plain = re.sub(r"<.*|,.*", "", base).strip()
    kind = HEADER_TYPE if plain in _HEADER else ros1_kind(plain)
    kind = _NAMES.get(kind, kind)
    return kind if kind in _BUILTIN else _checked(kind, _KIND)


def _brackets(length: Any) -> str:
    if length == -1:
        return ""
    return f"[{int(length) or ''}]"


def _checked(name: str, pattern: re.Pattern[str]) -> str:
    if not pattern.fullmatch(name):
        raise ValueError(name)
    return name


def md5sum(kind: str, text: str) -> str:
    """The md5sum of a definition, by ROS' rule: the constants, then the fields, nested types by theirs."""
    first, *others = re.split(r"^={20,}\s*$", text, flags=re.MULTILINE)
    bodies = {kind: first}
    for section in others:
        head, _, body = section.strip().partition("\n")
        bodies[head[len("MSG:") :].strip()] = body
    return _md5sum(kind, bodies, {})


def _md5sum(kind: str, bodies: Mapping[str, str], done: dict[str, str]) -> str:
    if kind in done:
        return done[kind]
    constants, fields = [], []
    for line in bodies[kind].splitlines():
        clean = line.split("#", 1)[0].strip()
        if "=" in clean:
            base, name = clean.split("=", 1)[0].split()
            # Of a text constant everything counts, also what looks like a comment.
            value = (line if base == STRING else clean).split("=", 1)[1].strip()
            constants.append(f"{base} {name}={value}")
        elif clean:
            base, name = clean.split()
            bare = base.split("[", 1)[0]
            if bare in _BUILTIN:
                fields.append(f"{base} {name}")
                continue
            if bare in _HEADER:
                bare = HEADER_TYPE
            nested = bare if "/" in bare else f"{kind.partition('/')[0]}/{bare}"
            fields.append(f"{_md5sum(nested, bodies, done)} {name}")
    # MD5 is ROS' name for a definition, no secret.
    done[kind] = hashlib.md5("\n".join(constants + fields).encode()).hexdigest()  # noqa: S324 - as ROS does
    return done[kind]


# --- asking ----------------------------------------------------------------------------------------

# Yields a service and its arguments, is sent the values of the answer, None where there was none.
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
        # A call's identity -> when it is given up, what it was, and the topics that wait for its answer.
        self._calls: dict[str, _Call] = {}
        self._count = 0

    def restart(self) -> None:
        """Forget what another connection's server said, and what it was asked."""
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
        """Give up what is not answered."""
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
            _log.warning("topic %s: what rosapi says of %s cannot be used: %r", topic, kind, error)
            return None
        if any(typedef.get("constnames") for typedef in values["typedefs"]):
            _log.warning("topic %s: %s has constants, so its md5sum is not its publisher's", topic, kind)
        return structure

    def _list(self, values: Mapping[str, Any] | None) -> None:
        lists = [(values or {}).get(name) for name in ("topics", "types", "typedefs_full_text")]
        if all(isinstance(one, list) for one in lists):
            self._listed.update((str(topic), (str(kind), str(text))) for topic, kind, text in zip(*lists))


class _Call(NamedTuple):
    service: str
    arguments: str
    due: float
    waiting: list[tuple[str, _Search]]
