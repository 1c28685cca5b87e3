"""Sort keys as texts that SQLite orders as DynamoDB orders the keys."""

from __future__ import annotations

from decimal import Decimal, InvalidOperation

# DynamoDB's numbers have exponents from -130 to 125.
_MIDDLE = 200
_NINES = str.maketrans("0123456789", "9876543210")


def place_of(kind: str, text: str) -> str:
    """A sort key's place: a number's by its value, a text's by its characters."""
    if kind != "N":
        return text
    if text.isdecimal() and text.isascii() and text[0] != "0":
        return f"2{len(text) - 1 + _MIDDLE}{text.rstrip('0')}"
    try:
        sign, digits, exponent = Decimal(text).as_tuple()
    except InvalidOperation:
        # No item has such a key.
        return text
    if not any(digits) or not isinstance(exponent, int):
        return "1"
    adjusted = exponent + len(digits) - 1
    coefficient = "".join(map(str, digits)).rstrip("0")
    if sign:
        # The larger the digits, the smaller the number; and so is one with more digits.
        return f"0{_MIDDLE * 2 - adjusted}{coefficient.translate(_NINES)}~"
    return f"2{adjusted + _MIDDLE}{coefficient}"
