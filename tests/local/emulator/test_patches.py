"""Every patch for ministack applies to the pinned version, alone, and says what it is for."""

from __future__ import annotations

import re

import pytest

from local.deployment import ROOT
from local.emulator import package
from local.processes import LocalError

HEAD = re.compile(
    r"ministack [\d.]+: [^\n]+\n\n"
    r"AWS: (?P<aws>.+)\nministack: .+\nTest: (?P<file>\S+)::(?P<test>\w+)\n",
    re.DOTALL,
)


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
