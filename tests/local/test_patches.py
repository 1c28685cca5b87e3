"""The patches for ministack apply to the pinned version, and each closes its gap."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import ministack
import pytest

from local import gaps
from local.deployment import ROOT

PATCHES = sorted((ROOT / "local" / "patches").glob("*.patch"))
NAMES = {name.rsplit(".", 1)[-1]: name for name in gaps.NAMES}
ASK = """
import json
from local import gaps
print(json.dumps({name: gaps.load(name).is_open() for name in gaps.NAMES}))
"""


@pytest.fixture(scope="module")
def package(tmp_path_factory):
    """A folder with a copy of the installed ministack."""
    folder = tmp_path_factory.mktemp("patched")
    source = Path(ministack.__file__).parent
    shutil.copytree(source, folder / "ministack", ignore=shutil.ignore_patterns("__pycache__"))
    return folder


def git_apply(folder: Path, *arguments: str | Path) -> None:
    # No repository above the folder may take part.
    environment = {**os.environ, "GIT_CEILING_DIRECTORIES": str(folder.parent)}
    done = subprocess.run(
        ["git", "apply", *arguments], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("patch", PATCHES, ids=lambda patch: patch.stem)
def test_a_patch_is_for_a_gap_and_applies_alone(package, patch):
    assert patch.stem in NAMES
    head = patch.read_text().split("--- a/")[0]
    assert "\nAWS: " in head
    assert "\nministack: " in head
    git_apply(package, "--check", patch)


def test_the_patches_close_their_gaps_and_no_others(tmp_path, package):
    shutil.copytree(package / "ministack", tmp_path / "ministack")
    for patch in PATCHES:
        git_apply(tmp_path, patch)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join((str(tmp_path), str(ROOT)))}
    done = subprocess.run(
        [sys.executable, "-c", ASK],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    still_open = json.loads(done.stdout.splitlines()[-1])
    closed = {name for name, gap in still_open.items() if not gap}
    assert closed == {NAMES[patch.stem] for patch in PATCHES}
