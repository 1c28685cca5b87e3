"""The agent with a clock that can be set: `clock_agent.py FILE ARGUMENTS`. The wall clock is behind by the
seconds in FILE, as if somebody had set it; the monotonic clock is not."""

import sys
import time
from pathlib import Path

behind, now_ns = Path(sys.argv[1]), time.time_ns


def set_ns():
    """The time by the clock as it is set."""
    return now_ns() - int(behind.read_text()) * 10**9


time.time_ns = set_ns
time.time = lambda: set_ns() / 1e9

from iort_agent.cli import main  # noqa: E402 - after the clock

sys.exit(main(sys.argv[2:]))
