"""Every patch for ministack is still needed, applies to the pinned version, and closes its gap."""

from __future__ import annotations

import inspect
import json
import os
import re
import subprocess
import sys

import pytest

from local.deployment import ROOT
from local.emulator import package
from local.processes import LocalError
from testkit.waiting import GUARD_S
from tests.local.emulator import patch_probes

PATCHES = [patch.stem for patch in package.PATCHES]
HEAD = re.compile(
    r"ministack [\d.]+: [^\n]+\n\n"
    r"AWS: (?P<aws>.+)\nministack: .+\nTest: (?P<file>\S+)::(?P<test>\w+)\n",
    re.DOTALL,
)
ASK = """
import json, sys
from tests.local.emulator import patch_probes
from testkit.waiting import GUARD_S
print(json.dumps({name: bool(getattr(patch_probes, name)()) for name in sys.argv[1:]}))
"""


def lacking(*folders):
    """Return the gaps of a ministack: the installed one, or the one in a folder."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, (*folders, ROOT)))}
    command = [sys.executable, "-c", ASK, *PATCHES]
    done = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False, timeout=GUARD_S
    )
    assert done.returncode == 0, done.stderr
    return {name for name, lacks in json.loads(done.stdout.splitlines()[-1]).items() if lacks}


def test_every_patch_has_a_probe():
    own = {
        name
        for name, one in inspect.getmembers(patch_probes, inspect.isfunction)
        if one.__module__ == patch_probes.__name__
    }
    assert own == set(PATCHES)


def test_the_pinned_ministack_needs_every_patch():
    assert lacking() == set(PATCHES), "a new ministack does not need every patch of local/patches/"


def test_the_patched_ministack_needs_no_patch():
    assert lacking(package.folder()) == set()


@pytest.mark.parametrize("patch", package.PATCHES, ids=lambda patch: patch.stem)
def test_each_patch_applies_alone_and_states_its_purpose(patch, tmp_path):
    head = HEAD.fullmatch(patch.read_text().split("\n--- a/")[0])
    assert head
    assert "https://" in head["aws"] or head["aws"].startswith("does not apply;")
    assert f"def {head['test']}(" in (ROOT / head["file"]).read_text()
    package.copy(package.installed(), tmp_path, [patch])


def test_a_patch_that_does_not_apply_is_reported(tmp_path):
    wrong = tmp_path / "wrong.patch"
    wrong.write_text("--- a/ministack/app.py\n+++ b/ministack/app.py\n@@ -1 +1 @@\n-nothing like it\n+x\n")
    with pytest.raises(LocalError, match="does not fit"):
        package.copy(package.installed(), tmp_path / "made", [wrong])
