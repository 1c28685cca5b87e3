"""Random definitions and messages of ROS 1 and ROS 2, and their bytes as rosbags writes them."""

from __future__ import annotations

import functools
import itertools
from typing import Any, Iterator

from hypothesis import strategies as st

from iort_contract.ros.definition import (
    DURATION,
    LETTERS,
    RULE,
    STRING,
    TIME,
    VARIABLE,
    Definition,
    Field,
    Fields,
    is_ros2,
    layout,
    parse,
    short_kind,
)
from iort_contract.ros.plan import MAX_ELEMENTS

HEADER = f"{RULE}\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
ROS2_HEADER = f"{RULE}\nMSG: std_msgs/msg/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
_numbers = itertools.count()

_INTEGERS = {
    kind: st.integers(0, 2**bits - 1)
    if letter.isupper()
    else st.integers(-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
    for kind, letter in LETTERS.items()
    if letter.lower() in "bhiq"
    for bits in [8 * {"b": 1, "h": 2, "i": 4, "q": 8}[letter.lower()]]
}
_SECONDS = {TIME: st.integers(0, 2**31 - 1), DURATION: st.integers(-(2**31), 2**31 - 1)}
_ROS2_TIMES = ["builtin_interfaces/Time", "builtin_interfaces/msg/Duration"]
# rosbags has no wstring, and takes ROS 2's byte, which is unsigned, for a signed one.
_ROS2_NUMBERS = [kind for kind in LETTERS if kind != "byte"]


@st.composite
def definitions(draw: Any, *, ros2: bool = False) -> Definition:
    """A message type of a unique name with nested types, with or without a header."""
    number = next(_numbers)
    deep = draw(_fields([], ros2=ros2))
    inner = draw(_fields(["Deep", "Header"], ros2=ros2))
    own = draw(_fields(["Inner", "Deep", "Header"], ros2=ros2))
    stamped = draw(st.booleans())
    text = (
        f"{'Header header' if stamped else ''}\n{own}\n{ROS2_HEADER if ros2 else HEADER}"
        f"{RULE}\nMSG: made{number}_msgs/Inner\n{inner}\n{RULE}\nMSG: made{number}_msgs/Deep\n{deep}\n"
    )
    return parse(f"made{number}_msgs/{'msg/' if ros2 else ''}Made", text)


@st.composite
def _fields(draw: Any, nested: list[str], *, ros2: bool) -> str:
    numbers, times = (_ROS2_NUMBERS, _ROS2_TIMES) if ros2 else ([*LETTERS], [TIME, DURATION])
    kinds = st.sampled_from([*numbers, STRING, *times, *(["string<=4"] if ros2 else []), *nested])
    lengths = st.sampled_from(["", "", "[]", "[3]", "[70]", *(["[<=3]"] if ros2 else [])])
    chosen = draw(st.lists(st.tuples(kinds, lengths), max_size=6))
    return "\n".join(f"{kind}{length} f{i}" for i, (kind, length) in enumerate(chosen))


def values(definition: Definition, field: Field | None = None) -> st.SearchStrategy[Any]:
    """A message's values: times are objects of sec and nanosec, bytes are lists of numbers."""
    field = field or Field("", short_kind(definition.kind), None)
    if field.length is not None:
        most = 4 if field.most is None else field.most
        size = (0, most) if field.length < 0 else (field.length, field.length)
        return st.lists(values(definition, field.element()), min_size=size[0], max_size=size[1])
    if field.kind == "bool":
        return st.booleans()
    if field.kind in ("float32", "float64"):
        return st.floats(width=32 if field.kind == "float32" else 64)
    if field.kind in LETTERS:
        return _INTEGERS[field.kind]
    if field.kind == STRING:
        few, odd = (5, "") if field.longest is None else (1, "\0")
        # A command of ROS 2 has no NUL.
        odd = "\0" if definition.ros2 else odd
        return st.text(st.characters(exclude_categories=["Cs"], exclude_characters=odd), max_size=few)
    if field.kind in _SECONDS:
        sec = _SECONDS[DURATION if definition.ros2 else field.kind]
        return st.fixed_dictionaries({"sec": sec, "nanosec": st.integers(0, 999_999_999)})
    inner = definition.fields(field.kind)
    return st.fixed_dictionaries({one.name: values(definition, one) for one in inner})


def leaves(definition: Definition, fields: Fields, message: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """The paths and values that the view of a message has."""
    for field in fields:
        value, here = message[field.name], f"{path}{field.name}"
        elements = {here: value} if field.length is None else {f"{here}.{i}": v for i, v in enumerate(value)}
        blob = field.length == VARIABLE and field.kind in ("uint8", "char")
        if field.length is not None and (blob or len(value) > MAX_ELEMENTS):
            continue
        for name, element in elements.items():
            if field.kind in definition.types:
                yield from leaves(definition, definition.fields(field.kind), element, f"{name}.")
            else:
                yield name, element


def view_of(definition: Definition, message: Any) -> Iterator[tuple[str, Any]]:
    """The paths and values that a decoder gives."""
    fields = definition.fields()
    if definition.stamped():
        fields = fields[1:]
        if len(fields) == 1 and fields[0].length is None and fields[0].kind in definition.types:
            message, fields = message[fields[0].name], definition.fields(fields[0].kind)
    return leaves(definition, fields, message)


def text_of(definition: Definition) -> str:
    """The definition as its publisher declares it."""
    if definition.ros2:
        return layout(definition)
    sections = []
    for kind, fields in definition.types.items():
        lines = "".join(f"{field}\n" for field in fields)
        if kind == definition.kind:
            sections.insert(0, lines)
        elif kind not in (TIME, DURATION):
            sections.append(f"{RULE}\nMSG: {kind}\n{lines}")
    return "".join(sections)


@functools.lru_cache(2)
def _store(*, ros2: bool) -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE if ros2 else Stores.ROS1_NOETIC)


def by_rosbags(definition: Definition, value: Any, *, little_endian: bool = True) -> bytes:
    """The message as rosbags serialises it."""
    from rosbags.typesys import get_types_from_msg

    store = _store(ros2=definition.ros2)
    kind = _rosbags_name(definition.kind)
    found = get_types_from_msg(text_of(definition), kind)
    store.register({name: type_ for name, type_ in found.items() if name not in store.types})
    message = _rosbags(store.types, definition, value)
    if definition.ros2:
        return bytes(store.serialize_cdr(message, kind, little_endian=little_endian))
    return bytes(store.serialize_ros1(message, kind))


def _rosbags(types: Any, definition: Definition, value: Any, field: Field | None = None) -> Any:
    import numpy as np

    field = field or Field("", short_kind(definition.kind), None)
    if field.length is not None:
        if field.kind in LETTERS:
            names = {"byte": "int8", "char": "uint8"}
            return np.array(value, names.get(field.kind, field.kind))
        return [_rosbags(types, definition, item, field.element()) for item in value]
    if field.kind in LETTERS or field.kind == STRING:
        return value
    if field.kind in (TIME, DURATION):
        return types[f"builtin_interfaces/msg/{field.kind.title()}"](**value)
    inner = {
        one.name: _rosbags(types, definition, value[one.name], one) for one in definition.fields(field.kind)
    }
    return types[_rosbags_name(field.kind)](**inner)


def _rosbags_name(kind: str) -> str:
    return kind if is_ros2(kind) else kind.replace("/", "/msg/")
