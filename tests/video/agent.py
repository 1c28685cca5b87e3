"""The agent, in a process where a thread can be struck from within: `kill NAME`, or `hang NAME SECONDS`, on
its input does it. Nothing of this is in the product.

A thread that is killed ends as by a fault of a library. One that hangs does nothing for that time, as in a
library that waits for a device, and then ends as well. Both are done by an exception that only a supervisor
takes; the second one takes so long to be made."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading

from iort_agent.cli import main


def _hang(seconds: float) -> type[SystemExit]:
    class HangError(SystemExit):
        def __init__(self, *_: object) -> None:
            super().__init__()
            threading.Event().wait(seconds)

    return HangError


def _strike(name: str, error: type[SystemExit]) -> int:
    """Raise the error in the threads of that name; returns how many there are."""
    found = [one.ident for one in threading.enumerate() if one.name == name and one.ident is not None]
    for ident in found:
        ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(ident), ctypes.py_object(error))
    return len(found)


def _listen() -> None:
    for line in sys.stdin:
        word, name, *more = [*line.split(), ""]
        if word in {"kill", "hang"}:
            struck = _strike(name, _hang(float(more[0])) if word == "hang" else SystemExit)
            sys.stdout.write(f"struck {struck}\n")
            sys.stdout.flush()
        elif word == "quit":
            os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    threading.Thread(target=_listen, name="test", daemon=True).start()
    sys.exit(main())
