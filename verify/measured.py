"""The answers of AWS that are kept in the repository: `make verify-aws KEEP=1` writes them.

Tests hold the embedded cloud to them, and docs/assumptions.md says by whom and when they were measured.
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
    """What one run on AWS has seen; ``seen`` maps a question's name to its answer."""

    by: str = ""
    date: str = ""
    region: str = ""
    seen: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def expected(self, name: str) -> Mapping[str, Any] | None:
        """AWS' own answer to a question; None where it was never asked."""
        return self.seen.get(name)


def load(path: Path = KEPT) -> Measured:
    """The kept answers, none where the file is not there. Raises `VerifyError` for a file of another form."""
    if not path.exists():
        return Measured()
    try:
        report = json.loads(path.read_text())
        seen = {one["name"]: one["seen"] for one in report["answers"] if one["seen"] is not None}
        return Measured(by=report["by"], date=report["date"], region=report["region"], seen=seen)
    except (KeyError, TypeError, ValueError) as error:
        raise VerifyError(f"{path} is no report of verify: {error!r}") from error
