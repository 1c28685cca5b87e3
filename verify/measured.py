"""AWS' answers, kept in the repository: `make verify-aws KEEP=1` writes them.

Tests compare the embedded cloud with them; docs/assumptions.md names who measured them and when.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from verify.errors import VerifyError

KEPT = Path(__file__).resolve().parent / "aws.json"


@dataclass(frozen=True, kw_only=True)
class Measured:
    """The answers of one run on AWS; ``seen`` maps a question's name to its answer."""

    by: str = ""
    date: str = ""
    region: str = ""
    seen: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def expected(self, name: str) -> Mapping[str, Any] | None:
        """AWS' answer to a question; None if it was never asked."""
        return self.seen.get(name)


def load(path: Path = KEPT) -> Measured:
    """The kept answers; empty without a file. Raises `VerifyError` for a file of another form."""
    if not path.exists():
        return Measured()
    try:
        report = json.loads(path.read_text())
        seen = {one["name"]: one["seen"] for one in report["answers"] if one["seen"] is not None}
        return Measured(by=report["by"], date=report["date"], region=report["region"], seen=seen)
    except (KeyError, TypeError, ValueError) as error:
        raise VerifyError(f"{path} must be a report of verify: {error!r}") from error
