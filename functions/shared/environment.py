"""The variables of this function's environment, read once; the stacks write them by the same class."""

from __future__ import annotations

import os
from functools import cache

from iort_contract.catalog.environments import E


@cache
def variables(kind: type[E]) -> E:
    """The variables of a function, by its class in the catalogue."""
    return kind.read(os.environ)
