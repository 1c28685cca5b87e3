"""The agent with a clock that can be set: `clock_agent.py FILE ARGUMENTS`. The wall clock is behind by the
seconds in FILE, as if somebody had set it; the monotonic clock is not."""

import sys
import threading
import time
from pathlib import Path

behind, now_ns = Path(sys.argv[1]), time.time_ns
behind_ns = [0]


def follow():
    """Look at the file ten times a second."""
    while True:
        behind_ns[0] = int(behind.read_text()) * 10**9
        time.sleep(0.1)


time.time_ns = lambda: now_ns() - behind_ns[0]
time.time = lambda: time.time_ns() / 1e9
threading.Thread(target=follow, daemon=True).start()

from iort_agent.cli import main  # noqa: E402 - after the clock

sys.exit(main(sys.argv[2:]))
