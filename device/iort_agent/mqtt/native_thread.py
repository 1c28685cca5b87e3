"""Keeps Python's state of a thread that C code has started, such as the network's.

Python makes a state for each call from such a thread and deletes it afterwards. From Python 3.11 on, each
time maps and unmaps memory, which costs every other processor core, too: 100 us for each live message at 50
Hz, a third of the message's cost (measured).
"""

from __future__ import annotations

import ctypes
import threading

_kept = threading.local()


def keep_state() -> None:
    """Keep the calling thread's state until the process ends."""
    if not hasattr(_kept, "state"):
        # Python deletes the state with the last release; this one is never released.
        _kept.state = ctypes.pythonapi.PyGILState_Ensure()
