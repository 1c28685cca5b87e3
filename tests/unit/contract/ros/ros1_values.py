"""Random ROS 1 definitions and messages for hypothesis, and their bytes as rosbags writes them."""

from __future__ import annotations

import functools
import itertools
from typing import Any

from hypothesis import strategies as st

from iort_contract.ros.definition import DURATION, LETTERS, STRING, TIME, Definition, Field, parse

RULE = "=" * 80
HEADER = f"{RULE}\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
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


@st.composite
def definitions(draw: Any) -> Definition:
    """A message type of a unique name with nested types, with or without a header."""
    number = next(_numbers)
    deep = draw(_fields([]))
    inner = draw(_fields(["Deep", "Header"]))
    own = draw(_fields(["Inner", "Deep", "Header"]))
    stamped = draw(st.booleans())
    text = (
        f"{'Header header' if stamped else ''}\n{own}\n{HEADER}"
        f"{RULE}\nMSG: made{number}_msgs/Inner\n{inner}\n{RULE}\nMSG: made{number}_msgs/Deep\n{deep}\n"
    )
    return parse(f"made{number}_msgs/Made", text)


@st.composite
def _fields(draw: Any, nested: list[str]) -> str:
    kinds = st.sampled_from([*LETTERS, STRING, TIME, DURATION, *nested])
    lengths = st.sampled_from(["", "", "[]", "[3]", "[70]"])
    chosen = draw(st.lists(st.tuples(kinds, lengths), max_size=6))
    return "\n".join(f"{kind}{length} f{i}" for i, (kind, length) in enumerate(chosen))


def values(definition: Definition, field: Field | None = None) -> st.SearchStrategy[Any]:
    """A message's values: times are objects of sec and nanosec, bytes are lists of numbers."""
    field = field or Field("", definition.kind, None)
    if field.length is not None:
        one = values(definition, Field(field.name, field.kind, None))
        size = (0, 4) if field.length < 0 else (field.length, field.length)
        return st.lists(one, min_size=size[0], max_size=size[1])
    if field.kind == "bool":
        return st.booleans()
    if field.kind in ("float32", "float64"):
        return st.floats(width=32 if field.kind == "float32" else 64)
    if field.kind in LETTERS:
        return _INTEGERS[field.kind]
    if field.kind == STRING:
        return st.text(st.characters(exclude_categories=["Cs"]), max_size=5)
    if field.kind in _SECONDS:
        return st.fixed_dictionaries({"sec": _SECONDS[field.kind], "nanosec": st.integers(0, 999_999_999)})
    inner = definition.fields(field.kind)
    return st.fixed_dictionaries({one.name: values(definition, one) for one in inner})


def text_of(definition: Definition) -> str:
    """The definition as its publisher declares it."""
    sections = []
    for kind, fields in definition.types.items():
        lines = "".join(f"{field.kind}{_brackets(field.length)} {field.name}\n" for field in fields)
        if kind == definition.kind:
            sections.insert(0, lines)
        elif kind not in (TIME, DURATION):
            sections.append(f"{RULE}\nMSG: {kind}\n{lines}")
    return "".join(sections)


def _brackets(length: int | None) -> str:
    return "" if length is None else "[]" if length < 0 else f"[{length}]"


@functools.lru_cache(1)
def _store() -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS1_NOETIC)


def by_rosbags(definition: Definition, value: Any) -> bytes:
    """The message as rosbags serialises it."""
    from rosbags.typesys import get_types_from_msg

    store = _store()
    kind = _rosbags_name(definition.kind)
    found = get_types_from_msg(text_of(definition), kind)
    store.register({name: type_ for name, type_ in found.items() if name not in store.types})
    return bytes(store.serialize_ros1(_rosbags(store.types, definition, value), kind))


def _rosbags(types: Any, definition: Definition, value: Any, field: Field | None = None) -> Any:
    import numpy as np

    field = field or Field("", definition.kind, None)
    if field.length is not None:
        if field.kind in LETTERS:
            names = {"byte": "int8", "char": "uint8"}
            return np.array(value, names.get(field.kind, field.kind))
        return [_rosbags(types, definition, item, Field(field.name, field.kind, None)) for item in value]
    if field.kind in LETTERS or field.kind == STRING:
        return value
    if field.kind in (TIME, DURATION):
        return types[f"builtin_interfaces/msg/{field.kind.title()}"](**value)
    inner = {
        one.name: _rosbags(types, definition, value[one.name], one) for one in definition.fields(field.kind)
    }
    return types[_rosbags_name(field.kind)](**inner)


def _rosbags_name(kind: str) -> str:
    return kind.replace("/", "/msg/")
