"""The shell completion knows the commands."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path


def test_the_completion_knows_the_commands():
    iort = Path(sys.executable).parent / "iort"
    asked = {"_IORT_COMPLETE": "complete_bash", "COMP_WORDS": "iort qu", "COMP_CWORD": "1"}
    done = subprocess.run([iort], env=asked, capture_output=True, text=True, check=False, timeout=60)
    assert done.stdout.split() == ["query"], done.stderr
