"""The manual page says what the commands do."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from scripts.manual import PAGE, page


def test_the_page_is_current():
    assert PAGE.read_text() == page(), "docs/iort.md is not up to date: run `python scripts/manual.py`"


def test_completion_knows_the_commands():
    iort = Path(sys.executable).parent / "iort"
    asked = {"_IORT_COMPLETE": "complete_bash", "COMP_WORDS": "iort qu", "COMP_CWORD": "1"}
    done = subprocess.run([iort], env=asked, capture_output=True, text=True, check=False, timeout=60)
    assert done.stdout.split() == ["query"], done.stderr
