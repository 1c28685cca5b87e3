"""Random messages of any type that rosidl has generated."""

import math
import random

from rosidl_parser import definition
from rosidl_runtime_py.utilities import get_interface

WORDS = ("", "base_link", "grün", "übergröße", "世界", "🏎", "joint_1", "two\nlines")
_EDGES = (math.inf, -math.inf, math.nan, -0.0)
_BITS = {f"{sign}int{bits}": (sign, bits) for sign in ("", "u") for bits in (8, 16, 32, 64)}


class Values:
    """Values as sensors send them: a few digits, sometimes an edge case; covariances stay zero.

    ``lengths`` has lengths of sequences by field name; others have up to four elements.
    """

    def __init__(self, seed, lengths):
        self._random, self._lengths = random.Random(seed), lengths

    def fill(self, message):
        """Set every field but the header."""
        for name, kind in zip(message.get_fields_and_field_types(), message.SLOT_TYPES, strict=True):
            if name != "header" and "covariance" not in name:
                setattr(message, name, self._value(kind, name))
        return message

    def _value(self, kind, name):
        if isinstance(kind, definition.Array):
            return self._several(kind, kind.size, name)
        if isinstance(kind, definition.AbstractSequence):
            length = self._lengths.get(name, self._random.randrange(5))
            return self._several(kind, min(length, getattr(kind, "maximum_size", length)), name)
        if isinstance(kind, definition.AbstractGenericString):
            return self._random.choice(WORDS)[: getattr(kind, "maximum_size", 100)]
        if isinstance(kind, definition.NamespacedType):
            return self.fill(get_interface("/".join(kind.namespaced_name()))())
        return self._number(kind.typename)

    def _several(self, kind, length, name):
        if isinstance(kind.value_type, definition.BasicType) and kind.value_type.typename in (
            "uint8",
            "int8",
        ):
            content = self._random.randbytes(length)
            return list(content) if kind.value_type.typename == "uint8" else [one - 128 for one in content]
        return [self._value(kind.value_type, name) for _ in range(length)]

    def _number(self, kind):
        chance = self._random
        if kind == "boolean":
            return bool(chance.getrandbits(1))
        if kind == "octet":
            return bytes([chance.getrandbits(8)])
        if kind in ("float", "double"):
            if chance.random() < 0.01:
                return chance.choice(_EDGES)
            return round(chance.gauss(0, 3), 3) if kind == "double" else chance.randrange(-4096, 4096) / 64
        sign, bits = _BITS[kind]
        # The ends of each range, too.
        value = chance.choice((0, 1, 2**bits - 1, 2 ** (bits - 1), chance.getrandbits(bits)))
        return value if sign else value - 2 ** (bits - 1)
