"""An invocation's log: its lines as Lambda writes them, and its end, for which the emulator asks the clock.

ministack takes what a function writes from its worker's standard error and cannot know when that was
all: it waits 50 ms for a first line. A function that writes nothing, as Lambda 1 mostly does, so blocks its
worker for ten times as long as it runs. Here the worker itself says where the log of an invocation ends.

And Lambda has set up `logging` before it loads a function: what the function logs is a line with its
level. In the emulator's worker nobody has, and the lines say neither level nor time.
"""

from __future__ import annotations

import queue
import time
from collections.abc import Callable
from typing import Any

from ministack.core import lambda_runtime

_END = "=== end of the invocation's log, local/log_gap.py ==="
# The worker's last words in its loop: the answer, of which the log is then complete.
_ANSWERED = "        _real_stdout.flush()\n\nrun()\n"
# As Lambda's "text" format has it, without the request's id.
_LOGGING = """
import logging
_lines = logging.StreamHandler(sys.stderr)
_format = logging.Formatter("[%(levelname)s]\\t%(asctime)s.%(msecs)03dZ\\t%(message)s", "%Y-%m-%dT%H:%M:%S")
_format.converter = time.gmtime
_lines.setFormatter(_format)
logging.getLogger().addHandler(_lines)
"""
# Of a worker that dies before it says so.
_MOST_S = 1.0


def install() -> None:
    """Close the gap in this process, before the emulator starts."""
    worker = lambda_runtime._PYTHON_WORKER_SCRIPT
    if worker.count(_ANSWERED) != 1:
        raise RuntimeError("ministack's Python worker is another than the one that local/log_gap.py knows")
    said = f"        print({_END!r}, file=sys.stderr, flush=True)\n"
    ended = _ANSWERED.removesuffix("run()\n")
    lambda_runtime._PYTHON_WORKER_SCRIPT = worker.replace(_ANSWERED, f"{said}{ended}{_LOGGING}\nrun()\n")
    drain = lambda_runtime.Worker._drain_stderr_bounded
    lambda_runtime.Worker._drain_stderr_bounded = _to_the_end(drain)


def _to_the_end(drain: Callable[..., str]) -> Callable[[Any], str]:
    def log(worker: Any) -> str:
        if not str(worker.config.get("Runtime", "")).startswith("python"):
            return drain(worker)
        lines: list[str] = []
        deadline = time.monotonic() + _MOST_S
        while (left_s := deadline - time.monotonic()) > 0:
            try:
                line = worker._stderr_queue.get(timeout=left_s)
            except queue.Empty:
                break
            if line == _END:
                break
            lines.append(line)
        return "\n".join(lines)

    return log
