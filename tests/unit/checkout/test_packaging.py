"""Each installed distribution contains every package of its folder."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from setuptools import find_packages

ROOT = Path(__file__).parents[3]


@pytest.mark.parametrize("folder", ["contract", "device", "analysis", "station"])
def test_every_package_of_a_distribution_is_installed(folder: str) -> None:
    home = ROOT / folder
    include = re.search(r"^include = (\[.*\])$", (home / "pyproject.toml").read_text(), re.MULTILINE)
    assert include
    found = find_packages(str(home), include=json.loads(include[1]))
    there = {
        ".".join(init.parent.relative_to(home).parts)
        for init in (home / f"iort_{folder.replace('device', 'agent')}").rglob("__init__.py")
    }
    assert set(found) == there
