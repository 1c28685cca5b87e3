"""What a robot installs holds every package of the contract and of the agent."""

from __future__ import annotations

import json
import re
from pathlib import Path

from setuptools import find_packages

ROOT = Path(__file__).parents[2]


def test_every_package_of_the_robot_is_installed() -> None:
    include = re.search(r"^include = (\[.*\])$", (ROOT / "pyproject.toml").read_text(), re.MULTILINE)
    assert include
    found = find_packages(str(ROOT), include=json.loads(include[1]))
    there = {
        ".".join(init.parent.relative_to(ROOT).parts)
        for name in ("contract", "device")
        for init in (ROOT / name).rglob("__init__.py")
    }
    assert set(found) == there
