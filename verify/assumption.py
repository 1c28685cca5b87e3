"""The design's assumptions about AWS."""

from __future__ import annotations

import enum
from dataclasses import dataclass


class Basis(enum.Enum):
    """The reason to believe an assumption until it is measured on AWS."""

    DOCUMENTED = "documented"
    ASSUMED = "assumed"


@dataclass(frozen=True, kw_only=True)
class Assumption:
    """One behaviour of AWS that the code relies on.

    ``name`` is ``subject.detail``; ``assumed`` is one to three sentences; ``source`` names AWS' page if it is
    documented; ``relied_on_by`` are files of the repository.
    """

    name: str
    assumed: str
    basis: Basis
    source: str = ""
    relied_on_by: tuple[str, ...]
