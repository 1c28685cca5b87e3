"""Reads recordings by Foxglove's JavaScript libraries."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

ROOT = Path(__file__).resolve().parent.parent


class Opened(NamedTuple):
    """A recording: topic -> type and checksum, and topic -> (time in ns, message)."""

    types: dict[str, tuple[str, str]]
    messages: dict[str, list[tuple[int, dict[str, Any]]]]


def opened(path: Path, *, without: bool = False) -> Opened:
    """Read a recording and decode every message; skip the test without Node or the libraries. Messages are
    returned as None if they are ``without`` their values, which takes less time."""
    # The environment's own Node first, since npm came with it.
    node = shutil.which("node", path=os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]))
    modules = Path(os.environ.get("IORT_NODE_MODULES") or ROOT / "node_modules")
    if node is None or not (modules / "@mcap" / "core").is_dir():
        pytest.skip("needs node and Foxglove's libraries: run make setup")
    command = [node, Path(__file__).with_name("foxglove_reader.cjs"), modules, path]
    command += ["without"] if without else []
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    found = Opened({}, {})
    for line in map(json.loads, done.stdout.splitlines()):
        if "message" in line:
            found.messages.setdefault(line["topic"], []).append((int(line["t_ns"]), line["message"]))
        else:
            found.types[line["topic"]] = line["type"], line["md5sum"]
    return found


def flat(message: dict[str, Any]) -> dict[str, Any]:
    """Return a message's fields by the samples' paths, without headers."""
    return dict(_flat("", message))


def _flat(path: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):
        for name, member in value.items():
            # JavaScript has ROS 1's name; samples have ROS 2's.
            part = "nanosec" if name == "nsec" else name
            if name != "header":
                yield from _flat(f"{path}.{part}" if path else part, member)
    elif isinstance(value, list):
        for i, member in enumerate(value):
            yield from _flat(f"{path}.{i}", member)
    else:
        yield path, value
