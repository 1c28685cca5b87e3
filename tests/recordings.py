"""Where the recordings of real cars are: outside the project, because they are not ours to share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


def recording(name: str) -> Path:
    """The path of a recording; skips the test where the machine has none."""
    folder = Path(os.environ.get("IORT_RECORDINGS") or ROOT.parent / "shared" / "data")
    if not (folder / name).is_file():
        pytest.skip(f"the recording {name} is not in {folder}; IORT_RECORDINGS may name the folder")
    return folder / name
