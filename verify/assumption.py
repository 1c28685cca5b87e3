"""What the design takes for granted about AWS."""

from __future__ import annotations

import enum
from dataclasses import dataclass


class Basis(enum.Enum):
    """Why we believe an assumption, as long as nobody has measured it on AWS."""

    DOCUMENTED = "documented"
    ASSUMED = "assumed"


@dataclass(frozen=True, kw_only=True)
class Assumption:
    """One behaviour of AWS that the code relies on.

    ``name`` is ``subject.detail``; ``assumed`` is one to three sentences; ``source`` names AWS' page where it
    is documented; ``relied_on_by`` are files of the repository.
    """

    name: str
    assumed: str
    basis: Basis
    source: str = ""
    relied_on_by: tuple[str, ...]
