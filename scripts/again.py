"""Runs the tests, and those that failed once more alone: `make test-all AGAIN=1`, as CI does.

A browser, a broker or a ROS may be slow beside three other workers; alone a test has no such excuse. More
failures than `MOST` are no accident, and fail at once.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

MOST = 3
# Where pytest keeps them, those of earlier runs, too.
_FAILED = Path(".pytest_cache/v/cache/lastfailed")
# pytest ran to its end, and tests failed.
_TESTS_FAILED = 1


def main() -> int:
    """Run the command, a pytest, and return its exit code, or that of the second run."""
    _FAILED.unlink(missing_ok=True)
    code = subprocess.run(sys.argv[1:], check=False).returncode
    if code != _TESTS_FAILED:
        return code
    failed = sorted(json.loads(_FAILED.read_text()))
    if len(failed) > MOST:
        print(f"again: at most {MOST} failed tests have a second try, got {len(failed)}", file=sys.stderr)
        return code
    print(f"again: {len(failed)} failed beside others, and now run alone", flush=True)
    code = subprocess.run([sys.executable, "-m", "pytest", *failed], check=False).returncode
    if code == 0:
        print("again: passed alone, but failed beside others, still to be mended:", *failed, sep="\n  ")
    return code


if __name__ == "__main__":
    sys.exit(main())
