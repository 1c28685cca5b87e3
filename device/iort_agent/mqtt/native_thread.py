"""Keeps Python's state of a thread that is not Python's own, such as the network's.

Whenever such a thread calls Python, a state is made for it and thrown away behind the call. From Python 3.11
on that takes and returns memory of the kernel's each time, which makes every other processor look up its
pages anew: measured at 50 Hz, 100 us for each message of the live lane, a third of what it costs.
"""

from __future__ import annotations

import ctypes
import threading

_kept = threading.local()


def keep_state() -> None:
    """Let the calling thread, which C code has started, have its state until the process ends."""
    if not hasattr(_kept, "state"):
        # One more than is let go of: Python throws the state away with the last.
        _kept.state = ctypes.pythonapi.PyGILState_Ensure()
