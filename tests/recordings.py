"""Finds recordings of real cars; they are outside the project, because the project may not share them."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


def recording(name: str) -> Path:
    """Return a recording's path; skip the test if it is missing."""
    folder = Path(os.environ.get("IORT_RECORDINGS") or ROOT.parent / "shared" / "data")
    if not (folder / name).is_file():
        pytest.skip(f"the recording {name} is not in {folder}; IORT_RECORDINGS may name the folder")
    return folder / name
